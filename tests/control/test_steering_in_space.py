"""The bevel in space: kinematic paths, the rule that rolls it, and the range of the driver's rotation."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.control.bang_bang import choose_roll, closest_approach, target_from_tip
from flexneedle.control.limits import limit_roll
from flexneedle.scenario.files import load_scenario

SLOPES = st.floats(-0.4, 0.4)
ANGLES = st.floats(-math.pi, math.pi)
PLACES = st.floats(-6.0, 6.0)
AHEAD = st.floats(5.0, 60.0)
SPACE = load_scenario("phantom").with_values({"setup.axes": 2})


def tangent(theta, psi):
    """The needle's axis: tilted from x by √(θ² + ψ²) in the direction (θ, ψ)."""
    angle = math.hypot(theta, psi)
    share = math.sin(angle) / angle if angle else 1.0
    return np.array([math.cos(angle), share * theta, share * psi])


def normal(theta, psi, bevel):
    """The bevel's direction across the axis: turned with it by the smallest rotation."""
    x, across = tangent(theta, psi), np.array([0.0, bevel.real, bevel.imag])
    old = np.array([1.0, 0.0, 0.0])
    return across - (across @ x) / (1.0 + old @ x) * (old + x)


@given(theta=SLOPES, psi=SLOPES, roll=ANGLES, x=AHEAD, y=PLACES, z=PLACES, curvature=st.floats(0.0, 0.02))
def test_the_closest_approach_agrees_with_a_circle_in_space(theta, psi, roll, x, y, z, curvature):
    """It equals the least distance to points of the circle ahead of the tip."""
    bevel, pose = cmath.exp(1j * roll), np.array([0.0, 0.0, 0.0, theta, psi])
    axis, side = tangent(theta, psi), normal(theta, psi, bevel)
    along = np.linspace(0.0, 100.0, 20_001)[:, None]
    if curvature < 1e-9:
        path = along * axis
    else:
        turned = curvature * along
        path = (np.sin(turned) * axis + (1.0 - np.cos(turned)) * side) / curvature
    least = np.linalg.norm(path - np.array([x, y, z]), axis=1).min()
    assert closest_approach(pose, curvature, bevel, (x, y, z)) == pytest.approx(least, abs=3e-3)


@given(theta=SLOPES, psi=SLOPES, turn=ANGLES, x=AHEAD, y=PLACES, z=PLACES)
def test_the_target_from_the_tip_turns_with_everything(theta, psi, turn, x, y, z):
    by = cmath.exp(1j * turn)
    slope, place = complex(theta, psi) * by, complex(y, z) * by
    along, across = target_from_tip(np.array([0.0, 0.0, 0.0, theta, psi]), (x, y, z))
    turned = target_from_tip(np.array([0.0, 0.0, 0.0, slope.real, slope.imag]), (x, place.real, place.imag))
    assert turned[0] == pytest.approx(along, abs=1e-12)
    assert turned[1] == pytest.approx(across * by, abs=1e-12)


@given(roll=ANGLES, y=PLACES, z=PLACES)
def test_a_needle_that_rolls_freely_aims_at_the_target_or_away_from_it(roll, y, z):
    """Without a dead band the chosen path passes no farther from the target than any other."""
    pose, bevel, target = np.zeros(5), cmath.exp(1j * roll), (30.0, y, z)
    angle, why = choose_roll(pose, bevel, 0.004, target, 0.0, 0.0, within=float)
    chosen = closest_approach(pose, 0.004, bevel * cmath.exp(1j * angle), target)
    others = [
        closest_approach(pose, 0.004, cmath.exp(1j * other), target) for other in np.linspace(0.0, 6.3, 64)
    ]
    # A roll below the least, 0.1 rad, is not made: it moves the end by that share of ½κs².
    assert chosen <= min(others) + (0.1 * 0.5 * 0.004 * 30.0**2 * 1.1 if angle == 0.0 else 1e-9)
    assert ("rolled" if angle else "kept") in why


