"""Hazards found by looking for them: late ticks, motors that go on, lines that fail at rest, servos that lag."""

import math

import pytest

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, SensorReading
from stages import TICK_S, Bench, rig_file

AHEAD = protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)


def step(number=1, roll=0.0, duration=0.2, expected=None, **travel):
    return protocol.StepCommand(number, roll, travel or {"insertion": 1.0}, duration, expected)


@pytest.fixture
def bench():
    made = Bench().armed()
    made.tick(3)
    return made


# Late ticks


@pytest.mark.parametrize("stall", [0.1, 0.3, 0.45])
def test_after_late_ticks_no_more_than_the_queue_is_commanded(bench, stall):
    bench.core.request(protocol.MoveCommand(1, "insertion", 30.0, 5.0))
    bench.tick(20)
    bench.clock.wait(stall)
    bench.core.request(protocol.Heartbeat())
    bench.core.tick()
    motor = bench.stage.motors["A"]
    assert motor.target - motor.commanded <= 0.075 * 5000.0 + 1.0
    assert bench.until(1).why == ""
    assert bench.position("insertion") == pytest.approx(30.0)


def test_after_a_long_time_without_ticks_a_motion_is_not_taken_up_again(bench):
    bench.core.request(protocol.MoveCommand(1, "insertion", 30.0, 5.0))
    bench.tick(20)
    bench.clock.wait(0.6)
    bench.core.tick()
    assert bench.core.state is SupervisorState.STOPPED
    assert bench.core.why == "no tick for 0.60 s, limit 0.5 s"
    assert bench.until(1).state is SupervisorState.STOPPED
    assert bench.position("insertion") < 4.0


# Motors that go on, and lines that fail


def test_a_motor_that_runs_past_its_target_with_its_controller_is_a_fault(bench):
    bench.core.request(step())
    bench.tick(2)
    bench.stage.motors["A"].fault = "runaway"
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert done.why.startswith("insertion: 0.2")
    assert "beyond its target, limit 0.200 mm" in done.why
    assert bench.position("insertion") < 1.3


@pytest.mark.parametrize(
    ("travel", "steps", "seconds", "why"),
    [
        (1.0, 1, 0.1, "insertion: the motor does not follow"),  # more than max_error_mm of the step is left
        (0.15, 1, 0.3 + 2 * TICK_S, "the motors have not arrived: insertion 0.150 mm from the goal"),
        (0.015, 2, 0.3 + 2 * TICK_S, "the motors have not arrived: insertion 0.030 mm from the goal"),
    ],
)
def test_a_stall_is_found_by_what_is_left_of_the_step(bench, travel, steps, seconds, why):
    bench.stage.motors["A"].fault = "stall"
    for number in range(1, steps + 1):
        assert bench.core.state is not SupervisorState.FAULT
        begun = bench.clock.time
        bench.core.request(step(number, insertion=travel))
        bench.until(number)
    assert bench.core.state is SupervisorState.FAULT
    assert bench.core.why.startswith(why)
    assert seconds - 3 * TICK_S <= bench.clock.time - begun <= seconds


def test_a_line_that_fails_at_rest_after_a_fault_is_opened_again_before_anything_else(bench):
    bench.stage.motors["C"].on = False
    bench.tick(20)
    assert bench.core.state is SupervisorState.FAULT
    bench.stage.lost = True
    bench.tick(4)
    bench.core.request(protocol.ResetCommand())
    assert isinstance(bench.sent[-1], protocol.RequestRefused)
    assert not bench.reports[-1].at_rest
    bench.stage.lost = False
    bench.tick(20)
    assert ("reconnect",) in bench.stage.calls
    bench.core.request(protocol.ResetCommand())
    assert bench.core.state is SupervisorState.IDLE


def test_a_driver_that_leaves_a_motor_out_is_a_fault(bench):
    read = bench.stage.read
    bench.stage.read = lambda: {channel: state for channel, state in read().items() if channel != "C"}
    bench.tick(2)
    assert bench.core.state is SupervisorState.FAULT
    assert "no state of channel C" in bench.core.why


