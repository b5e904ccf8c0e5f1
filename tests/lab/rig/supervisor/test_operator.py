"""Requests of an operator: arming, and motions of single axes."""

import math

import pytest

from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import Bench, rig_file


def test_an_axis_is_jogged_and_the_base_only_retracts(bench):
    bench.move("guide_y", 3.0, 2.0)
    assert bench.state is SupervisorState.JOGGING
    assert bench.until(1).state is SupervisorState.ARMED
    assert bench.position("guide_y") == pytest.approx(3.0, abs=2e-3)
    assert [speed for _, speed, _ in bench.calls("set_speed")] == pytest.approx([2.0 * 500.0])
    bench.move("insertion", 1.0, number=2, retract=True)
    assert "must withdraw the base, which is at 0.000 mm" in bench.refusal
    bench.move("guide_y", 1.0, number=3, retract=True)
    assert "must withdraw the base" in bench.refusal
    bench.move("insertion", -2.0, number=4, retract=True)
    assert bench.state is SupervisorState.RETRACTING
    bench.until(4)
    assert bench.position("insertion") == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("axis", "position", "speed", "why"),
    [
        ("insertion", 120.0, 5.0, "insertion = 120.000 mm: must be within"),
        ("insertion", 50.1, 5.0, "insertion = 50.100 mm: must be at most 50.000 mm"),
        ("guide_y", 1.0, 12.5, "speed of guide_y = 12.5 mm/s: must be above 0, at most 10 mm/s"),
        ("guide_y", 1.0, 0.0, "speed of guide_y = 0 mm/s: must be above 0"),
        ("rotation", 1.0, 4.0 * math.pi, "speed of rotation = 720 deg/s: must be above 0, at most 360 deg/s"),
        ("x", 1.0, 5.0, "the rig has no axis x; axes: insertion, rotation, guide_y"),
    ],
)
def test_a_jog_beyond_a_limit_is_refused(bench, axis, position, speed, why):
    bench.move(axis, position, speed)
    assert bench.refusal.startswith(why)
    assert bench.state is SupervisorState.ARMED


@pytest.mark.parametrize("tracked", [True, False])
def test_an_axis_beyond_its_range_can_only_be_jogged_back_and_only_without_an_insertion(tracked):
    bench = Bench(tracked=tracked)
    bench.place("C", 8000.0)  # −16 mm
    bench.tick()
    bench.armed()
    if tracked:
        assert "guide_y = -16.000 mm: must be within -15.000 mm and 15.000 mm" in bench.refusal
        assert bench.state is SupervisorState.IDLE
        return
    bench.move("guide_y", -16.5)
    assert bench.refusal.startswith("guide_y = -16.500 mm: must be within")
    for number, goal in ((2, -15.5), (3, 0.0)):
        bench.move("guide_y", goal, number=number)
        assert bench.until(number).why == ""


@pytest.mark.parametrize(("beyond", "armed"), [(0.05, True), (0.2, False)])
def test_a_rig_is_armed_where_lost_motion_may_have_left_it_and_otherwise_refused_with_motors_off(
    beyond, armed
):
    """The end of the range after a retraction, whose direction a new supervisor does not know."""
    bench = Bench(rig_file(insertion={"backlash_mm": 0.1}))
    motor = bench.place("A", 1000.0 * (-5.0 - beyond))
    motor.on = False
    bench.tick()
    bench.armed()
    assert (bench.state is SupervisorState.ARMED) == motor.on == armed
    if armed:
        bench.step()
        assert bench.until(1).why == ""


@pytest.mark.parametrize(
    ("counts", "low", "why"),
    [
        (7600.0, -math.inf, "guide_y = -15.200 mm: must be within"),
        (100.0, 100.0, "guide_y: the reverse limit switch is active at -0.200 mm"),
    ],
)
def test_a_rig_is_not_armed_where_a_motor_has_moved_as_it_was_switched_on(counts, low, why):
    bench = Bench()
    power, motor = bench.stage.power, bench.stage.motors["C"]

    def jerk(channel, on):
        power(channel, on)
        if channel == "C":
            bench.place("C", counts).low = low

    bench.stage.power = jerk
    bench.armed()
    assert motor.on
    assert bench.state is SupervisorState.IDLE
    assert bench.refusal.startswith(f"arm: refused: {why}")
