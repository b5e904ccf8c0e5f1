"""The default controller in space: where it aims, what the bevel can still reach, and its predicted deviations."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from adaptive import ADAPTIVE, PHANTOM, estimate_of
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.outlook import Outlook
from flexneedle.control.path import Ahead, GuidePath
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import ROLL, Control
from synthetic import make_plan
from tasks import task_of

SPACE = PHANTOM.with_values({"setup.axes": 2})
DEPTH, END = 15.0, 40.0
SIMULATOR = Simulator(SPACE, threads=1)
ROLL_AT_START = 0.8
NOWHERE = np.zeros((0, 2))


@pytest.fixture(scope="module")
def state():
    """A needle at a depth, with the bevel rolled once on the way."""
    return inserted(SIMULATOR)


def inserted(simulator):
    state = simulator.start(ROLL_AT_START)
    while state.tip[0] < DEPTH:
        roll = 1.1 if 5.0 <= state.tip[0] < 6.0 else 0.0
        state = simulator.step(state, Control(db_x=1.0, roll=roll))
    return state


def ends(state, *, first=0.0, then=0.0):
    """y + iz of the tip at the target's depth, with rolls (rad) before the next step and before the second."""
    rows = controls(1, 60, db_x=0.5)
    rows[0, 0, ROLL], rows[0, 2, ROLL] = first, then
    tips = SIMULATOR.rollout(state, rows, limits=False).tips[0]
    y, z = (np.interp(END, tips[:, 0], tips[:, k]) for k in (1, 2))
    return complex(y, z)


def prepared(state, target, scenario=SPACE):
    """Task, estimate, memory and path ahead of a needle whose guide stays and which does not roll again."""
    plan = replace(make_plan("manipulation", (END, target.real, target.imag), 0), scenario=scenario)
    estimate = estimate_of(state, scenario)
    estimate = replace(estimate, precision=1e8 * estimate.precision)  # as good as certain
    task = task_of(estimate.nominal, plan)
    still = GuidePath(np.array([-50.0, 60.0]), np.tile(state.guide, (2, 1)), NOWHERE)
    memory = replace(ADAPTIVE.begin(task), path=still, rolled=still)
    return task, estimate, memory, Ahead.of(task, state, still)


@pytest.mark.parametrize("offset", [0.7 + 0.2j, -0.3 + 0.9j, -1.0j])
def test_it_aims_from_where_the_current_path_ends_to_the_target(state, offset):
    task, estimate, _, ahead = prepared(state, ends(state) + offset)
    assert -adaptive_mpc.find_ends(task, estimate, ahead)[0] == pytest.approx(offset, abs=0.02)


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize("beyond", [3.0, -0.2])
def test_the_reach_after_a_step_is_a_disc(state, direction, beyond):
    """Without uncertainty the expected distance is the distance from the disc, after a roll towards or away.

    The reference is a disc through four directions of the bevel after that roll, on the same model.
    """
    rolled = {
        side: [ends(state, first=side, then=turn) for turn in np.arange(4) * 0.5 * math.pi]
        for side in (0.0, math.pi)
    }
    middle = np.mean([np.mean(around) for around in rolled.values()])
    radius = np.mean([np.abs(np.array(around) - np.mean(around)).mean() for around in rolled.values()])
    target = middle + (radius + beyond) * cmath.exp(1j * direction)
    task, estimate, _, ahead = prepared(state, target)
    distances, angle = adaptive_mpc.expected_out_of_reach(
        task, estimate, ahead, Outlook.of(estimate), adaptive_mpc.find_ends(task, estimate, ahead), 1.0
    )
    aimed = state.bevel * cmath.exp(1j * angle)
    assert aimed == pytest.approx((target - middle) / abs(target - middle), abs=1e-2)
    for expected, first in zip(distances, (angle, angle + math.pi), strict=True):
        around = np.array([ends(state, first=first, then=turn) for turn in np.arange(4) * 0.5 * math.pi])
        away = abs(target - around.mean()) - np.abs(around - around.mean()).mean()
        assert expected == pytest.approx(max(0.0, away), abs=0.03)
    towards, back = distances
    assert towards < back or beyond < 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_guide_on_one_axis_leaves_the_bevel_to_reach_across_it(state, side):
    """Along its axis the guide corrects: the target may be anywhere. Across it, weight and precision are as without."""
    one_axis = SPACE.with_values({"setup.guide_axes": 1})
    there = inserted(Simulator(one_axis, threads=1))
    middle = np.mean([ends(state, then=turn) for turn in np.arange(4) * 0.5 * math.pi])
    far = middle + side * 3.0j
    task, estimate, memory, ahead = prepared(state, far)
    both, _ = adaptive_mpc.expected_out_of_reach(
        task, estimate, ahead, Outlook.of(estimate), adaptive_mpc.find_ends(task, estimate, ahead), 1.0
    )
    task, estimate, memory, ahead = prepared(there, far + 5.0, one_axis)
    across, angle = adaptive_mpc.expected_out_of_reach(
        task, estimate, ahead, Outlook.of(estimate), adaptive_mpc.find_ends(task, estimate, ahead), 1.0
    )
    assert across == pytest.approx(both, abs=0.02)
    assert across[0] > 1.0
    assert there.bevel * cmath.exp(1j * angle) == pytest.approx(side * 1j, abs=1e-9)
    found = adaptive_mpc.cost_terms(
        task, estimate, memory, ahead, adaptive_mpc.find_ends(task, estimate, ahead)
    )
    terms = {term.name: term for term in found}
    assert terms["reach"].weight == task.settings.unguided_reach_weight
    trajectories = adaptive_mpc.rollout_as_measured(estimate, ahead.controls(ahead.current[None])[0])
    off = abs(adaptive_mpc.past_target(trajectories.tips, task.plan.target)[0])
    precision = task.settings.precision_mm * ahead.left / task.plan.target[0]
    assert terms["miss"].value(trajectories)[0] == pytest.approx(off + off**2 / precision)


@pytest.fixture
def outlook(state):
    """Derivatives of the path and of the shape ahead, drawn at random, and an estimate with some covariance."""
    rng, estimate = np.random.default_rng(3), estimate_of(state, SPACE)
    count, grid = len(estimate.precision), estimate.grid
    root = rng.normal(size=(count, count)) / count
    estimate = replace(estimate, precision=np.linalg.inv(root @ root.T + 1e-4 * np.eye(count)))

    def complexes(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    return estimate, Outlook(grid, complexes(count, grid.size), complexes(count, 7)), complexes(7)


def test_the_deviations_of_the_shape_agree_with_needles_drawn_from_the_estimate(outlook):
    """Each drawn needle is 1.4 times as far off as the covariance, and corrects its own miss but for a rest."""
    estimate, derivatives, lever = outlook
    rng, rest = np.random.default_rng(4), 0.3
    drawn = 1.4 * rng.multivariate_normal(
        np.zeros(len(estimate.precision)), np.linalg.inv(estimate.precision), 40_000
    )
    end = np.array([np.interp(END, derivatives.grid, curve) for curve in derivatives.curves])
    left = rest * (rng.normal(size=40_000) + 1j * rng.normal(size=40_000))
    corrected = drawn @ end - left
    nodes = drawn @ derivatives.bent - corrected[:, None] * lever
    found = derivatives.shape_sd(estimate, END, lever, rest)
    np.testing.assert_allclose(
        found, np.stack([nodes.real.std(axis=0), nodes.imag.std(axis=0)], axis=1), rtol=0.03
    )
