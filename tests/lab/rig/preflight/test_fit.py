"""A rig that cannot do what a scenario needs is reported before anything is connected."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench_rig import VALUES, rig
from flexneedle.lab.rig.preflight.fit import describe_queues, fit_problems, room_problems, start_problems
from flexneedle.scenario.files import load_scenario

PLANE, SPACE = load_scenario("phantom"), load_scenario("phantom3d")
GUIDE_Z = {**VALUES["axes"]["guide_y"], "channel": "D"}


def in_space(**changes):
    """A rig for needles in space that roll to any angle."""
    return rig(axes__guide_z=GUIDE_Z, axes__rotation__range_deg=[-200, 200], **changes)


def scenario(base=PLANE, **changes):
    return base.with_values({key.replace("__", "."): value for key, value in changes.items()})


def test_the_rig_of_the_paper_does_what_the_paper_needs():
    assert fit_problems(rig(), PLANE) == []


def test_a_rig_in_space_does_what_a_driver_of_any_angle_needs():
    assert fit_problems(in_space(), scenario(SPACE, setup__max_rotation_deg=200.0)) == []
    assert fit_problems(in_space(), scenario(SPACE, setup__rotation="half-turns")) == []


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"axes__guide_y": None}, "axes.guide_y: missing: the guide moves"),
        ({"axes__rotation": None}, "axes.rotation: missing: the needle is rolled (bevel flips)"),
        (
            {"axes__insertion__range_mm": [0, 73]},
            "axes.insertion.range_mm = [0.0, 73.0]: must be at least 73.5 wide: the advance to guard.past_target_mm "
            "= 2 past the target is 73.5 mm",
        ),
        (
            {"axes__insertion__speed_mm_s": 4},
            "setup.insertion_speed_mm_s = 5.0: must be at most 4, axes.insertion.speed_mm_s",
        ),
        (
            {"axes__guide_y__range_mm": [-10, 19]},
            "axes.guide_y.range_mm = [-10.0, 19.0]: must be at least 30 wide: setup.max_guide_travel_mm is 15, "
            "to either side",
        ),
        (
            {"axes__guide_y__speed_mm_s": 2},
            "setup.max_guide_step_mm = 0.5: must be at most 0.4: axes.guide_y.speed_mm_s is 2, and a step lasts 0.2 s "
            "(setup.max_advance_mm at setup.insertion_speed_mm_s)",
        ),
        (
            {"axes__rotation__range_deg": [-170, 179.9]},
            "axes.rotation.range_deg = [-170.0, 179.9]: must include 0 to 180: the needle rolls by half turns "
            "(setup.axes = 1)",
        ),
        (
            {"axes__rotation__range_deg": [1, 181], "axes__rotation__home_deg": 1},
            "axes.rotation.range_deg = [1.0, 181.0]: must include 0 to 180: the needle rolls by half turns "
            "(setup.axes = 1)",
        ),
        (
            {"loop__rate_hz": 20},
            "loop.rate_hz = 20.0: must be at least 40, tracker.rate_hz of the scenario: readings would wait for a tick",
        ),
    ],
    ids=str,
)
def test_what_the_rig_lacks_is_a_line(changes, line):
    assert fit_problems(rig(**changes), PLANE) == [line]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"setup__axes": 2}, "axes.guide_z: missing: the guide moves on 2 axes"),
        (
            {"plan__base_sigma_mm": 0.1},
            "axes.base_y: missing: the base moves laterally with plan.base_sigma_mm = 0.1",
        ),
        (
            {"plan__base_turn_sigma_mrad": 1.0},
            "plan.base_turn_sigma_mrad = 1.0: must be 0: no axis of a rig rotates the base",
        ),
    ],
    ids=str,
)
def test_what_the_scenario_moves_needs_an_axis(changes, line):
    assert line in fit_problems(rig(axes__rotation__range_deg=[-200, 200]), scenario(**changes))


def test_base_axes_are_checked_like_those_of_the_guide():
    base = {**VALUES["axes"]["guide_y"], "channel": "E", "range_mm": [-5, 5], "speed_mm_s": 1}
    lines = fit_problems(rig(axes__base_y=base), scenario(plan__base_sigma_mm=0.1))
    assert [line.split(" = ")[0] for line in lines] == ["axes.base_y.range_mm", "setup.max_base_step_mm"]
    assert fit_problems(rig(axes__base_y={**base, "range_mm": [-15, 15], "speed_mm_s": 5}), PLANE) == []


@pytest.mark.parametrize(
    ("limit", "line"),
    [
        (
            None,
            "setup.max_rotation_deg: not set: must be at most 200, axes.rotation.range_deg is -200 to 200",
        ),
        (
            201.0,
            "setup.max_rotation_deg = 201.0: must be at most 200, axes.rotation.range_deg is -200 to 200",
        ),
    ],
)
def test_rolls_to_any_angle_stay_within_the_range_of_the_motor(limit, line):
    assert fit_problems(in_space(), scenario(SPACE, setup__max_rotation_deg=limit)) == [line]


def test_a_rotation_that_never_is_0_cannot_start():
    found = rig(axes__guide_z=GUIDE_Z, axes__rotation__range_deg=[10, 200], axes__rotation__home_deg=10)
    assert fit_problems(found, scenario(SPACE, setup__max_rotation_deg=90.0)) == [
        "axes.rotation.range_deg = [10.0, 200.0]: must include 0, the needle's angle at the start"
    ]


def test_a_plan_that_steers_by_the_bevel_needs_neither_guide_nor_base():
    moving = scenario(plan__base_sigma_mm=0.1, plan__base_turn_sigma_mrad=1.0)
    assert fit_problems(rig(axes__guide_y=None), moving, "steering") == []


def test_a_needle_without_a_guide_needs_none():
    assert fit_problems(rig(axes__guide_y=None), scenario(setup__guide_to_skin_mm=None)) == []


@pytest.mark.parametrize(
    ("positions", "lines"),
    [
        ({"insertion": 0.0, "guide_y": 0.0, "rotation": 3.0}, []),
        ({"insertion": 46.5}, []),  # 40 mm deep, 2 beyond, 28.5 before the skin, 3 sd of the start
        (
            {"insertion": 46.53},
            [
                "at 46.53 mm, 73.47 mm to the high end of range_mm (120): the advance to guard.past_target_mm = 2 "
                "past the target is 73.5 mm"
            ],
        ),
        ({"insertion": -3.0}, []),
        (
            {"guide_y": -1.0},
            [
                "at -1 mm, 14 mm to the low end of range_mm (-15): setup.max_guide_travel_mm is 15, to either side; "
                "jog it to 0 mm"
            ],
        ),
        ({"guide_y": 0.019}, []),  # within the tolerance of a motion that has ended
        (
            {"guide_y": 17.0},
            [
                "at 17 mm, 0 mm to the high end of range_mm (15): setup.max_guide_travel_mm is 15, to either side; "
                "jog it to 0 mm"
            ],
        ),
    ],
    ids=str,
)
def test_an_axis_too_near_to_its_end_is_a_line(positions, lines):
    assert [line for _, line in room_problems(rig(), PLANE, positions)] == lines


def test_an_axis_with_too_little_range_cannot_be_jogged_to_a_better_place():
    narrow = rig(axes__guide_y__range_mm=[-10.0, 15.0])
    assert [line[-14:] for _, line in room_problems(narrow, PLANE, {"guide_y": 2.0})] == [
        "to either side"
    ] * 2


@pytest.mark.parametrize(
    ("low", "backlash", "remedy"),
    [
        (-16.0, 0.0, "jog it between -1 and 0 mm"),
        (-16.0, 0.1, "jog it between -1 and 0 mm"),
        (-15.0, 0.04, "jog it to 0 mm"),  # found within 0.02 mm of it, the tolerance
        (
            -15.0,
            0.1,
            "range_mm must be 30.06 mm wide: with its backlash the position is uncertain by 0.05 mm",
        ),
        (-15.06, 0.1, "jog it between -0.06 and 0 mm"),
    ],
)
def test_it_is_said_where_to_jog_an_axis_or_why_no_jog_helps(low, backlash, remedy):
    """At the place that is named an insertion may begin, also where the position is off by half of the backlash."""
    given = rig(axes__guide_y__range_mm=[low, 15.0], axes__guide_y__backlash_mm=backlash)
    (line,) = [line for _, line in room_problems(given, PLANE, {"guide_y": 2.0})]
    assert line.endswith(f"; {remedy}")
    if remedy.startswith("jog"):
        middle = 0.5 * (low + 15.0)
        for off in (-0.5, 0.0, 0.5):
            assert room_problems(given, PLANE, {"guide_y": middle + off * backlash}) == []


def test_what_is_queued_is_the_largest_speed_times_the_queue_within_its_distance():
    changes = {"axes__insertion__speed_mm_s": 12.0, "axes__guide_y__tolerance_mm": 0.13}
    found = dict(describe_queues(rig(loop__queue_ms=50, **changes)))
    assert found == {
        "insertion": "0.5 mm (loop.queue_mm)",
        "rotation": "18 deg (360 deg/s × 50 ms)",
        "guide_y": "0.26 mm (twice tolerance_mm)",
    }
    assert dict(describe_queues(rig(loop__queue_ms=50)))["guide_y"] == "0.25 mm (5 mm/s × 50 ms)"


HERE = {"insertion": 0.0, "rotation": 0.0, "guide_y": 0.0}


@pytest.mark.parametrize(
    ("positions", "advance", "lines"),
    [
        ({}, 120.0, []),
        (
            {"insertion": 50.0},
            70.5,
            [
                "insertion: at 50 mm, 70 mm to the high end of range_mm (120): the advance to guard.past_target_mm "
                "= 2 past the target is 70.5 mm"
            ],
        ),
        (
            {"insertion": -1.0, "rotation": math.radians(195)},
            70.5,
            [
                "insertion: at -1 mm: beyond the soft limits, 0 to 120 mm: jog it back",
                "rotation: at 195 deg: beyond the soft limits, -10 to 190 deg: jog it back",
            ],
        ),
        (
            {"guide_y": 2.5},
            70.5,
            [
                "guide_y: at 2.5 mm, 12.5 mm to the high end of range_mm (15): setup.max_guide_travel_mm is 15, "
                "to either side; jog it to 0 mm"
            ],
        ),
    ],
    ids=str,
)
def test_an_axis_from_which_an_insertion_cannot_begin_is_a_line(positions, advance, lines):
    assert start_problems(rig(), PLANE, HERE | positions, "manipulation", advance) == lines


def test_an_axis_may_seem_beyond_its_limits_by_half_its_backlash():
    """As after a retraction to the end of its range: the side of the lost motion is unknown before the first motion."""
    loose = rig(axes__insertion__backlash_mm=0.05)
    for position, begins in ((-0.025, True), (-0.05, False)):
        for one, may in ((loose, begins), (rig(), False)):
            assert (
                start_problems(one, PLANE, HERE | {"insertion": position}, "manipulation", 70.0) == []
            ) == may


def test_a_plan_that_steers_by_the_bevel_begins_from_any_position_of_the_guide():
    assert start_problems(rig(), PLANE, HERE | {"guide_y": 2.5}, "steering", 70.5) == []


@given(st.floats(2.0, 500.0), st.floats(1.0, 60.0))
def test_the_target_fits_if_and_only_if_the_range_is_as_wide_as_the_advance_to_it(width, depth):
    found = fit_problems(rig(axes__insertion__range_mm=[0.0, width]), scenario(target__depth_mm=depth))
    assert bool(found) == (depth + 2.0 + 28.5 + 3.0 > width + 1e-9)


def test_no_more_than_the_stroke_is_needed():
    deep = scenario(target__depth_mm=80.0)  # 2 mm beyond it are beyond the stroke
    assert fit_problems(rig(axes__insertion__range_mm=[0.0, 110.0]), deep) == []
