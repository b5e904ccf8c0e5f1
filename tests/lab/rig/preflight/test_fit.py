"""Fit of a rig to a scenario: requirements, and room from the present positions."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench_rig import VALUES, rig
from flexneedle.lab.rig.preflight.fit import (
    deepest_advance,
    describe_queues,
    fit_problems,
    needed_advance,
    room_problem,
    start_problems,
)
from flexneedle.scenario.files import load_scenario

PLANE, SPACE = load_scenario("phantom"), load_scenario("phantom3d")
TILTED = PLANE.with_values({"entry.lateral_mm": 3.0, "entry.slope_mrad": 50.0})
GUIDE_Z = {**VALUES["axes"]["guide_y"], "channel": "D"}
BASE = {**VALUES["axes"]["guide_y"], "channel": "E", "range_mm": [-15, 15], "speed_mm_s": 5}
FREE = {"axes__guide_z": GUIDE_Z, "axes__rotation__range_deg": [-200, 200]}
"""Axes for needles in space that roll to any angle."""
FREE_FROM_10 = FREE | {"axes__rotation__range_deg": [10, 200], "axes__rotation__home_deg": 10}


def scenario(base=PLANE, **changes):
    return base.with_values({key.replace("__", "."): value for key, value in changes.items()})


MOVING_BASE = scenario(plan__base_sigma_mm=0.1)


def keys_of(lines):
    """Return the key and the value of each line `key = value: rule`."""
    return [line.split(": ")[0] for line in lines]


@pytest.mark.parametrize(
    ("changes", "given", "lines"),
    [
        ({}, PLANE, []),  # the rig of the paper
        ({"axes__guide_y": None}, PLANE, ["axes.guide_y"]),
        ({"axes__guide_y": None}, scenario(setup__guide_to_skin_mm=None), []),
        ({"axes__rotation": None}, PLANE, ["axes.rotation"]),
        ({"axes__insertion__range_mm": [0, 73]}, PLANE, ["axes.insertion.range_mm = [0.0, 73.0]"]),
        ({"axes__insertion__range_mm": [0, 110]}, scenario(target__depth_mm=80.0), []),  # the stroke
        ({"axes__insertion__speed_mm_s": 4}, PLANE, ["setup.insertion_speed_mm_s = 5.0"]),
        ({"axes__guide_y__range_mm": [-10, 20]}, PLANE, ["axes.guide_y.range_mm = [-10.0, 20.0]"]),
        ({"axes__guide_y__range_mm": [-16, 14.9]}, PLANE, ["axes.guide_y.range_mm = [-16.0, 14.9]"]),
        ({"axes__guide_y__backlash_mm": 0.04}, PLANE, []),  # within 0.02 mm of 0, the tolerance
        ({"axes__guide_y__backlash_mm": 0.1}, PLANE, ["axes.guide_y.range_mm = [-15.0, 15.0]"]),
        ({"axes__guide_y__speed_mm_s": 2}, PLANE, ["setup.max_guide_step_mm = 0.5"]),
        ({"axes__rotation__range_deg": [-170, 179.9]}, PLANE, ["axes.rotation.range_deg = [-170.0, 179.9]"]),
        (FREE_FROM_10, PLANE, ["axes.rotation.range_deg = [10.0, 200.0]"]),
        ({"loop__rate_hz": 20}, PLANE, ["loop.rate_hz = 20.0"]),
        ({}, scenario(setup__axes=2), ["axes.guide_z", "setup.max_rotation_deg"]),
        ({}, MOVING_BASE, ["axes.base_y"]),
        ({"axes__base_y": BASE}, MOVING_BASE, []),
        ({"axes__base_y": BASE | {"range_mm": [-5, 5]}}, MOVING_BASE, ["axes.base_y.range_mm = [-5.0, 5.0]"]),
        ({"axes__base_y": BASE | {"speed_mm_s": 1}}, MOVING_BASE, ["setup.max_base_step_mm = 0.5"]),
        ({}, scenario(plan__base_turn_sigma_mrad=1.0), ["plan.base_turn_sigma_mrad = 1.0"]),
        (FREE, scenario(SPACE, setup__max_rotation_deg=200.0), []),
        (FREE, scenario(SPACE, setup__rotation="half-turns"), []),
        (FREE, scenario(SPACE, setup__max_rotation_deg=None), ["setup.max_rotation_deg"]),
        (FREE, scenario(SPACE, setup__max_rotation_deg=201.0), ["setup.max_rotation_deg = 201.0"]),
        (FREE_FROM_10, scenario(SPACE), ["axes.rotation.range_deg = [10.0, 200.0]"]),
    ],
    ids=str,
)
def test_each_requirement_that_the_rig_does_not_meet_is_a_line(changes, given, lines):
    assert keys_of(fit_problems(rig(**changes), given)) == lines


def test_a_plan_that_steers_by_the_bevel_needs_neither_guide_nor_base():
    moving = scenario(plan__base_sigma_mm=0.1, plan__base_turn_sigma_mrad=1.0)
    assert fit_problems(rig(axes__guide_y=None), moving, "steering") == []


@given(st.floats(2.0, 500.0), st.floats(1.0, 60.0))
def test_the_target_fits_if_and_only_if_the_range_is_as_wide_as_the_advance_to_it(width, depth):
    found = fit_problems(rig(axes__insertion__range_mm=[0.0, width]), scenario(target__depth_mm=depth))
    assert bool(found) == (depth + 2.0 + 28.5 + 3.0 > width + 1e-9)


# Room from the present positions


@pytest.mark.parametrize(
    ("position", "line"),
    [
        (0.0, ""),
        (46.5, ""),  # 40 mm deep, 2 beyond, 28.5 before the skin, 3 sd of the start
        (46.53, "at 46.53 mm, 73.47 mm to the high end of range_mm (120): "),
        (-3.0, ""),
    ],
)
def test_an_insertion_axis_too_near_to_its_end_is_a_line(position, line):
    found = room_problem(rig(), PLANE, position)
    assert found.startswith(line)
    assert bool(found) == bool(line)


HERE = {"insertion": 0.0, "rotation": 0.0, "guide_y": 0.0}


@pytest.mark.parametrize(
    ("positions", "advance", "lines"),
    [
        ({}, 120.0, []),
        ({"insertion": 50.0}, 70.5, ["insertion: at 50 mm, 70 mm to the high end"]),
        (
            {"insertion": -1.0, "rotation": math.radians(195)},
            70.5,
            ["insertion: at -1 mm: beyond the soft limits", "rotation: at 195 deg: beyond the soft limits"],
        ),
        ({"guide_y": 2.5}, 70.5, ["guide_y: at 2.5 mm: must be within 0.02 mm of 0"]),
    ],
)
def test_an_axis_from_which_an_insertion_cannot_begin_is_a_line(positions, advance, lines):
    found = start_problems(rig(), PLANE, HERE | positions, advance)
    assert [line[: len(start)] for line, start in zip(found, lines, strict=True)] == lines


def test_a_position_may_be_beyond_the_limits_by_half_the_backlash():
    """The direction of the lost motion is unknown before the first motion."""
    loose = rig(axes__insertion__backlash_mm=0.05)
    for position, begins in ((-0.025, True), (-0.05, False)):
        for one, may in ((loose, begins), (rig(), False)):
            found = start_problems(one, PLANE, HERE | {"insertion": position}, 70.0)
            assert (found == []) == may


def test_the_queue_is_the_largest_speed_times_its_time_within_its_distance():
    changes = {"axes__insertion__speed_mm_s": 12.0, "axes__guide_y__tolerance_mm": 0.13}
    assert dict(describe_queues(rig(loop__queue_ms=50, **changes))) == {
        "insertion": "0.5 mm (loop.queue_mm)",
        "rotation": "18 deg (360 deg/s × 50 ms)",
        "guide_y": "0.26 mm (twice tolerance_mm)",
    }
    assert dict(describe_queues(rig(loop__queue_ms=50)))["guide_y"] == "0.25 mm (5 mm/s × 50 ms)"


def test_the_base_may_advance_from_the_tip_to_the_target_of_the_plan_within_the_stroke():
    assert deepest_advance(PLANE, 25.0, -31.0) == pytest.approx(25.0 + 2.0 + 31.0)
    # A virtual needle may begin three standard deviations behind the start.
    assert deepest_advance(PLANE, 25.0, None) == pytest.approx(25.0 + 2.0 + 28.5 + 3.0)
    steep = math.sqrt(1.0 + 0.05**2)
    assert needed_advance(TILTED, 25.0, -31.0) == pytest.approx(steep * (25.0 + 2.0 + 31.0))
    assert needed_advance(TILTED, 80.0, -31.0) == pytest.approx(steep * 110.0)
