"""Stops: faults of motors, late ticks, a silent client, the operator. Nothing starts by itself."""

import math
import re
from dataclasses import replace

import pytest

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import TICK_S, Bench, rig_file

# Faults of motors


def replace_motor(channel, **changes):
    return lambda stage: vars(stage.motors[channel]).update(changes)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (replace_motor("A", fault="stall"), "insertion: the motor does not follow: 0."),
        (replace_motor("A", fault="reversed"), "insertion: the motor does not follow: 0."),
        (replace_motor("A", on=False), "insertion: the motor is off"),
        (replace_motor("A", high=400.0), "insertion: stopped by the motor controller: "),
        (replace_motor("C", position=200.0), "guide_y: the motor does not follow: 0.400 mm"),
        (replace_motor("C", position=math.nan), "guide_y: the motor controller reports position nan"),
        (lambda stage: stage.define("A", 0.0), "insertion: the position went back by 0."),
        (lambda stage: stage.define("C", 2000.0), "guide_y: the position jumped by 4.000 mm in 0.025 s"),
        (lambda stage: setattr(stage, "refuses", True), "PAA=5: ? 22 Begin not possible"),
        (lambda stage: setattr(stage, "lost", True), "no stop could be sent: may still move"),
        (lambda stage: stage.motors.pop("C"), "the driver reports no state for channel C"),
    ],
)
def test_a_fault_of_a_motor_during_a_step_stops_all_of_them(bench, change, why):
    bench.step()
    bench.tick(3)
    at = bench.position("insertion")
    assert 0.1 < at < 0.9
    kept = dict(bench.stage.motors)
    change(bench.stage)
    done = bench.until(1)
    assert done.state is bench.state is SupervisorState.FAULT
    assert done.why.startswith(why)
    bench.tick(20)
    bench.stage.lost, bench.stage.motors = False, kept
    if why.endswith("nan"):
        bench.place("C", 0.0)
    bench.assert_rests()
    assert abs(bench.position("insertion") - at) <= 0.5


@pytest.mark.parametrize(
    ("fault", "travel", "steps", "why"),
    [
        ("stall", 1.0, 1, "insertion: the motor does not follow"),  # more than max_error_mm is left
        ("stall", 0.15, 1, "the motors have not arrived: insertion 0.150 mm from the goal"),
        ("stall", 0.015, 2, "the motors have not arrived: insertion 0.030 mm from the goal"),
        ("overshoot", 0.5, 1, "the motors have not arrived: insertion 0.100 mm from the goal"),
    ],
)
def test_a_wrong_end_of_a_step_is_found_within_its_time(bench, fault, travel, steps, why):
    bench.stage.motors["A"].fault = fault
    for number in range(1, steps + 1):
        assert bench.state is not SupervisorState.FAULT
        begun = bench.clock.time
        bench.step(number, insertion=travel)
        bench.until(number)
    assert bench.state is SupervisorState.FAULT
    assert bench.why.startswith(why)
    assert bench.clock.time - begun <= 0.2 + 0.3 + 2 * TICK_S


def test_a_motor_that_runs_past_its_target_with_its_controller_is_a_fault(bench):
    bench.step()
    bench.tick(2)
    bench.stage.motors["A"].fault = "runaway"
    assert bench.until(1).why.endswith("beyond its target, limit 0.200 mm")
    assert bench.state is SupervisorState.FAULT
    assert bench.position("insertion") < 1.3


def test_a_motor_beyond_its_range_is_a_fault():
    bench = Bench()
    bench.place("A", 109_900.0)
    bench.tick()
    bench.armed().move("insertion", 110.0)
    bench.tick()
    bench.place("A", 110_250.0)
    bench.tick()
    assert bench.state is SupervisorState.FAULT
    assert bench.why.startswith("insertion: at 110.250 mm, beyond its range")


def test_an_axis_that_moves_without_a_command_is_a_fault(bench):
    bench.place("C", 19.0)
    bench.tick()
    assert bench.state is SupervisorState.ARMED  # 0.038 mm, twice the tolerance of a goal is 0.04 mm
    bench.place("C", 25.0)
    bench.tick()
    assert (bench.state, bench.why) == (
        SupervisorState.FAULT,
        "guide_y: moved by 0.050 mm without a command",
    )


def test_a_channel_without_an_axis_that_a_driver_begins_to_report_changes_nothing(bench):
    read = bench.stage.read
    bench.stage.read = lambda: read() | {"X": replace(read()["A"], forward_limit=True)}
    bench.step()
    assert bench.until(1).travelled["insertion"] == pytest.approx(1.0, abs=0.02)
    assert bench.state is SupervisorState.INSERTING


# Connections that fail


