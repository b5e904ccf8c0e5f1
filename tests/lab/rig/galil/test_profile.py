"""The emulated controller's motion profile against the closed forms of a trapezoid."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.emulators.galil.profile import (
    SAMPLE_S,
    MotionProfile,
    advance_profile,
    slow_to_rest,
)


def moved(profile, most=200_000):
    """The profiles after each sample until it rests."""
    after = []
    while not profile.at_rest:
        profile = advance_profile(profile)
        after.append(profile)
        assert len(after) < most
    return after


@pytest.mark.parametrize(("distance", "speed"), [(100.0, 25_000.0), (20_000.0, 5_000.0), (-7_000.0, 1_000.0)])
def test_a_move_takes_the_time_of_its_trapezoid(distance, speed):
    """Or of the triangle, if it is too short to reach its speed; to two samples."""
    acceleration, deceleration = 100_000.0, 50_000.0
    start = MotionProfile(goal=distance, speed=speed, acceleration=acceleration, deceleration=deceleration)
    after = moved(start)
    ramps = 0.5 * speed**2 * (1.0 / acceleration + 1.0 / deceleration)
    if abs(distance) > ramps:
        expected = speed / acceleration + speed / deceleration + (abs(distance) - ramps) / speed
    else:
        top = math.sqrt(2.0 * abs(distance) / (1.0 / acceleration + 1.0 / deceleration))
        expected = top / acceleration + top / deceleration
    assert after[-1].position == distance
    assert len(after) * SAMPLE_S == pytest.approx(expected, abs=0.05 * expected + 2.0 * SAMPLE_S)


@settings(max_examples=50)
@given(
    goals=st.lists(st.floats(-3_000.0, 3_000.0), min_size=1, max_size=4),
    waits=st.lists(st.integers(1, 200), min_size=4, max_size=4),
    speed=st.floats(2_000.0, 50_000.0),
    acceleration=st.floats(10_000.0, 1e6),
    deceleration=st.floats(10_000.0, 1e6),
)
def test_speed_and_acceleration_are_never_exceeded(goals, waits, speed, acceleration, deceleration):
    """Also with a goal that changes on the way, and it ends there. The last sample may end up to half a count off."""
    profile = MotionProfile(speed=speed, acceleration=acceleration, deceleration=deceleration)
    track = [profile]
    for goal, wait in zip(goals, waits, strict=False):
        profile = replace(profile, goal=goal)
        for _ in range(wait):
            profile = advance_profile(profile)
            track.append(profile)
    track += moved(profile)
    assert track[-1].position == pytest.approx(goals[-1])
    most = max(acceleration, deceleration) * SAMPLE_S
    for before, after in itertools.pairwise(track):
        assert abs(after.velocity) <= speed * (1.0 + 1e-9)
        twice = 2.0 if after.velocity == 0.0 else 1.0
        assert abs(after.velocity - before.velocity) <= twice * most * (1.0 + 1e-9)
        assert abs(after.position - before.position) <= speed * SAMPLE_S + 1.0


@pytest.mark.parametrize("velocity", [3_000.0, -800.0])
def test_a_stop_takes_the_distance_of_its_deceleration(velocity):
    profile = slow_to_rest(MotionProfile(velocity=velocity, goal=1e6, deceleration=40_000.0))
    after = moved(profile)
    expected = math.copysign(0.5 * velocity**2 / 40_000.0, velocity)
    assert after[-1].position == pytest.approx(expected, rel=1e-9)
    assert after[-1].velocity == 0.0
