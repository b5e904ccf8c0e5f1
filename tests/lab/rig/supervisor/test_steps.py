"""Steps of an insertion in the supervisor: what is done, when, and how much is queued in the motors."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.ports import MotorPaces
from stages import TICK_S, Bench, Moves, Stage, rig_file


def step(number=1, roll=0.0, duration=0.2, expected=None, **travel):
    return protocol.StepCommand(number, roll, travel or {"insertion": 1.0}, duration, expected)


@pytest.fixture
def bench():
    return Bench().armed()


def test_a_step_moves_all_axes_together_and_reports_what_was_done(bench):
    bench.core.request(step(insertion=1.0, guide_y=-0.3))
    done = bench.until(1)
    assert done.why == ""
    assert done.state is SupervisorState.INSERTING
    assert done.travelled["insertion"] == pytest.approx(1.0, abs=1e-3)
    assert done.travelled["guide_y"] == pytest.approx(-0.3, abs=2e-3)
    assert done.travelled["rotation"] == 0.0
    assert bench.stage.motors["A"].position == pytest.approx(1000.0)
    assert bench.stage.motors["C"].position == pytest.approx(150.0)  # its direction is −1


def test_its_begin_and_end_are_those_of_the_motion_and_not_of_ticks(bench):
    bench.core.request(step(insertion=1.0))
    done = bench.until(1)
    ramp = (1.0 / 0.17) / 200.0  # about the speed over the acceleration
    assert done.begun == pytest.approx(0.5 * ramp, abs=0.01)
    assert done.ended == pytest.approx(0.2 - 0.5 * ramp, abs=0.01)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(0.0, 0.02)), min_size=1, max_size=8
    )
)
def test_positions_do_not_drift_and_motors_never_have_more_than_the_queue(steps):
    """Targets are ahead of the motors by at most the queue at the step's speed, in any step."""
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.05})).armed()
    insertion = guide = 0.0
    for number, (advance, across, late) in enumerate(steps, 1):
        bench.clock.wait(late)
        bench.core.request(step(number, insertion=advance, guide_y=across))
        while not any(getattr(one, "number", None) == number for one in bench.sent):
            bench.tick()
            for motor in bench.stage.motors.values():
                ahead = abs(motor.target - motor.commanded)
                assert ahead <= motor.speed * 0.100 + 1.0
        insertion, guide = insertion + advance, guide + across
        assert bench.position("insertion") == pytest.approx(insertion, abs=1e-3)
        assert bench.position("guide_y") == pytest.approx(
            guide, abs=0.03
        )  # half the lost motion, before it is known


@settings(max_examples=30)
@given(
    motors=st.sampled_from([Stage, Moves]),
    speed=st.floats(1.0, 10.0),
    seconds_to_speed=st.floats(0.02, 0.25),
    servo_s=st.floats(0.0, 0.01),
    queue_ms=st.floats(40.0, 100.0),
    roll=st.booleans(),
)
def test_slow_motors_arrive_later_and_no_target_is_further_from_one_than_the_queue(
    motors, speed, seconds_to_speed, servo_s, queue_ms, roll
):
    linear = {"speed_mm_s": speed, "acceleration_mm_s2": speed / seconds_to_speed}
    rotation = {"acceleration_deg_s2": 360.0 / seconds_to_speed, "max_error_deg": 10.0}
    rig = rig_file(insertion=linear, guide_y={"backlash_mm": 0.1}, rotation=rotation)
    bench = Bench(rig, motors=motors, queue_ms=queue_ms).armed()
    for motor in bench.stage.motors.values():
        motor.lag = servo_s
    bench.core.request(
        step(1, roll=math.pi if roll else 0.0, duration=1.0 / speed, insertion=1.0, guide_y=-0.2)
    )
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
    """Motors of a controller that takes speeds in steps of 2 counts/s."""

    paces = MotorPaces((2.0, 1e9), (1.0, 1e9))


def test_motors_of_few_counts_are_not_slower_than_their_controller_can_be():
    bench = Bench(rig_file(guide_y={"counts_per_mm": 100.0, "speed_mm_s": 1.0}), motors=Coarse).armed()
    bench.core.request(step(guide_y=0.0001))
    bench.until(1)
    speeds = {call[1]: call[2] for call in bench.stage.calls if call[0] == "set_speed"}
    assert speeds["C"] == 10.0


def test_counts_of_a_metre_have_the_speed_of_the_step_too():
    bench = Bench(rig_file(insertion={"counts_per_mm": 1e-3})).armed()
    bench.core.request(step(insertion=1.0))
    bench.until(1)
    speeds = {call[1]: call[2] for call in bench.stage.calls if call[0] == "set_speed"}
    assert speeds["A"] == pytest.approx(1e-3 * 1.0 / 0.17, rel=0.05)


def test_a_roll_takes_its_own_time_before_the_travel(bench):
    bench.core.request(protocol.StepCommand(1, math.pi, {"insertion": 1.0}, 0.2, None, 2.0))
    done = bench.until(1)
    assert done.turned == pytest.approx(2.0, abs=0.1)
    assert done.ended == pytest.approx(2.2, abs=0.15)


def test_without_ticks_motors_stop_within_the_queue(bench):
    bench.core.request(step(insertion=1.0))
    bench.tick(3)
    at = bench.position("insertion")
    bench.clock.wait(5.0)
    bench.stage.read()
    assert 0.1 < bench.stage.motors["A"].position / 1000.0 - at <= 0.075 * 1.0 / 0.17 + 1e-3
    assert not bench.stage.motors["A"].moving