@pytest.mark.parametrize("moving", [True, False])
def test_a_lost_controller_is_reconnected_and_stopped_before_a_reset_is_accepted(bench, moving):
    """Also after a fault at rest."""
    if moving:
        bench.step()
        bench.tick(2)
    else:
        bench.stage.motors["C"].on = False
        bench.tick(20)
        assert bench.state is SupervisorState.FAULT
    bench.stage.lost = True
    bench.tick(20)
    assert bench.state is SupervisorState.FAULT
    bench.reset()
    assert "motors have not come to rest yet" in bench.refusal
    assert not bench.reports[-1].at_rest
    before = len(bench.calls("stop"))
    bench.stage.lost = False
    bench.tick(20)
    assert len(bench.calls("stop")) > before
    assert bench.calls("reconnect")
    bench.assert_rests()
    bench.reset()
    assert bench.state is SupervisorState.IDLE


LAST = "may still move to their last targets: "


@pytest.mark.parametrize(
    ("step", "ticks", "moves"),
    [
        ({}, 4, LAST + "insertion by 0.4"),  # 5 mm/s for 75 ms, and the lag of a tick
        ({"guide_y": 0.2}, 4, LAST + "guide_y by 0.0"),
        ({"insertion": 1.0, "guide_y": 0.2}, 4, LAST + "insertion by 0.4"),
        ({"rotation": 0.5}, 2, LAST + "rotation by "),
        (None, 4, "nothing had a target ahead"),
    ],
)
def test_a_controller_that_dies_leaves_what_may_still_move_and_what_to_do(bench, step, ticks, moves):
    if step is not None:
        bench.step(**step)
    bench.tick(ticks)
    leg = bench.core._motion and bench.core._motion.leg
    bench.stage.lost = True
    bench.tick()
    rest, _, cause = bench.why.removeprefix("no stop could be sent: ").partition("; cause: ")
    assert (bench.state, cause) == (SupervisorState.FAULT, "no reply within 100 ms")
    assert rest.startswith(moves)
    assert "press the emergency stop if an axis moves on" in rest
    assert rest.endswith("withdraw the needle by hand, then home insertion, rotation, guide_y again")
    assert (step is None) == (leg is None)
    if step is not None:
        assert bench.sent[-1].why == bench.why
    bench.tick(40)
    assert bench.why.count("no stop could be sent") == 1


@pytest.mark.parametrize(
    "stage", ["idle", "arming", "jogging", "homing", "retracting", "stopping", "holding"]
)
def test_a_controller_that_dies_at_any_stage_is_a_fault_with_what_to_do(stage):
    bench = Bench(rig_file(insertion={"home": "reverse-limit", "home_mm": -12.0}), tracked=stage == "holding")
    bench.place("A", 30_000.0)
    bench.tick()
    if stage not in ("idle", "arming"):
        bench.armed().tick(3)
    if stage == "jogging":
        bench.move("insertion", 40.0)
    elif stage == "homing":
        bench.core.request(protocol.HomeCommand(1, "insertion"))
    elif stage == "retracting":
        bench.core.request(protocol.MoveCommand(1, "insertion", 10.0, 5.0, retract=True))
    elif stage == "holding":
        bench.step(expected=protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0))
    bench.tick(4)
    if stage == "stopping":
        bench.move("insertion", 60.0)
        bench.tick(4)
        bench.stop()
    bench.stage.lost = True
    if stage == "arming":
        bench.armed()
    bench.tick(2)
    assert bench.state is SupervisorState.FAULT
    assert bench.why.startswith("no stop could be sent: ")
    assert "press the emergency stop if an axis moves on" in bench.why
    assert ("insertion by " in bench.why) == (stage in ("jogging", "homing", "retracting", "stopping"))
    assert bench.why.endswith("cause: no reply within 100 ms")


def test_the_motion_left_to_a_dead_controller_is_bounded_by_distance_and_time(bench):
    """The motors of this stage continue to their last targets."""
    bench.step(duration=1.0, insertion=5.0)
    bench.tick(12)
    at = bench.position("insertion")
    bench.stage.lost = True
    bench.tick()
    way, seconds = re.search(r"insertion by ([\d.]+) mm within ([\d.]+) s", bench.why).groups()
    begun, motor = bench.clock.now() - TICK_S, bench.stage.motors["A"]
    while motor.moving:
        bench.clock.wait(1e-3)
        bench.stage._up_to_now()
    assert motor.position / 1000.0 - at == pytest.approx(float(way), abs=2e-3)
    assert 0.5 * float(seconds) < bench.clock.now() - begun <= float(seconds) + 2e-3


def test_a_stop_that_still_reaches_the_motors_leaves_nothing_to_warn_of(bench):
    bench.step()
    bench.tick(2)
    bench.stage.refuses = True
    bench.tick(5)
    assert bench.why == "PAA=5: ? 22 Begin not possible due to limit switch"


# Motors that do not stop


