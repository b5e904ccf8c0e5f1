"""The way out of a fault: arming holds motors where they are, and motors can be switched off; no power cycle."""

import re
import socket

import pytest
import tomli_w

import bench_rig
from commands import run
from emulated import emulator
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.rig_file import DeviceSection
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import Bench, rig_file

HELD = r"^insertion: was 0\.\d+ mm from its commanded position, now held where it is$"


# In memory


def powered(bench):
    return [call[1:] for call in bench.stage.calls if call[0] == "power"]


def test_arming_holds_a_motor_where_it_is_if_it_rests_away_from_its_commanded_position():
    bench = Bench()
    bench.stage.motors["C"].position = -200.0  # 0.4 mm, limit 0.2 mm
    bench.stage.motors["A"].position = 39.0  # 0.039 mm: a servo may be off by that, and goes on holding
    bench.tick(2)
    bench.armed()
    assert powered(bench) == [("A", True), ("B", True), ("C", False), ("C", True)]
    bench.tick(20)
    assert bench.core.state is SupervisorState.ARMED
    assert bench.reports[-1].why == "guide_y: was 0.400 mm from its commanded position, now held where it is"
    bench.core.request(protocol.MoveCommand(1, "guide_y", 1.0, 5.0))
    assert bench.until(1).why == ""
    assert bench.position("guide_y") == pytest.approx(1.0, abs=2e-3)


def test_what_no_check_at_rest_allows_is_held_where_it_is():
    """More than twice the tolerance would be a motor that moves without a command, also below `max_error_mm`."""
    bench = Bench()
    bench.stage.motors["A"].position = 41.0
    bench.tick(2)
    bench.armed().tick(20)
    assert ("A", False) in powered(bench)
    assert bench.core.state is SupervisorState.ARMED


def test_a_motor_that_still_moves_is_not_switched_off_by_arming():
    bench = Bench()
    motor = bench.stage.motors["C"]
    motor.position = -400.0
    bench.tick()
    motor.position = -300.0
    bench.tick()
    bench.armed()
    assert ("C", False) not in powered(bench)
    bench.tick()
    assert bench.core.state is SupervisorState.FAULT


def test_motors_are_switched_off_after_a_stop_only():
    bench = Bench().armed()
    bench.core.request(protocol.OffCommand())
    assert bench.sent[-1].why.startswith("off: refused while armed")
    bench.core.request(protocol.StopCommand("the test"))
    bench.core.request(protocol.OffCommand())
    assert "motors have not come to rest yet" in bench.sent[-1].why
    bench.tick(2)
    bench.core.request(protocol.OffCommand())
    assert not any(motor.on for motor in bench.stage.motors.values())
    bench.tick(20)
    assert bench.core.state is SupervisorState.STOPPED
    bench.core.request(protocol.ResetCommand())
    bench.armed().tick(5)
    assert bench.core.state is SupervisorState.ARMED


def test_a_motor_that_cannot_be_switched_off_does_not_keep_the_others_on():
    bench = Bench().armed()
    kept = bench.stage.power

    def power(channel, on):
        if channel == "A":
            raise DriverError("A is in motion")
        if channel == "B":
            return  # it stays on
        kept(channel, on)

    bench.stage.power = power
    bench.core.request(protocol.StopCommand("the test"))
    bench.tick(2)
    bench.core.request(protocol.OffCommand())
    assert [motor.on for motor in bench.stage.motors.values()] == [True, True, False]
    assert bench.core.state is SupervisorState.FAULT
    assert bench.core.why == "insertion: A is in motion; rotation: the motor is still on"


# On the emulated controller


@pytest.fixture
def controller():
    """Address of an emulated controller, and a function that gives it an order."""
    with emulator(device="galil") as given:
        yield given


def supervised(address):
    driver = DeviceSection(kind="galil", address=address, reply_timeout_ms=1000.0)
    return SupervisorClient.of_operator(rig_file().model_copy(update={"driver": driver}))


def set_up(address, line):
    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(f"{line}\r".encode())
        assert connection.recv(100) == b":" * (1 + line.count(";"))


def stall(supervisor, order, why):
    supervisor.arm()
    order("fault stall=A")
    with pytest.raises(DriverError, match=why):
        supervisor.move_to("insertion", supervisor.positions["insertion"] + 5.0)
    supervisor.stop()
    supervisor.reset()


def assert_moves(supervisor):
    at = supervisor.positions["insertion"]
    supervisor.move_to("insertion", at + 2.0)
    assert supervisor.positions["insertion"] == pytest.approx(at + 2.0, abs=0.02)


def test_an_axis_that_was_blocked_moves_again_after_reset_and_arm(controller):
    address, order = controller
    with supervised(address) as supervisor:
        stall(supervisor, order, "insertion: the motor does not follow: 0.")
        motor = supervisor.report.axes["insertion"].motor
        assert abs(motor.commanded - motor.position) > 200
        note = supervisor.arm()
        motor = supervisor.report.axes["insertion"].motor
        assert motor.commanded == motor.position
        assert re.match(HELD, note), note
        order("clear")
        assert_moves(supervisor)


def test_a_motor_that_the_controller_has_switched_off_moves_again_after_reset_and_arm(controller):
    address, order = controller
    set_up(address, "OEA=1;ERA=100")
    with supervised(address) as supervisor:
        stall(supervisor, order, "insertion: the motor is off")
        assert not supervisor.report.axes["insertion"].motor.on
        order("clear")
        assert supervisor.arm() == ""
        assert_moves(supervisor)


def test_commands_go_on_after_a_fault_and_motors_are_switched_off(controller, capsys, tmp_path):
    address, order = controller
    file = tmp_path / "rig.toml"
    file.write_text(tomli_w.dumps(bench_rig.values() | {"driver": {"kind": "galil", "address": address}}))
    order("fault stall=A")
    for printed in ("", "insertion: was 0."):  # the second one begins with the position error of the first
        status, _, err = run(capsys, "rig", "jog", str(file), "insertion", "5", "--yes")
        assert status == 1
        assert printed in err
        assert "the motors have not arrived: insertion 5.000 mm from the goal" in err
    status, _, err = run(capsys, "rig", "off", str(file), "--yes")
    assert (status, err.splitlines()[-1]) == (0, "done")
    with factory({"address": address}, ["A", "B", "C"]) as motors:
        assert [state.on for state in motors.read().values()] == [False, False, False]
    order("clear")
    assert run(capsys, "rig", "jog", str(file), "insertion", "2", "--yes")[0] == 0