def test_a_roll_is_confirmed_by_its_position_before_the_needle_advances(bench):
    bench.core.request(step(roll=math.pi))
    advanced_at = None
    while not bench.sent:
        bench.tick()
        if bench.stage.motors["A"].position > 0.0 and advanced_at is None:
            advanced_at = bench.stage.motors["B"].position
    assert advanced_at == pytest.approx(18_000.0, abs=100.0)
    done = bench.sent[-1]
    assert done.travelled["rotation"] == pytest.approx(math.pi, abs=1e-3)
    assert done.ended - done.turned < 0.2  # the advance alone
    assert done.turned - done.begun > 0.4  # half a turn at 360°/s


def test_a_roll_that_does_not_arrive_is_a_fault_and_the_needle_does_not_advance(bench):
    bench.core.request(step(roll=math.pi))
    bench.tick(3)
    bench.stage.motors["B"].fault = "stall"
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert "rotation: the motor does not follow" in done.why
    assert bench.position("insertion") == 0.0


def test_a_step_that_moves_nothing_ends_at_once(bench):
    bench.core.request(step(insertion=0.0))
    assert bench.sent[-1].travelled == {"insertion": 0.0, "rotation": 0.0, "guide_y": 0.0}


@pytest.mark.parametrize(
    ("travel", "why"),
    [
        ({"insertion": 50.001}, "insertion = 50.001 mm: must be at most 50.000 mm, as far as this insertion"),
        ({"insertion": -5.2}, "insertion = -5.200 mm: must be within -5.000 mm and 110.000 mm"),
        ({"guide_y": 15.1}, "guide_y = 15.100 mm: must be within -15.000 mm and 15.000 mm"),
        ({"guide_z": 0.1}, "the rig has no axis guide_z; axes: insertion, rotation, guide_y"),
        ({"rotation": 4.0}, "rotation = 229.18°: must be within -10.00° and 190.00°"),
    ],
)
def test_a_step_beyond_a_limit_is_refused_and_nothing_moves(bench, travel, why):
    bench.core.request(step(**travel))
    assert [type(one) for one in bench.sent] == [protocol.RequestRefused]
    assert bench.sent[0].why.startswith(why)
    bench.tick(10)
    assert not [call for call in bench.stage.calls if call[0] == "follow"]


def test_lost_motion_is_made_up_for_on_reversal():
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.2})).armed()
    for number, across in enumerate((0.5, -0.5, 0.5), 1):
        bench.core.request(step(number, guide_y=across))
        bench.until(number)
    # With the flank at +, then − and + again: half of 0.2 mm from the unknown side, then all of it twice.
    goals = [call[1]["C"] for call in bench.stage.calls if call[0] == "follow"]
    assert goals[-1] == pytest.approx(-500.0 * (0.5 + 0.1))
    assert max(goals) == pytest.approx(-500.0 * (0.0 - 0.1), abs=1.0)


@pytest.mark.parametrize("side", [1, -1])
def test_before_the_first_motion_a_position_is_uncertain_by_half_the_backlash_and_after_it_is_not(side):
    """Each command begins anew: where the axis rests after a motion to either side, and what it then is taken to be."""
    bench = Bench(rig_file(guide_y={"backlash_mm": 0.2}))
    axis = 3.0
    motor = bench.stage.motors["C"]
    motor.position = motor.commanded = motor.target = -500.0 * (axis + 0.1 * side)  # pushed from that side
    bench.tick(2)
    found = bench.armed().position("guide_y")
    assert abs(found - axis) == pytest.approx(0.1)
    bench.core.request(protocol.MoveCommand(1, "guide_y", 5.0, 2.0))
    assert bench.until(1).why == ""
    assert motor.position / -500.0 - 0.1 == pytest.approx(5.0, abs=2e-3), "the axis, pushed by its motor"
    assert bench.position("guide_y") == pytest.approx(5.0, abs=2e-3)


def test_a_second_step_is_refused_while_one_is_under_way(bench):
    bench.core.request(step(1))
    bench.core.request(step(2))
    assert bench.sent == [
        protocol.RequestRefused(
            2, "step: refused: motors have not come to rest yet", SupervisorState.INSERTING
        )
    ]


def test_before_arming_a_step_is_refused():
    bench = Bench()
    bench.core.request(step())
    assert bench.sent == [
        protocol.RequestRefused(
            1, "step: refused while idle; accepted: arm, stop, fault", SupervisorState.IDLE
        )
    ]


def test_arming_beyond_a_range_is_refused():
    bench = Bench()
    bench.stage.motors["A"].position = -6000.0
    bench.armed()
    assert bench.core.state is SupervisorState.IDLE
    assert bench.sent[0].why.startswith("arm: refused: insertion = -6.000 mm: must be within")


@pytest.mark.parametrize(("beyond", "armed"), [(0.05, True), (0.2, False)])
def test_a_rig_is_armed_where_lost_motion_may_have_left_it_and_refused_with_its_motors_off(beyond, armed):
    """As after a retraction to the end of the range, which a new supervisor does not know of."""
    bench = Bench(rig_file(insertion={"backlash_mm": 0.1}))
    motor, low = bench.stage.motors["A"], rig_file().axes.insertion.limits[0]
    motor.on = False
    motor.position = motor.commanded = motor.target = 1000.0 * (low - beyond)
    bench.tick()
    bench.armed()
    assert (bench.core.state is SupervisorState.ARMED) == armed
    assert motor.on == armed
    if armed:
        bench.core.request(step())
        assert bench.until(1).why == ""


def test_ticks_go_on_while_the_controller_thinks(bench):
    bench.core.request(step())
    bench.until(1)
    before = len(bench.reports)
    bench.tick(10, beat=False)
    assert len(bench.reports) == before + 10
    assert all(report.measurements for report in bench.reports[before:])
    assert bench.core.state is SupervisorState.INSERTING
    assert bench.reports[-1].time - bench.reports[-2].time == pytest.approx(TICK_S)
