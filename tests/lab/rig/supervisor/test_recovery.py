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
    bench.stage.motors["A"].position = 39.0  # 0.039 mm: a servo may be off by that
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


@pytest.fixture(scope="module")
def controller():
    """Address of an emulated controller, and a function that gives it an order."""
    with emulator(device="galil") as given:
        yield given


def configure(address, line):
    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(f"{line}\r".encode())
        assert connection.recv(100) == b":" * (1 + line.count(";"))


@pytest.mark.parametrize(
    ("setup", "why", "note"),
    [
        ("OEA=0", "insertion: the motor does not follow: 0.", HELD),
        ("OEA=1;ERA=100", "insertion: the motor is off", "^$"),
    ],
)
def test_an_axis_that_was_blocked_or_switched_off_moves_again_after_reset_and_arm(
    controller, setup, why, note
):
    address, order = controller
    configure(address, setup)
    driver = DeviceSection(kind="galil", address=address, reply_timeout_ms=1000.0)
    with SupervisorClient.of_operator(rig_file().model_copy(update={"driver": driver})) as supervisor:
        supervisor.arm()
        order("fault stall=A")
        at = supervisor.positions["insertion"]
        with pytest.raises(DriverError, match=why):
            supervisor.move_to("insertion", at + 5.0)
        supervisor.stop()
        supervisor.reset()
        assert re.match(note, supervisor.arm())
        motor = supervisor.report.axes["insertion"].motor
        assert (motor.on, motor.commanded) == (True, motor.position)
        order("clear")
        supervisor.move_to("insertion", at + 2.0)
        assert supervisor.positions["insertion"] == pytest.approx(at + 2.0, abs=0.02)


def test_commands_move_axes_and_switch_motors_off_after_a_fault(controller, capsys, tmp_path):
    address, order = controller
    configure(address, "OEA=0")
    file = tmp_path / "rig.toml"
    file.write_text(tomli_w.dumps(bench_rig.values() | {"driver": {"kind": "galil", "address": address}}))

    def command(name, *words):
        status, _, err = run(capsys, "rig", name, str(file), *words, "--yes")
        return status, err.splitlines()[-1]

    def read():
        with factory({"address": address}, ["A", "B", "C"]) as motors:
            return motors.read()

    order("fault stall=C")
    status, error = command("jog", "guide_y", "5")
    assert status == 1
    assert "the motors have not arrived: guide_y 5.000 mm from the goal" in error
    assert command("off") == (0, "done")
    assert [state.on for state in read().values()] == [False, False, False]
    order("clear")
    begun = read()["C"].position
    assert command("jog", "guide_y", "-1.5mm") == (0, "done")
    assert read()["C"].position == pytest.approx(begun + 750.0, abs=5.0)  # counts, 500 a mm backwards
