"""The bevel rule against paths that are followed in small steps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle.control.bang_bang import choose_roll, closest_approach

POSES = {
    "straight ahead": ((0.0, 0.0, 0.0), (40.0, 0.0)),
    "lateral": ((0.0, 0.0, 0.0), (40.0, 5.0)),
    "on the way": ((12.0, 1.5, 0.1), (40.0, 5.0)),
    "turned away": ((20.0, -2.0, -0.3), (45.0, 5.0)),
    "close": ((39.0, 4.8, 0.05), (40.0, 5.0)),
    "within the circle": ((0.0, 0.0, 0.0), (3.0, 30.0)),
    "steep": ((0.0, 0.0, 1.2), (5.0, 25.0)),
}


def at(x, y, theta):
    """A pose (5,) in the plane."""
    return np.array([x, y, 0.0, theta, 0.0])


def nearest(pose, curvature, target):
    """`closest_approach` in the plane, for a curvature (1/mm) to either side."""
    return closest_approach(pose, abs(curvature), math.copysign(1.0, curvature), (*target, 0.0))


def wants_flip(pose, bevel, curvature, target, band, noise):
    """Return whether the rule rolls the bevel, and the reason."""
    roll, why = choose_roll(pose, bevel, curvature, (*target, 0.0), band, noise)
    assert roll in (0.0, math.pi)
    return roll > 0.0, why


def followed(pose, curvature, target, step=1e-3):
    """Least distance to the target of paper eq. 14, x += u cos θ, y += u sin θ, θ += κ u, in small steps u."""
    reach = 2.0 * math.dist(pose[:2], target) + 1.0
    theta = pose[2] + curvature * step * (np.arange(int(reach / step)) + 0.5)
    x = pose[0] + step * np.concatenate([[0.0], np.cumsum(np.cos(theta))])
    y = pose[1] + step * np.concatenate([[0.0], np.cumsum(np.sin(theta))])
    return float(np.hypot(x - target[0], y - target[1]).min())


@pytest.mark.parametrize("curvature", [0.0, 1e-9, 5e-4, -5e-4, 0.01, -0.01, 0.06])
@pytest.mark.parametrize(("pose", "target"), POSES.values(), ids=POSES)
def test_closest_approach_is_that_of_the_path_in_small_steps(pose, target, curvature):
    expected = followed(pose, curvature, target)
    assert nearest(at(*pose), curvature, target) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("curvature", [-0.01, 0.0, 0.01])
def test_a_target_behind_is_as_near_as_it_is_now(curvature):
    assert nearest(at(40.0, 5.0, 0.0), curvature, (37.0, 1.0)) == pytest.approx(5.0)
    backwards = at(0.0, 0.0, math.pi)
    assert nearest(backwards, curvature, (3.0, 4.0)) == pytest.approx(5.0)


@given(
    x=st.floats(-10, 60), y=st.floats(-10, 10), theta=st.floats(-0.5, 0.5),
    lateral=st.floats(-15, 15), bevel=st.sampled_from([-1, 1]), curvature=st.floats(0, 0.02),
)  # fmt: skip
@hypothesis_settings(max_examples=200)
def test_mirrored_pose_target_and_bevel_give_the_same_answer(x, y, theta, lateral, bevel, curvature):
    here = wants_flip(at(x, y, theta), bevel, curvature, (40.0, lateral), 0.3, 0.01)
    mirrored = wants_flip(at(x, -y, -theta), -bevel, curvature, (40.0, -lateral), 0.3, 0.01)
    assert here == mirrored


def flips(bevel, target, *, band=0.0, noise=0.0, curvature=0.001, pose=(0.0, 0.0, 0.0)):
    return wants_flip(at(*pose), bevel, curvature, target, band, noise)[0]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_bevel_rolls_towards_the_target_and_stays_there(side):
    assert flips(-1, (40.0, 3.0)) is True
    assert flips(1, (40.0, 3.0)) is False
    assert flips(1, (40.0, -3.0)) is True
    assert flips(-1, (40.0, -3.0)) is False
    # What counts is where the tip's own line meets the target, not the side of the axis.
    assert flips(1, (40.0, 3.0 * side), pose=(0.0, 0.0, 0.2)) is True
    assert flips(1, (40.0, 3.0 * side), pose=(0.0, 0.0, -0.2)) is False


def test_dead_band_is_a_share_of_the_separation_of_the_paths():
    """κ = 1/m, 40 mm ahead: the paths pass 0.8 mm lateral each, 1.6 mm apart. With the target at −y the other
    path is nearer by 2y, until it is beyond it: 1.2 mm of advantage at −0.6 mm are 0.75 of the separation."""
    assert flips(1, (40.0, -0.6), band=0.70) is True
    assert flips(1, (40.0, -0.6), band=0.80) is False
    assert flips(1, (40.0, -5.0), band=0.95) is True
    # A quarter of the distance: the same share at a sixteenth of the offset.
    assert flips(1, (10.0, -0.6 / 16), band=0.70) is True
    assert flips(1, (10.0, -0.6 / 16), band=0.80) is False


def test_the_noise_of_the_tracker_widens_the_dead_band():
    assert flips(1, (40.0, -0.6), noise=0.55) is True
    assert flips(1, (40.0, -0.6), noise=0.65) is False
    assert flips(1, (40.0, -0.6), band=0.35, noise=0.3) is True  # 0.35 · 0.8 + 0.3 < 0.6
    assert flips(1, (40.0, -0.6), band=0.45, noise=0.3) is False


def test_a_target_far_off_the_line_rolls_the_bevel_however_near_it_is():
    """The two paths part by 0.025 mm over the last 5 mm; a gain of that size can't be asked for."""
    assert flips(1, (5.0, -0.3), band=0.8, noise=0.12) is True
    assert flips(1, (5.0, -0.1), band=0.8, noise=0.12) is False


def test_without_advantage_or_curvature_or_with_the_target_behind_the_bevel_stays():
    assert flips(1, (40.0, 0.0)) is False
    assert flips(1, (40.0, -3.0), curvature=0.0) is False
    assert flips(1, (-1.0, -3.0)) is False


def test_reason_gives_both_misses():
    """±0.8 mm at 40 mm and a target 0.6 mm to the other side."""
    flip, why = wants_flip(np.zeros(5), 1, 0.001, (40.0, -0.6), 0.0, 0.0)
    assert flip
    assert why == "bevel rolled: predicted miss 1.399 mm if kept, 0.200 mm if rolled"
    _, why = wants_flip(np.zeros(5), -1, 0.001, (40.0, -0.6), 0.0, 0.0)
    assert why == "bevel kept: predicted miss 0.200 mm if kept, 1.399 mm if rolled"