@pytest.mark.parametrize("how", ["stop", "fault"])
def test_a_motor_that_moves_after_a_stop_is_stopped_again(bench, how):
    bench.core.request(protocol.StopCommand("the test"))
    if how == "fault":
        bench.stage.motors["A"].stopped = "abort"
    bench.tick(10)
    before = bench.stage.calls.count(("stop",))
    bench.stage.motors["A"].speed, bench.stage.motors["A"].target = 5000.0, 50_000.0
    bench.tick(3)
    assert bench.stage.calls.count(("stop",)) > before
    bench.tick(10)
    assert not bench.stage.motors["A"].moving
    assert bench.position("insertion") < 1.0


def test_a_second_stop_is_sent_too(bench):
    bench.core.request(protocol.StopCommand("one"))
    bench.tick(10)
    before = bench.stage.calls.count(("stop",))
    bench.core.request(protocol.StopCommand("two"))
    assert bench.stage.calls.count(("stop",)) == before + 1
    assert bench.core.why == "one"


def test_a_stop_without_effect_is_a_fault_and_is_reported(bench):
    bench.core.request(step(expected=AHEAD, duration=2.0))
    bench.tick(3)
    bench.stage.deaf = True
    bench.stage.motors["A"].target = 90_000.0
    bench.core.request(protocol.StopCommand("the test"))
    done = bench.until(1, most=60)
    assert (done.state, done.why) == (SupervisorState.FAULT, "the test")
    assert bench.core.why == "the motors do not stop"


@pytest.mark.parametrize("every", [1, 2, 7])  # ticks: a ROS node repeats it until it is reported
def test_motors_that_do_not_stop_are_a_fault_also_if_the_stop_is_repeated(bench, every):
    bench.core.request(step(expected=AHEAD, duration=2.0))
    bench.tick(3)
    bench.stage.deaf = True
    bench.stage.motors["A"].target = 90_000.0
    for _ in range(60 // every):
        bench.core.request(protocol.StopCommand("the test"))
        bench.tick(every)
    assert (bench.core.state, bench.core.why) == (SupervisorState.FAULT, "the motors do not stop")


def test_a_later_stop_has_its_own_time(bench):
    bench.core.request(protocol.StopCommand("one"))
    bench.tick(100)
    bench.core.request(protocol.ResetCommand())
    bench.armed()
    bench.core.request(step(expected=AHEAD, duration=2.0))
    bench.tick(3)
    bench.core.request(protocol.StopCommand("two"))
    bench.tick(20)
    assert (bench.core.state, bench.core.why) == (SupervisorState.STOPPED, "two")


def test_a_position_that_is_no_number_is_a_fault(bench):
    bench.stage.motors["C"].position = math.nan
    bench.tick()
    assert bench.core.state is SupervisorState.FAULT
    assert bench.core.why.startswith("guide_y: the motor controller reports position nan")


def test_a_motor_beyond_its_range_is_a_fault():
    bench = Bench().armed(deepest=1e6)
    bench.core.request(protocol.MoveCommand(1, "insertion", 110.0, 10.0))
    bench.tick(100)
    bench.stage.motors["A"].commanded = bench.stage.motors["A"].position = 110_250.0
    bench.tick()
    assert bench.core.state is SupervisorState.FAULT


# Rolls


def test_a_roll_may_not_leave_the_range_within_a_step(bench):
    bench.core.request(step(roll=4.0, rotation=-4.0))
    assert bench.sent[-1].why.startswith("rotation = 229.18°: must be within")
    bench.tick(5)
    assert bench.stage.motors["B"].position == 0.0


def test_half_turns_to_and_fro_are_possible_in_a_range_of_half_a_turn():
    bench = Bench(rig_file(rotation={"range_deg": [0.0, 180.0]})).armed()
    bench.stage.motors["B"].position += 0.4  # counts that an encoder does not resolve
    for number, roll in enumerate((math.pi, -math.pi, math.pi, -math.pi), 1):
        bench.core.request(step(number, roll=roll, insertion=0.1))
        assert bench.until(number).why == ""


def test_during_a_roll_the_tip_is_expected_where_it_is(bench):
    """A tip that is measured to the last digit as before is not frozen before the needle travels."""
    bench.camera.tip = lambda _: (0.0, 0.0, 0.0)
    bench.core.request(step(roll=math.pi, expected=AHEAD))
    while bench.stage.motors["A"].position == 0.0 and not bench.sent:
        bench.tick()
    assert not bench.sent


def test_a_roll_alone_has_turned_when_it_ends(bench):
    bench.core.request(step(roll=math.pi, insertion=0.0))
    done = bench.until(1)
    assert done.turned == done.ended > done.begun


# Servos that lag


@pytest.mark.parametrize("lag", [0.0, 0.02, 0.03])
def test_what_motors_settle_after_a_step_counts_for_the_next(bench, lag):
    bench.stage.motors["A"].lag = lag
    travelled = 0.0
    for number in range(1, 31):
        bench.core.request(step(number, insertion=0.5))
        travelled += bench.until(number).travelled["insertion"]
    bench.tick(20)
    assert bench.position("insertion") == pytest.approx(15.0, abs=1e-3)
    assert travelled == pytest.approx(15.0, abs=0.03)


def test_a_hold_of_a_servo_that_lags_is_no_fault(bench):
    bench.stage.motors["A"].lag = 0.03
    bench.camera.tip = lambda time: (0.5 * time, 0.0, 0.01 * time)
    bench.core.request(step(expected=AHEAD))
    bench.tick(4)
    bench.camera.tip = lambda _: (math.nan, 0.0, 0.0)
    assert bench.until(1).state is SupervisorState.HOLDING
    bench.tick(40)
    assert bench.core.state is SupervisorState.HOLDING


def test_a_held_step_has_ended_by_the_time_it_is_reported(bench):
    bench.camera.tip = lambda time: (0.5 * time, 0.0, 0.01 * time)
    slow = protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)
    bench.core.request(step(expected=slow, duration=2.0))
    bench.tick(20)
    bench.camera.tip = lambda _: (math.nan, 0.0, 0.0)
    done = bench.until(1)
    assert done.begun < done.ended <= bench.clock.now()
    speed = done.travelled["insertion"] / (done.ended - done.begun)
    assert speed == pytest.approx(0.5, rel=0.1)


