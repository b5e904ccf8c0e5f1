"""Samples of the second round: around the best of the first, and aimed at the target by the effect of the guide."""

from dataclasses import replace

import numpy as np
import pytest

from adaptive import PHANTOM, estimate_of, rolls_at
from flexneedle.control.controllers.adaptive_mpc import rollout_as_measured
from flexneedle.control.path import (
    KNOTS,
    Ahead,
    GuidePath,
    aim_samples,
    fit_lever,
    propose_samples,
    undo_miss,
)
from flexneedle.costs.terms import past_target
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from synthetic import make_plan
from tasks import task_of

LEVER = np.array([0.02, 0.1, 0.3, 0.5])  # mm per mm
MISS = {1: 0.4 + 0.0j, 2: 0.3 - 0.4j}  # of the current path, by axes
AXES = pytest.mark.parametrize("axes", [1, 2])
COUNT = 96


def prepared(axes):
    """Estimate and path ahead of a needle 10 mm deep, whose current path keeps the guide and rolls twice."""
    scenario = PHANTOM.with_values({"setup.axes": axes})
    simulator = Simulator(scenario, threads=1)
    state, _ = simulator.replay(simulator.start(), controls(38, db_x=1.0))
    plan = replace(make_plan("manipulation", (40.0, 0.5, 0.2 * (axes - 1)), 0), scenario=scenario)
    path = GuidePath(np.array([-50.0, 60.0]), np.tile(state.guide, (2, 1)), rolls_at(15.0, 30.0))
    estimate = estimate_of(state, scenario)
    return estimate, Ahead.of(task_of(estimate.nominal, plan), state, path)


def linear_misses(ahead, z):
    """Misses y + iz (N,) of samples whose guide alone moves the tip, linearly."""
    moved = z[:, : ahead.knots].reshape(-1, ahead.axes, KNOTS.size) @ LEVER
    return MISS[ahead.axes] + moved @ np.array([1.0, 1.0j])[: ahead.axes]


def tried_and_aimed(ahead):
    """Samples of both rounds, and the best of the first, by the linear misses."""
    tried = propose_samples(ahead, COUNT, np.random.default_rng(1))
    misses = linear_misses(ahead, tried)
    aimed = aim_samples(ahead, tried, misses, np.abs(misses), np.random.default_rng(2))
    return tried, aimed, int(np.argmin(np.abs(misses)))


@AXES
def test_the_first_sample_is_the_best_tried(axes):
    _, ahead = prepared(axes)
    tried, aimed, best = tried_and_aimed(ahead)
    assert best > 0
    assert aimed.shape == tried.shape
    np.testing.assert_array_equal(aimed[0], tried[best])


@AXES
def test_a_linear_response_leaves_a_share_of_the_miss_from_all_of_it_to_a_fifth_beyond_the_target(axes):
    """The random part of a change has no effect; only changes within the bounds of the guide count."""
    _, ahead = prepared(axes)
    tried, aimed, best = tried_and_aimed(ahead)
    lower, upper = ahead.bounds
    free = ((aimed > lower) & (aimed < upper))[:, : ahead.knots].all(axis=1)
    share = linear_misses(ahead, aimed)[free] / linear_misses(ahead, tried[best : best + 1])
    assert free.sum() > 0.8 * COUNT
    np.testing.assert_allclose(share.imag, 0.0, atol=1e-9)
    assert -0.2 <= share.real.min() < -0.1
    assert 0.9 < share.real[1:].max() <= 1.0 + 1e-9


@pytest.mark.parametrize("turn", [1.0, 1.0j])
def test_undoing_the_whole_miss_hits_the_target(turn):
    rng = np.random.default_rng(0)
    change, along = rng.normal(size=(9, 4)) * turn, rng.uniform(size=(9, 4))
    np.testing.assert_allclose(undo_miss(change, along, LEVER, 0.3 * turn) @ LEVER, -0.3 * turn, atol=1e-12)
    np.testing.assert_array_equal(undo_miss(change, along, 0.0 * LEVER, 0.3 * turn), change)


