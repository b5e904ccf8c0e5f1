"""Steps of an insertion: travel, times, refusals, and the motion queued in the motors."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.ports import MotorPaces
from stages import TICK_S, Bench, Moves, Stage, rig_file


@pytest.fixture
def bench():
    return Bench().armed()


def test_a_step_moves_all_axes_together_within_its_time_and_reports_the_travel(bench):
    """Begin and end are of the motion at constant speed between the ramps, not of ticks."""
    bench.step(insertion=1.0, guide_y=-0.3)
    done = bench.until(1)
    assert (done.why, done.state) == ("", SupervisorState.INSERTING)
    assert done.travelled["insertion"] == pytest.approx(1.0, abs=1e-3)
    assert done.travelled["guide_y"] == pytest.approx(-0.3, abs=2e-3)
    assert done.travelled["rotation"] == 0.0
    assert bench.stage.motors["A"].position == pytest.approx(1000.0)
    assert bench.stage.motors["C"].position == pytest.approx(150.0)  # its direction is −1
    ramp = (1.0 / 0.17) / 200.0  # about the speed over the acceleration
    assert done.begun == pytest.approx(0.5 * ramp, abs=0.01)
    assert done.ended == pytest.approx(0.2 - 0.5 * ramp, abs=0.01)


@settings(max_examples=15)
@given(
    st.lists(
        st.tuples(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(0.0, 0.02)), min_size=1, max_size=8
    )
)
def test_positions_do_not_drift_and_targets_are_at_most_a_queue_ahead(steps):
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.05})).armed()
    insertion = guide = 0.0
    for number, (advance, across, late) in enumerate(steps, 1):
        bench.clock.wait(late)
        bench.step(number, insertion=advance, guide_y=across)
        while not any(getattr(one, "number", None) == number for one in bench.sent):
            bench.tick()
            for motor in bench.stage.motors.values():
                assert abs(motor.target - motor.commanded) <= motor.speed * 0.100 + 1.0
        insertion, guide = insertion + advance, guide + across
        assert bench.position("insertion") == pytest.approx(insertion, abs=1e-3)
        # Half of the lost motion, before its side is known.
        assert bench.position("guide_y") == pytest.approx(guide, abs=0.03)


@settings(max_examples=15)
@given(
    motors=st.sampled_from([Stage, Moves]),
    speed=st.floats(1.0, 10.0),
    seconds_to_speed=st.floats(0.02, 0.25),
    servo_s=st.floats(0.0, 0.01),
    queue_ms=st.floats(40.0, 100.0),
    roll=st.booleans(),
)
def test_slow_motors_arrive_later_and_no_target_is_more_than_the_queue_ahead(
    motors, speed, seconds_to_speed, servo_s, queue_ms, roll
):
    linear = {"speed_mm_s": speed, "acceleration_mm_s2": speed / seconds_to_speed}
    rotation = {"acceleration_deg_s2": 360.0 / seconds_to_speed, "max_error_deg": 10.0}
    rig = rig_file(insertion=linear, guide_y={"backlash_mm": 0.1}, rotation=rotation)
    bench = Bench(rig, motors=motors, queue_ms=queue_ms).armed()
    for motor in bench.stage.motors.values():
        motor.lag = servo_s
    bench.step(roll=math.pi if roll else 0.0, duration=1.0 / speed, insertion=1.0, guide_y=-0.2)
    means = {"insertion": speed, "guide_y": 0.2 * speed, "rotation": rig.axes.rotation.speed}
    done, limits = bench.until(1), rig.loop.model_copy(update={"queue_ms": queue_ms})
    assert done.why == ""
    assert done.travelled["insertion"] == pytest.approx(1.0, abs=0.02)
    for report in bench.reports:
        for name, axis in rig.axes.items():
            most = limits.queue_of(axis, min(axis.speed, 2.0 * means[name]))  # a trapezoid's largest speed
            assert report.axes[name].queued <= most * 1.02
            assert most <= (0.5 if axis.unit == "mm" else axis.speed * 0.1)


class Coarse(Stage):
    """Motors of a controller that accepts speeds in steps of 2 counts/s."""

    paces = MotorPaces((2.0, 1e9), (1.0, 1e9))


@pytest.mark.parametrize(
    ("axis", "keys", "travel", "motors", "speed"),
    [
        ("guide_y", {"counts_per_mm": 100.0, "speed_mm_s": 1.0}, 0.0001, Coarse, 10.0),  # five steps of speed
        ("insertion", {"counts_per_mm": 1e-3}, 1.0, Stage, 1e-3 / 0.17),  # counts of a metre
    ],
)
def test_motors_of_few_counts_are_as_fast_as_the_step_and_their_controller_need(
    axis, keys, travel, motors, speed
):
    rig = rig_file(**{axis: keys})
    bench = Bench(rig, motors=motors).armed()
    bench.step(**{axis: travel})
    bench.until(1)
    speeds = {channel: each for channel, each, _ in bench.calls("set_speed")}
    assert speeds[getattr(rig.axes, axis).channel] == pytest.approx(speed, rel=0.05)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_the_settling_of_motors_after_a_step_counts_for_the_next(bench, lag):
    bench.stage.motors["A"].lag = lag
    travelled = 0.0
    for number in range(1, 21):
        bench.step(number, insertion=0.5)
        travelled += bench.until(number).travelled["insertion"]
    bench.tick(20)
    assert bench.position("insertion") == pytest.approx(10.0, abs=1e-3)
    assert travelled == pytest.approx(10.0, abs=0.03)


def test_times_are_those_of_the_motors_and_not_of_a_slow_tracker():
    slow, fast = Bench().armed(), Bench().armed()
    read = slow.camera.read

    def read_slowly():
        slow.clock.wait(0.01)
        return read()

    slow.camera.read = read_slowly
    times = []
    for one in (slow, fast):
        one.step()
        done = one.until(1)
        times.append((done.begun, done.ended - done.begun))
    assert times[0] == pytest.approx(times[1], abs=0.012)
    assert 0.0 <= times[1][0] < 2 * TICK_S


def test_a_step_that_moves_nothing_ends_at_once(bench):
    bench.step(insertion=0.0)
    assert bench.sent[-1].travelled == {"insertion": 0.0, "rotation": 0.0, "guide_y": 0.0}


# Rolls


def test_a_roll_takes_its_own_time_and_is_confirmed_by_its_position_before_the_travel(bench):
    bench.core.request(protocol.StepCommand(1, math.pi, {"insertion": 1.0}, 0.2, None, 2.0))
    while bench.stage.motors["A"].position == 0.0:
        bench.tick()
    assert bench.stage.motors["B"].position == pytest.approx(18_000.0, abs=100.0)
    done = bench.until(1)
    assert done.travelled["rotation"] == pytest.approx(math.pi, abs=1e-3)
    assert done.turned == pytest.approx(2.0, abs=0.1)
    assert done.ended == pytest.approx(2.2, abs=0.15)


def test_a_roll_alone_ends_with_the_roll(bench):
    bench.step(roll=math.pi, insertion=0.0)
    done = bench.until(1)
    assert done.turned == done.ended > done.begun + 0.4  # half a turn at 360°/s


def test_a_roll_that_does_not_arrive_is_a_fault_and_the_needle_does_not_advance(bench):
    bench.step(roll=math.pi)
    bench.tick(3)
    bench.stage.motors["B"].fault = "stall"
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert "rotation: the motor does not follow" in done.why
    assert bench.position("insertion") == 0.0


def test_half_turns_in_both_directions_are_possible_in_a_range_of_half_a_turn():
    bench = Bench(rig_file(rotation={"range_deg": [0.0, 180.0]})).armed()
    bench.stage.motors["B"].position += 0.4  # counts that an encoder does not resolve
    for number, roll in enumerate((math.pi, -math.pi, math.pi, -math.pi), 1):
        bench.step(number, roll=roll, insertion=0.1)
        assert bench.until(number).why == ""


# Refusals


@pytest.mark.parametrize(
    ("travel", "why"),
    [
        ({"insertion": 50.001}, "insertion = 50.001 mm: must be at most 50.000 mm"),
        ({"insertion": -5.2}, "insertion = -5.200 mm: must be within -5.000 mm and 110.000 mm"),
        ({"guide_y": 15.1}, "guide_y = 15.100 mm: must be within"),
        ({"guide_z": 0.1}, "the rig has no axis guide_z; axes: insertion, rotation, guide_y"),
        ({"rotation": 4.0}, "rotation = 229.18°: must be within -10.00° and 190.00°"),
        ({"roll": 4.0, "rotation": -4.0}, "rotation = 229.18°: must be within"),  # at the end of its roll
    ],
)
def test_a_step_beyond_a_limit_is_refused_and_nothing_moves(bench, travel, why):
    bench.step(**travel)
    assert bench.refusal.startswith(why)
    bench.tick(10)
    assert bench.calls("follow") == []


def test_a_step_is_refused_before_arming_and_during_another_one():
    bench = Bench()
    bench.step()
    why = "step: refused while idle; accepted: arm, stop, fault"
    assert bench.sent == [protocol.RequestRefused(1, why, SupervisorState.IDLE)]
    bench.armed().step(2)
    bench.step(3)
    why = "step: refused: motors have not come to rest yet"
    assert bench.sent[1:] == [protocol.RequestRefused(3, why, SupervisorState.INSERTING)]


# Backlash


def test_lost_motion_is_compensated_on_reversal():
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.2})).armed()
    for number, across in enumerate((0.5, -0.5, 0.5), 1):
        bench.step(number, guide_y=across)
        bench.until(number)
    # From the unknown side half of 0.2 mm, then the whole of it twice.
    goals = [targets["C"] for (targets,) in bench.calls("follow")]
    assert goals[-1] == pytest.approx(-500.0 * (0.5 + 0.1))
    assert max(goals) == pytest.approx(-500.0 * (0.0 - 0.1), abs=1.0)


@pytest.mark.parametrize("side", [1, -1])
def test_before_the_first_motion_a_position_is_uncertain_by_half_the_backlash_and_after_it_is_not(side):
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.2}))
    motor = bench.place("C", -500.0 * (3.0 + 0.1 * side))  # the axis is at 3 mm, pushed from that side
    bench.tick(2)
    assert abs(bench.armed().position("guide_y") - 3.0) == pytest.approx(0.1)
    bench.move("guide_y", 5.0, 2.0)
    assert bench.until(1).why == ""
    assert motor.position / -500.0 - 0.1 == pytest.approx(5.0, abs=2e-3)
    assert bench.position("guide_y") == pytest.approx(5.0, abs=2e-3)