def test_times_of_readings_are_those_of_the_motors_and_not_of_a_slow_tracker():
    slow, fast = Bench().armed(), Bench().armed()
    read = slow.camera.read

    def slowly():
        slow.clock.wait(0.01)
        return read()

    slow.camera.read = slowly
    times = []
    for one in (slow, fast):
        asked = one.clock.time
        one.core.request(step())
        done = one.until(1)
        times.append((done.begun - asked, done.ended - done.begun))
    (begun, lasted), (of_fast, duration) = times
    assert begun == pytest.approx(of_fast, abs=0.012)
    assert 0.0 <= of_fast < 2 * TICK_S
    assert lasted == pytest.approx(duration, abs=0.012)


# Motions of the operator


def test_a_jog_is_no_faster_than_asked(bench):
    bench.core.request(protocol.MoveCommand(1, "guide_y", 1.0, 2.0))
    speeds = [call[2] for call in bench.stage.calls if call[0] == "set_speed"]
    assert speeds == pytest.approx([2.0 * 500.0])


def test_a_speed_that_is_refused_has_the_unit_of_the_file(bench):
    for axis, speed in (("rotation", 4.0 * math.pi), ("guide_y", 12.5)):
        bench.core.request(protocol.MoveCommand(1, axis, 1.0, speed))
        expected = {
            "rotation": "speed of rotation = 720 deg/s: must be above 0, at most 360 deg/s",
            "guide_y": "speed of guide_y = 12.5 mm/s: must be above 0, at most 10 mm/s",
        }
        assert bench.sent[-1].why == expected[axis]


