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
def test_closest_approach_agrees_with_a_path_in_small_steps(pose, target, curvature):
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


@pytest.mark.parametrize(
    ("rolls", "bevel", "target", "changes"),
    [
        # Towards the target, where it stays.
        (True, -1, (40.0, 3.0), {}), (False, 1, (40.0, 3.0), {}),
        (True, 1, (40.0, -3.0), {}), (False, -1, (40.0, -3.0), {}),
        # By the tip's own line, not by the side of the axis.
        (True, 1, (40.0, -3.0), {"theta": 0.2}), (True, 1, (40.0, 3.0), {"theta": 0.2}),
        (False, 1, (40.0, -3.0), {"theta": -0.2}), (False, 1, (40.0, 3.0), {"theta": -0.2}),
        # κ = 1/m: 40 mm ahead the paths are 1.6 mm apart. At y = −0.6 mm the other one is nearer by 1.2 mm: 0.75.
        (True, 1, (40.0, -0.6), {"band": 0.7}), (False, 1, (40.0, -0.6), {"band": 0.8}),
        (True, 1, (40.0, -5.0), {"band": 0.95}),
        # A quarter of the distance: the same share at a sixteenth of the offset.
        (True, 1, (10.0, -0.6 / 16), {"band": 0.7}), (False, 1, (10.0, -0.6 / 16), {"band": 0.8}),
        # Noise widens the band: 0.35 · 0.8 mm + 0.3 mm < 0.6 mm < 0.45 · 0.8 mm + 0.3 mm.
        (True, 1, (40.0, -0.6), {"noise": 0.55}), (False, 1, (40.0, -0.6), {"noise": 0.65}),
        (True, 1, (40.0, -0.6), {"band": 0.35, "noise": 0.3}), (False, 1, (40.0, -0.6), {"band": 0.45, "noise": 0.3}),
        # Over the last 5 mm the paths part by 0.025 mm, too little to ask for as a gain.
        (True, 1, (5.0, -0.3), {"band": 0.8, "noise": 0.12}), (False, 1, (5.0, -0.1), {"band": 0.8, "noise": 0.12}),
        # No advantage, no curvature, the target behind the tip.
        (False, 1, (40.0, 0.0), {}), (False, 1, (40.0, -3.0), {"curvature": 0.0}), (False, 1, (-1.0, -3.0), {}),
    ],
)  # fmt: skip
def test_the_bevel_rolls_where_the_gain_is_beyond_the_dead_band(rolls, bevel, target, changes):
    given = {"theta": 0.0, "curvature": 0.001, "band": 0.0, "noise": 0.0} | changes
    pose = at(0.0, 0.0, given["theta"])
    found, _ = wants_flip(pose, bevel, given["curvature"], target, given["band"], given["noise"])
    assert found is rolls


def test_reason_gives_both_misses():
    """±0.8 mm at 40 mm and a target 0.6 mm to the other side."""
    flip, why = wants_flip(np.zeros(5), 1, 0.001, (40.0, -0.6), 0.0, 0.0)
    assert flip
    assert why == "bevel rolled: predicted miss 1.399 mm if kept, 0.200 mm if rolled"
    _, why = wants_flip(np.zeros(5), -1, 0.001, (40.0, -0.6), 0.0, 0.0)
    assert why == "bevel kept: predicted miss 0.200 mm if kept, 1.399 mm if rolled"