@pytest.mark.parametrize("how", ["stop", "fault"])
def test_a_motor_that_moves_after_a_stop_is_stopped_again(bench, how):
    bench.stop()
    if how == "fault":
        bench.stage.motors["A"].stopped = "abort"
    bench.tick(10)
    before = len(bench.calls("stop"))
    bench.stage.motors["A"].speed, bench.stage.motors["A"].target = 5000.0, 50_000.0
    bench.tick(3)
    assert len(bench.calls("stop")) > before
    bench.assert_rests()
    assert bench.position("insertion") < 1.0


def test_a_stop_is_repeated_until_motors_rest_and_a_second_one_is_sent_at_once(bench):
    bench.step()
    bench.tick(2)
    kept, bench.stage.stop = bench.stage.stop, lambda: bench.stage.calls.append(("ignored",))
    bench.stop("one")
    bench.stage.motors["A"].target = 90_000.0
    bench.tick(5)
    bench.stop("two")
    assert len(bench.calls("ignored")) == 2
    bench.stage.stop = kept
    bench.tick(15)
    assert bench.calls("stop")
    assert bench.why == "one"
    bench.assert_rests()


@pytest.mark.parametrize("every", [1, 2, 7, 60])  # ticks: a ROS node repeats a stop until it is reported
def test_motors_that_do_not_stop_are_a_fault(bench, every):
    bench.step(duration=2.0)
    bench.tick(3)
    bench.stage.deaf = True
    bench.stage.motors["A"].target = 90_000.0
    for _ in range(60 // every):
        bench.stop()
        bench.tick(every)
    assert (bench.state, bench.why) == (
        SupervisorState.FAULT,
        "the motors do not stop: press the emergency stop",
    )
    assert (bench.until(1).state, bench.until(1).why) == (SupervisorState.FAULT, "the test")


def test_a_later_stop_has_its_own_time(bench):
    bench.stop("one")
    bench.tick(100)
    bench.reset()
    bench.armed().step(duration=2.0)
    bench.tick(3)
    bench.stop("two")
    bench.tick(20)
    assert (bench.state, bench.why) == (SupervisorState.STOPPED, "two")


# The operator, the client and the ticks


@pytest.mark.parametrize("inserting", [False, True])
def test_after_a_stop_nothing_moves_until_the_rig_is_reset_and_armed(bench, inserting):
    if inserting:
        bench.step()
        bench.tick(3)
    bench.stop("the keyboard")
    if inserting:
        done = bench.until(1)
        assert (done.state, done.why) == (SupervisorState.STOPPED, "the keyboard")
        assert 0.0 < done.travelled["insertion"] < 1.0
    bench.assert_rests()
    bench.step(2)
    assert bench.refusal.startswith("step: refused while stopped: the keyboard")
    bench.armed()
    assert bench.refusal.startswith("arm: refused while stopped: the keyboard")
    bench.reset()
    assert bench.state is SupervisorState.IDLE
    assert bench.armed().state is SupervisorState.ARMED


def test_a_motion_without_a_heartbeat_is_stopped(bench):
    bench.move("insertion", 20.0, 2.0)
    bench.tick(30, beat=False)
    assert bench.state is SupervisorState.STOPPED
    assert bench.why.startswith("no heartbeat from the controller for 0.5")
    assert bench.position("insertion") < 1.3
    bench.assert_rests()


def test_an_insertion_without_a_command_is_stopped(bench):
    bench.step()
    bench.until(1)
    bench.tick(79, beat=False)
    assert bench.state is SupervisorState.INSERTING
    bench.tick(5, beat=False)
    assert bench.state is SupervisorState.STOPPED
    assert bench.why.startswith("no command from the controller for 2.0")


@pytest.mark.parametrize("stall", [0.1, 0.3, 0.45])
def test_after_late_ticks_no_more_than_the_queue_is_commanded(bench, stall):
    bench.move("insertion", 30.0)
    bench.tick(20)
    bench.clock.wait(stall - TICK_S)
    bench.tick()
    motor = bench.stage.motors["A"]
    assert motor.target - motor.commanded <= 0.075 * 5000.0 + 1.0
    assert bench.until(1).why == ""
    assert bench.position("insertion") == pytest.approx(30.0)


def test_a_motion_is_stopped_after_a_long_time_without_ticks(bench):
    bench.move("insertion", 30.0)
    bench.tick(20)
    bench.clock.wait(0.6)
    bench.core.tick()
    assert (bench.state, bench.why) == (SupervisorState.STOPPED, "no tick for 0.60 s, limit 0.50 s")
    assert bench.until(1).state is SupervisorState.STOPPED
    assert bench.position("insertion") < 4.0


def test_without_ticks_motors_stop_within_the_queue(bench):
    bench.step()
    bench.tick(3)
    at = bench.position("insertion")
    bench.clock.wait(5.0)
    bench.stage.read()
    assert 0.1 < bench.stage.motors["A"].position / 1000.0 - at <= 0.075 * 1.0 / 0.17 + 1e-3
    assert not bench.stage.motors["A"].moving