@pytest.mark.parametrize("tracked", [True, False])
def test_an_axis_beyond_its_range_is_armed_for_the_operator_alone_and_may_only_be_jogged_back(tracked):
    bench = Bench(tracked=tracked)
    motor = bench.stage.motors["C"]
    motor.position = motor.commanded = motor.target = 8000.0  # −16 mm
    bench.tick()
    bench.armed()
    if tracked:
        assert "guide_y = -16.000 mm: must be within -15.000 mm and 15.000 mm" in bench.sent[-1].why
        return
    bench.core.request(protocol.MoveCommand(1, "guide_y", -16.5, 5.0))
    assert bench.sent[-1].why.startswith("guide_y = -16.500 mm: must be within")
    bench.core.request(protocol.MoveCommand(2, "guide_y", -15.5, 5.0))
    assert bench.until(2).why == ""
    bench.core.request(protocol.MoveCommand(3, "guide_y", 0.0, 5.0))
    assert bench.until(3).why == ""


def test_a_jog_may_not_go_deeper_than_the_insertion_may():
    bench = Bench().armed(deepest=20.0)
    bench.core.request(protocol.MoveCommand(1, "insertion", 20.1, 5.0))
    assert "as far as this insertion may go" in bench.sent[-1].why


def test_after_homing_the_rig_is_not_armed(bench):
    bench.core.request(protocol.HomeCommand(1, "rotation"))
    bench.until(1)
    bench.core.request(step(2))
    assert bench.sent[-1].why.startswith("step: refused while idle")


def test_a_home_that_cannot_be_defined_is_a_fault(bench):
    bench.stage.define = lambda *_: bench.stage._called("define") or setattr(bench.stage, "lost", True)
    bench.core.request(protocol.HomeCommand(1, "rotation"))
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert done.why == "no reply within 100 ms"


# The tracker


def test_with_a_tracker_that_has_not_answered_no_step_begins(bench):
    bench.camera.tip = lambda _: None
    bench.tick(20)
    bench.core.request(step(expected=AHEAD))
    assert bench.sent[-1].why.startswith("missing: no reading for 0.5")
    bench.tick(20)
    assert bench.position("insertion") == 0.0


def test_a_lasting_jump_holds_the_needle_for_good(bench):
    bench.camera.tip = lambda time: (0.5 * time, 0.0, 0.01 * time)
    bench.core.request(step(expected=AHEAD, duration=2.0))
    bench.tick(10)
    bench.camera.tip = lambda time: (0.3, 1.9, 0.01 * time)
    assert bench.until(1).why.startswith("jump: 1.9")
    for number in range(2, 12):
        bench.tick(40)
        bench.core.request(step(number, expected=AHEAD))
        assert bench.until(number).travelled["insertion"] == 0.0


@pytest.mark.parametrize(("bad", "why"), [("late", "stale: 0.4"), ("indicator", "field distorted: ref1 0.")])
def test_late_readings_and_a_distorted_field_hold_the_needle(bad, why):
    bench = Bench(monitor=MonitorSettings(references=1)).armed()
    state = {"late": 0.0, "indicator": 0.02}

    def read():
        now = bench.clock.now()
        bench.camera.number += 1
        tip = SensorReading((0.5 * now, 0.0, 0.01 * now))
        reference = SensorReading((0.0, 0.0, 0.0), None, state["indicator"])
        return (Frame(now - state["late"], bench.camera.number, {"tip": tip, "ref1": reference}),)

    bench.camera.read = read
    bench.tick(60)
    begin = 0.5 * bench.clock.now()
    ahead = protocol.Expectation((begin, 0.0, 0.0), (begin + 2.0, 0.0, 0.0), 2.0)
    bench.core.request(step(expected=ahead, duration=4.0, insertion=2.0))
    bench.tick(10)
    assert bench.core.state is SupervisorState.INSERTING
    state[bad] = {"late": 0.4, "indicator": 0.2}[bad]
    done = bench.until(1)
    assert done.why.startswith(why)
    assert done.ended <= bench.clock.now() < 60 * TICK_S + 0.25 + 0.9