def test_a_third_of_the_samples_move_the_guide_to_one_side_at_all_knots():
    """These only undo the miss."""
    _, ahead = prepared(1)
    tried, aimed, best = tried_and_aimed(ahead)
    change = (aimed - tried[best])[3::3, : ahead.knots]
    side = -np.sign(linear_misses(ahead, tried[best : best + 1])[0].real)
    assert (side * change >= 0.0).all()
    assert ((aimed - tried[best])[1:, : ahead.knots] * side < 0.0).any()


@AXES
def test_seven_eighths_keep_the_rolls_of_the_best(axes):
    _, ahead = prepared(axes)
    tried, aimed, best = tried_and_aimed(ahead)
    kept = (aimed[:, ahead.knots :] == tried[best, ahead.knots :]).all(axis=1)
    assert np.delete(kept, slice(1, None, 8)).all()
    assert not kept[1::8].all()


@AXES
@pytest.mark.parametrize("factor", [1.0, 1e6])
def test_bounds_are_kept_by_a_guide_that_hardly_moves_the_tip_too(axes, factor):
    _, ahead = prepared(axes)
    tried = propose_samples(ahead, COUNT, np.random.default_rng(1))
    misses = factor * MISS[axes] + linear_misses(ahead, tried)
    aimed = aim_samples(ahead, tried, misses, np.abs(misses), np.random.default_rng(2))
    lower, upper = ahead.bounds
    assert (aimed >= lower).all()
    assert (aimed <= upper).all()
    assert (np.abs(aimed) == upper)[:, : ahead.knots].any() == (factor > 1.0)


@AXES
def test_the_lever_is_the_derivative_of_the_rollout(axes):
    """On y, and in space on z alike, against central differences, but for the corrections' own lack of linearity."""
    estimate, ahead = prepared(axes)

    def misses(z):
        return past_target(rollout_as_measured(estimate, ahead.controls(z)[0]).tips, (40.0, 0.5, 0.2))

    tried = propose_samples(ahead, COUNT, np.random.default_rng(1))
    lever = fit_lever(ahead, tried, misses(tried), np.zeros(COUNT))
    for axis in range(axes):
        steps = np.zeros((2, KNOTS.size, ahead.current.size))
        steps[0, :, axis * KNOTS.size : (axis + 1) * KNOTS.size] = 1e-3 * np.eye(KNOTS.size)
        steps[1] = -steps[0]
        up, down = misses((ahead.current + steps).reshape(-1, ahead.current.size)).reshape(2, -1)
        exact = ((up - down) / 2e-3 / (1.0, 1.0j)[axis]).real
        np.testing.assert_allclose(lever, exact, atol=0.05 * np.abs(exact).max())


@AXES
def test_the_lever_of_a_linear_response_is_exact_and_failed_samples_do_not_count(axes):
    _, ahead = prepared(axes)
    tried = propose_samples(ahead, COUNT, np.random.default_rng(1))
    misses, costs = linear_misses(ahead, tried), np.zeros(COUNT)
    misses[12:30], costs[12:30] = np.nan, np.inf
    np.testing.assert_allclose(fit_lever(ahead, tried, misses, costs), LEVER, rtol=1e-9)


@AXES
@pytest.mark.parametrize("failed", [1, COUNT])
def test_where_the_current_path_fails_samples_are_not_aimed(axes, failed):
    """They are random changes of the best of the others, if there is one, and finite in any case."""
    _, ahead = prepared(axes)
    tried = propose_samples(ahead, COUNT, np.random.default_rng(1))
    misses = linear_misses(ahead, tried)
    costs = np.abs(misses)
    misses[:failed], costs[:failed] = np.nan, np.inf
    assert not fit_lever(ahead, tried, misses, costs).any()
    aimed = aim_samples(ahead, tried, misses, costs, np.random.default_rng(2))
    np.testing.assert_array_equal(aimed[0], tried[np.argmin(costs)])
    assert np.isfinite(aimed).all()