@given(roll=ANGLES, y=PLACES, z=PLACES, band=st.floats(0.0, 1.0), noise=st.floats(0.0, 0.2))
def test_within_the_dead_band_the_bevel_is_kept(roll, y, z, band, noise):
    """The band is for the target's distance from the tip's line; a roll gains at least a quarter of its share."""
    bevel, target = cmath.exp(1j * roll), (30.0, y, z)
    angle, _ = choose_roll(np.zeros(5), bevel, 0.004, target, band, noise, within=float)
    best, _ = choose_roll(np.zeros(5), bevel, 0.004, target, 0.0, 0.0, within=float)
    keep, rolled = (
        closest_approach(np.zeros(5), 0.004, bevel * cmath.exp(1j * one), target) for one in (0.0, best)
    )
    half = 0.5 * 0.004 * (30.0**2 + y**2 + z**2)
    margins = math.hypot(y, z) - band * half - noise, keep - rolled - 0.25 * band * half
    if min(map(abs, margins)) > 1e-9:
        assert (angle != 0.0) == (best != 0.0 and min(margins) > 0.0)


def test_where_the_driver_cannot_aim_the_best_possible_roll_is_made_or_none():
    """The target is behind the bevel, and the driver turns it by at most 60°."""
    pose, target = np.zeros(5), (30.0, -3.0, 0.5)
    angle, _ = choose_roll(
        pose, 1.0 + 0.0j, 0.004, target, 0.0, 0.0, within=lambda roll: max(-1.0, min(1.0, roll))
    )
    assert abs(angle) == 1.0
    still, why = choose_roll(pose, 1.0 + 0.0j, 0.004, target, 0.0, 0.0, within=lambda _: 0.0)
    assert still == 0.0
    assert "kept" in why


def test_half_turns_are_all_that_the_papers_driver_is_asked_for():
    """The targets are in several directions."""
    for y, z in ((5.0, 0.0), (-5.0, 1.0), (0.5, 5.0)):
        angle, _ = choose_roll(np.zeros(5), 1.0 + 0.0j, 0.004, (30.0, y, z), 0.0, 0.0)
        assert angle in (0.0, math.pi)
    assert choose_roll(np.zeros(5), 1.0 + 0.0j, 0.004, (30.0, -5.0, 1.0), 0.0, 0.0)[0] == math.pi


@given(
    most=st.floats(45.0, 270.0), angle=st.floats(-1.0, 1.0), roll=ANGLES, other=st.floats(-1.0, 1.0),
)  # fmt: skip
def test_no_angle_in_the_range_is_nearer_in_direction(most, angle, roll, other):
    setup = SPACE.with_values({"setup.max_rotation_deg": most}).setup
    before = angle * setup.max_rotation
    wanted, after = before + roll, before + limit_roll(setup, before, roll)
    ends = (other * setup.max_rotation, -setup.max_rotation, setup.max_rotation)
    off, *others = (abs(math.remainder(one - wanted, 2.0 * math.pi)) for one in (after, *ends))
    assert abs(after) <= setup.max_rotation + 1e-12
    assert off <= min(others) + 1e-9


@given(most=st.floats(200.0, 720.0) | st.none(), angle=st.floats(-1.0, 1.0), roll=st.floats(-20.0, 20.0))
def test_a_roll_goes_the_short_way_round_where_it_can(most, angle, roll):
    """The long way only where the short one ends beyond the range."""
    setup = SPACE.with_values({} if most is None else {"setup.max_rotation_deg": most}).setup
    before = angle * min(setup.max_rotation, 10.0)
    turn = limit_roll(setup, before, roll)
    assert abs(math.remainder(turn - roll, 2.0 * math.pi)) < 1e-8
    short = math.remainder(roll, 2.0 * math.pi)
    if abs(turn) > math.pi + 1e-9:
        assert abs(before + short) > setup.max_rotation
    assert abs(turn) < 2.0 * math.pi + 1e-9
