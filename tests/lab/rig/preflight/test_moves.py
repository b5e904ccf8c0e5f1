"""Motions of an operator: within the soft limits, in the units of the axis."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench_rig import rig
from flexneedle.errors import InputError
from flexneedle.lab.rig.preflight.moves import (
    describe_axes,
    plan_homings,
    plan_jog,
    plan_retraction,
)

RIG = rig()


@pytest.mark.parametrize(
    ("name", "distance", "position", "goal", "speed"),
    [
        ("insertion", "5", 10.0, 15.0, 2.0),
        ("insertion", "-5mm", 10.0, 5.0, 2.0),
        ("insertion", "+1e1 mm", 10.0, 20.0, 2.0),
        ("insertion", "110", 10.0, 120.0, 2.0),
        ("insertion", "3", -5.0, -2.0, 2.0),  # from beyond the limits, back
        ("rotation", "180deg", 0.0, math.pi, math.radians(72)),
        ("rotation", "-10°", 0.0, -math.pi / 18, math.radians(72)),
        ("guide_y", ".5", -15.0, -14.5, 1.0),
    ],
)
def test_a_jog_ends_at_the_distance_from_the_start(name, distance, position, goal, speed):
    move = plan_jog(RIG, name, distance, position)
    assert (move.start, move.goal, move.speed) == pytest.approx((position, goal, speed))


@pytest.mark.parametrize(
    ("name", "distance", "position", "line"),
    [
        ("insertion", "110.01", 10.0, "insertion to 120.01 mm: beyond the soft limits, 0 to 120 mm"),
        ("insertion", "-10.01", 10.0, "insertion to -0.01 mm: beyond the soft limits"),
        ("insertion", "150", -5.0, "insertion to 145 mm: beyond the soft limits"),
        ("rotation", "191deg", 0.0, "rotation to 191 deg: beyond the soft limits, -10 to 190 deg"),
        ("insertion", "5deg", 0.0, "distance '5deg': the unit of insertion is mm"),
        ("insertion", "1e999", 0.0, "distance '1e999': must be a number"),
        ("insertion", "0.0009", 0.0, "distance '0.0009': must be at least one count of insertion"),
        ("guide_z", "1", 0.0, "axis 'guide_z': must be one of insertion, rotation, guide_y"),
        ("insertion", "1", math.nan, "insertion: its position is not a number"),
    ],
)
def test_a_jog_beyond_a_limit_or_in_another_unit_is_refused(name, distance, position, line):
    with pytest.raises(InputError) as caught:
        plan_jog(RIG, name, distance, position)
    assert str(caught.value).startswith(line)


def test_speeds_are_in_the_unit_of_the_axis_and_at_most_its_own():
    for name, speed, expected in (("insertion", 10.0, 10.0), ("rotation", 90.0, math.pi / 2)):
        assert plan_jog(RIG, name, "5", 0.0, speed).speed == pytest.approx(expected)
    assert plan_retraction(RIG, 30.0, None, 0.5).speed == 0.5
    for speed in (10.01, 0.0, -1.0, math.nan):
        for plan in (
            lambda speed: plan_jog(RIG, "insertion", "5", 0.0, speed),
            lambda speed: plan_retraction(RIG, 30.0, None, speed),
        ):
            with pytest.raises(InputError, match="must be above 0 and at most 10, speed_mm_s of insertion"):
                plan(speed)


@given(st.floats(-200, 200), st.floats(-300, 300))
def test_no_jog_moves_further_beyond_the_limits(position, distance):
    try:
        move = plan_jog(RIG, "insertion", repr(distance), position)
    except InputError:
        return
    outside = [max(0.0, -x, x - 120.0) for x in (position, move.goal)]
    assert outside[1] <= outside[0] + 1e-6


@pytest.mark.parametrize(
    ("changes", "to", "goal"),
    [
        ({}, None, 2.4),  # where homing leaves the base: 2 % of the range
        ({}, 10.0, 10.0),
        ({}, 0.2, 0.2),
        ({"home_mm": -3.0}, None, 2.4),
        ({"home": "here"}, None, 0.0),
        ({"home": "absolute"}, None, 0.0),
        ({"home": "forward-limit", "home_mm": 120.0}, None, 0.0),
        ({"home": "forward-limit", "direction": -1}, None, 2.4),
    ],
)
def test_a_retraction_ends_off_the_switch_behind_the_base_or_at_its_lowest_position(changes, to, goal):
    made = rig(**{f"axes__insertion__{key}": value for key, value in changes.items()})
    move = plan_retraction(made, 30.0, to)
    assert (move.name, move.start, move.goal, move.speed) == ("insertion", 30.0, pytest.approx(goal), 2.0)
    assert plan_retraction(made, goal, None) is None or to is not None


@given(home=st.floats(-20.0, 0.0), most=st.none() | st.floats(0.1, 5.0), to=st.none() | st.floats(-1.0, 30.0))
def test_no_retraction_ends_where_the_base_may_be_at_the_switch(home, most, to):
    most = {} if most is None else {"axes__insertion__max_error_mm": most}
    found = rig(axes__insertion__home_mm=home, **most)
    try:
        move = plan_retraction(found, 30.0, to)
    except InputError:
        return
    assert move.goal >= max(0.0, home + min(found.axes.insertion.max_error, 2.4)) - 1e-6


@pytest.mark.parametrize(
    ("to", "line"),
    [
        (30.0, "to 30 mm: must be below 30 mm, the present position: the axis only retracts"),
        (31.0, "to 31 mm: must be below 30 mm"),
        (-1.0, "insertion to -1 mm: beyond the soft limits"),
        (0.19, "to 0.19 mm: must be at least 0.2 mm: the reverse limit switch is at 0 mm"),
        (math.inf, "insertion: its position is not a number"),
    ],
)
def test_a_retraction_never_moves_forwards_or_beyond_a_limit(to, line):
    with pytest.raises(InputError) as caught:
        plan_retraction(RIG, 30.0, to)
    assert str(caught.value).startswith(line)


def test_axes_without_absolute_encoders_are_homed_in_the_order_of_the_file():
    for names in (["rotation", "insertion"], []):
        assert [homing.name for homing in plan_homings(RIG, names)] == ["insertion", "rotation"]
    with pytest.raises(InputError, match='axis guide_y: has home = "absolute"'):
        plan_homings(RIG, ["guide_y"])
    with pytest.raises(InputError, match="axis 'guide_x': must be one of insertion, rotation, guide_y"):
        plan_homings(RIG, ["guide_x"])


def test_a_motion_is_described_in_one_line_with_its_uncertainty():
    turned = rig(axes__insertion__direction=-1, axes__insertion__home_mm=121.5)
    search = str(plan_homings(turned, ["insertion"])[0])
    numbers = ("133.5 mm", "1 mm/s", "121.5 mm", "3.9 mm", "117.6 mm")
    assert sorted(numbers, key=search.index) == list(numbers)
    assert (search.count("positive"), search.count("negative"), search.count("\n")) == (1, 2, 0)
    assert "does not move" in str(plan_homings(RIG, ["rotation"])[0])
    loose = rig(axes__insertion__backlash_mm=0.1, axes__rotation__backlash_deg=0.9)
    jog = str(plan_jog(loose, "insertion", "5", 10.0))
    assert jog.startswith(
        "insertion: from 10 to 15 mm (5 mm), at most at 2 mm/s; the start is uncertain by 0.05 mm"
    )
    base, turn, guide = describe_axes(loose, {"insertion": 10.0, "rotation": 0.0, "guide_y": 0.0})
    assert base.startswith(
        "insertion: at 10 mm, moves at most at 7.81 mm/s; the start is uncertain by 0.05 mm"
    )
    assert "uncertain by 0.45 deg" in turn
    assert guide == "guide_y: at 0 mm, moves at most at 5 mm/s"


@pytest.mark.parametrize(("to", "what"), [(True, "position"), (False, "distance")])
@pytest.mark.parametrize("text", ["0deg", "nan", "1,5mm", ""])
def test_a_wrong_text_is_named_as_what_it_is(text, to, what):
    with pytest.raises(InputError, match=f"^{what} '{text}': (must be a number|the unit of insertion is mm)"):
        plan_jog(RIG, "insertion", text, 0.0, to=to)
