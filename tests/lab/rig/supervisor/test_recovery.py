"""Recovery from a fault without a power cycle: arming holds motors where they are, and motors are switched off."""

import re
import socket

import pytest
import tomli_w

import bench_rig
import stages
from commands import run
from emulated import emulator
from flexneedle.errors import DriverError
from flexneedle.lab.rig.rig_file import DeviceSection
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import Bench, rig_file

HELD = r"^insertion: was 0\.\d+ mm from its commanded position, now held where it is$"


# In memory


def test_arming_holds_a_motor_that_rests_away_from_its_commanded_position():
    bench = Bench()
    bench.stage.motors["C"].position = -200.0  # 0.4 mm, limit 0.2 mm
    bench.stage.motors["A"].position = 39.0  # 0.039 mm, below twice the tolerance of a goal
    bench.tick(2)
    bench.armed()
    assert bench.calls("power") == [("A", True), ("B", True), ("C", False), ("C", True)]
    bench.tick(20)
    assert bench.state is SupervisorState.ARMED
    assert bench.why == "guide_y: was 0.400 mm from its commanded position, now held where it is"
    bench.move("guide_y", 1.0)
    assert bench.until(1).why == ""
    assert bench.position("guide_y") == pytest.approx(1.0, abs=2e-3)


def test_arming_also_holds_a_motor_that_would_be_found_to_have_moved_without_a_command():
    """A distance of more than twice the tolerance, below `max_error_mm`."""
    bench = Bench()
    bench.stage.motors["A"].position = 41.0
    bench.tick(2)
    bench.armed().tick(20)
    assert ("A", False) in bench.calls("power")
    assert bench.state is SupervisorState.ARMED


def test_arming_does_not_switch_off_a_motor_that_still_moves():
    bench = Bench()
    for position in (-400.0, -300.0):
        bench.stage.motors["C"].position = position
        bench.tick()
    bench.armed()
    assert ("C", False) not in bench.calls("power")
    bench.tick()
    assert bench.state is SupervisorState.FAULT


def test_motors_are_switched_off_only_after_a_stop_at_rest():
    bench = Bench().armed()
    bench.core.request(protocol.OffCommand())
    assert bench.refusal.startswith("off: refused while armed")
    bench.stop()
    bench.core.request(protocol.OffCommand())
    assert "motors have not come to rest yet" in bench.refusal
    bench.tick(2)
    bench.core.request(protocol.OffCommand())
    assert not any(motor.on for motor in bench.stage.motors.values())
    bench.tick(20)
    assert bench.state is SupervisorState.STOPPED
    bench.reset()
    bench.armed().tick(5)
    assert bench.state is SupervisorState.ARMED


def test_a_motor_that_cannot_be_switched_off_does_not_keep_the_others_on():
    bench = Bench().armed()
    kept = bench.stage.power

    def power(channel, on):
        if channel == "A":
            raise DriverError("A is in motion")
        if channel != "B":  # which stays on
            kept(channel, on)

    bench.stage.power = power
    bench.stop()
    bench.tick(2)
    bench.core.request(protocol.OffCommand())
    assert [motor.on for motor in bench.stage.motors.values()] == [True, True, False]
    assert bench.state is SupervisorState.FAULT
    assert bench.why == "insertion: A is in motion; rotation: the motor is still on"


# On the emulated controller


@pytest.fixture(scope="module")
def controller(patient):  # noqa: ARG001  no limit of time on a busy machine
    """Address of an emulated controller, and a function that gives it an order."""
    with emulator(device="galil") as given:
        yield given


def configure(address, line):
    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(f"{line}\r".encode())
        expected, answer = b":" * (1 + line.count(";")), b""
        while len(answer) < len(expected):
            answer += connection.recv(100)
        assert answer == expected


def test_an_axis_that_was_blocked_or_switched_off_moves_again_after_reset_and_arm(controller):
    address, order = controller
    driver = DeviceSection(kind="stages:patient_galil", address=address)
    with SupervisorClient.of_operator(rig_file().model_copy(update={"driver": driver})) as supervisor:
        for setup, why, note in (
            ("OEA=0", "insertion: the motor does not follow: 0.", HELD),
            ("OEA=1;ERA=100", "insertion: the motor is off", "^$"),
        ):
            configure(address, setup)
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
    driver = {"kind": "stages:patient_galil", "address": address}
    file.write_text(tomli_w.dumps(bench_rig.values() | {"driver": driver}))

    def command(name, *words):
        status, _, err = run(capsys, "rig", name, str(file), *words, "--yes")
        return status, err.splitlines()[-1]

    def read():
        with stages.patient_galil({"address": address}, ["A", "B", "C"]) as motors:
            return motors.read()

    order("fault stall=C")
    status, error = command("jog", "guide_y", "1")
    assert status == 1
    assert "the motors have not arrived: guide_y 1.000 mm from the goal" in error
    assert command("off") == (0, "done")
    assert [state.on for state in read().values()] == [False, False, False]
    order("clear")
    begun = read()["C"].position
    assert command("jog", "guide_y", "-1.5mm", "--speed", "5") == (0, "done")
    assert read()["C"].position == pytest.approx(begun + 750.0, abs=5.0)  # counts, 500 a mm backwards
