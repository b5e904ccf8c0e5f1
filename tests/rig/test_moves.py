"""What an operator may command: within the soft limits, in the units of the axis."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench_rig import rig
from flexneedle.errors import InputError
from flexneedle.rig.moves import distance_of, homings, jog, retraction

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
    move = jog(RIG, name, distance, position)
    assert (move.start, move.goal, move.speed) == pytest.approx((position, goal, speed))


@pytest.mark.parametrize(
    ("name", "distance", "position", "line"),
    [
        (
            "insertion",
            "110.01",
            10.0,
            "insertion to 120.01 mm: beyond the soft limits, 0 to 120 mm; it is at 10 mm",
        ),
        ("insertion", "-10.01", 10.0, "insertion to -0.01 mm: beyond the soft limits"),
        ("insertion", "-1", -5.0, "insertion to -6 mm: beyond the soft limits, 0 to 120 mm; it is at -5 mm"),
        ("insertion", "150", -5.0, "insertion to 145 mm: beyond the soft limits"),
        ("rotation", "191deg", 0.0, "rotation to 191 deg: beyond the soft limits, -10 to 190 deg"),
        ("insertion", "5deg", 0.0, "distance '5deg': the unit of insertion is mm"),
        ("rotation", "5mm", 0.0, "distance '5mm': the unit of rotation is deg"),
        ("rotation", "1rad", 0.0, "distance '1rad': the unit of rotation is deg"),
        ("insertion", "five", 0.0, "distance 'five': must be a number, such as 5 or -5mm"),
        ("insertion", "1e999", 0.0, "distance '1e999': must be a number"),
        ("insertion", "nan", 0.0, "distance 'nan': must be a number"),
        ("insertion", "0", 0.0, "distance '0': must be at least one count of insertion"),
        ("insertion", "0.0009", 0.0, "distance '0.0009': must be at least one count of insertion"),
        ("guide_z", "1", 0.0, "axis 'guide_z': must be one of insertion, rotation, guide_y"),
        ("insertion", "1", math.nan, "insertion: its position is not a number"),
    ],
)
def test_another_jog_is_refused(name, distance, position, line):
    with pytest.raises(InputError) as caught:
        jog(RIG, name, distance, position)
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize(
    ("name", "speed", "taken"),
    [("insertion", 10.0, 10.0), ("insertion", 0.5, 0.5), ("rotation", 90.0, math.pi / 2)],
)
def test_a_jog_is_as_fast_as_asked(name, speed, taken):
    assert jog(RIG, name, "5", 0.0, speed).speed == pytest.approx(taken)


@pytest.mark.parametrize("speed", [10.01, 0.0, -1.0, math.nan])
def test_a_jog_faster_than_the_axis_is_refused(speed):
    with pytest.raises(InputError, match="must be above 0 and at most 10, speed_mm_s of insertion"):
        jog(RIG, "insertion", "5", 0.0, speed)


@settings(deadline=None)
@given(st.floats(-200, 200), st.floats(-300, 300))
def test_no_jog_goes_further_beyond_the_limits_than_it_is(position, distance):
    try:
        move = jog(RIG, "insertion", repr(distance), position)
    except InputError:
        return
    outside = [max(0.0, -x, x - 120.0) for x in (position, move.goal)]
    assert outside[1] <= outside[0] + 1e-6


@pytest.mark.parametrize(("to", "goal"), [(None, 0.0), (10.0, 10.0), (0.0, 0.0), (29.9, 29.9)])
def test_a_retraction_goes_back(to, goal):
    move = retraction(RIG, 30.0, to)
    assert (move.name, move.start, move.goal, move.speed) == ("insertion", 30.0, goal, 10.0)


@pytest.mark.parametrize(
    ("to", "line"),
    [
        (30.0, "to 30 mm: must be below 30 mm, where the insertion axis is: it only retracts"),
        (31.0, "to 31 mm: must be below 30 mm, where the insertion axis is: it only retracts"),
        (-1.0, "insertion to -1 mm: beyond the soft limits, 0 to 120 mm; it is at 30 mm"),
        (math.inf, "insertion: its position is not a number"),
    ],
)
def test_a_retraction_never_goes_forwards_or_beyond(to, line):
    with pytest.raises(InputError) as caught:
        retraction(RIG, 30.0, to)
    assert str(caught.value) == line


def test_axes_are_homed_in_the_order_of_the_file():
    assert [homing.name for homing in homings(RIG, ["rotation", "insertion"])] == ["insertion", "rotation"]
    assert [homing.name for homing in homings(RIG, [])] == ["insertion", "rotation"]  # guide_y is absolute


def test_an_absolute_encoder_is_not_homed():
    with pytest.raises(InputError, match='axis guide_y: has home = "absolute": its encoder needs no homing'):
        homings(RIG, ["guide_y"])
    with pytest.raises(InputError, match="axis 'guide_x': must be one of insertion, rotation, guide_y"):
        homings(RIG, ["guide_x"])


def test_what_would_move_is_a_line():
    turned = rig(axes__insertion__direction=-1, axes__insertion__home_mm=121.5)
    lines = [str(homing) for homing in (*homings(RIG, []), *homings(turned, ["insertion"]))]
    assert lines == [
        "insertion: in its negative direction to the reverse limit switch, at most at 10 mm/s; "
        "the position there is called 0 mm",
        "rotation: stays where it is, and its position is called 0 deg",
        "insertion: in its positive direction to the reverse limit switch, at most at 10 mm/s; "
        "the position there is called 121.5 mm",
    ]
    assert str(jog(RIG, "rotation", "90", 0.0)) == "rotation: from 0 to 90 deg, at most at 72 deg/s"
    assert retraction(RIG, 0.0) is retraction(RIG, -0.5) is None, "it is there"
    assert str(retraction(RIG, 30.0)) == "insertion: from 30 to 0 mm, at most at 10 mm/s"


@settings(deadline=None)
@given(st.floats(-1e5, 1e5), st.sampled_from(["", "mm", " mm"]))
def test_a_distance_is_the_number_that_is_written(value, unit):
    assert distance_of(f"{value!r}{unit}", "insertion", RIG.axes.insertion) == value
