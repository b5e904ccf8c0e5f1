"""Samples whose guide is aimed at the target, by the effect of guide and bevel on the end."""

from dataclasses import replace

import numpy as np
import pytest

from adaptive import PHANTOM, estimate_of, rolls_at
from flexneedle.control import samples
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.path import KNOTS, Ahead, GuidePath
from flexneedle.control.samples import add_pairs, aim_samples, propose_samples, undo_miss
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from synthetic import make_plan
from tasks import task_of

LEVER = np.array([0.02, 0.1, 0.3, 0.5])  # mm per mm
MISS = {1: 0.4 + 0.0j, 2: 0.3 - 0.4j}  # of the current path, by axes
AXES = pytest.mark.parametrize("axes", [1, 2])
COUNT = 96


def prepared(axes, rolls=(15.0, 30.0)):
    """Estimate and path ahead of a needle 10 mm deep, whose current path keeps the guide and rolls at depths."""
    scenario = PHANTOM.with_values({"setup.axes": axes})
    simulator = Simulator(scenario, threads=1)
    state, _ = simulator.replay(simulator.start(), controls(38, db_x=1.0))
    plan = replace(make_plan("manipulation", (40.0, 0.5, 0.2 * (axes - 1)), 0), scenario=scenario)
    path = GuidePath(np.array([-50.0, 60.0]), np.tile(state.guide, (2, 1)), rolls_at(*rolls))
    estimate = estimate_of(state, scenario)
    return estimate, Ahead.of(task_of(estimate.nominal, plan), state, path)


BEND = {1: 0.05 + 0.0j, 2: 0.04 + 0.03j}  # mm per mm of path on one side, by axes


def linear_misses(ahead, z, miss=None):
    """Misses y + iz (N,) of samples whose guide and bevel move the end linearly."""
    miss = MISS[ahead.axes] if miss is None else miss
    moved = z[:, : ahead.knots].reshape(-1, ahead.axes, KNOTS.size) @ LEVER
    used = ahead.bevel_use(z)
    rolled = BEND[ahead.axes] * (used - ahead.bevel_use(ahead.current[None]))
    misses = miss + moved @ np.array([1.0, 1.0j])[: ahead.axes] + rolled
    return misses if ahead.axes == 2 else misses.real


def proposed_and_aimed(ahead, lever=LEVER, miss=None):
    proposed = propose_samples(ahead, COUNT, np.random.default_rng(1))
    miss = MISS[ahead.axes] if miss is None else miss
    return proposed, aim_samples(ahead, proposed, miss, lever, BEND[ahead.axes], np.random.default_rng(2))


def paired(proposed, aimed, ahead):
    """Return whether each sample got a pair of rolls (N,)."""
    return (aimed[:, ahead.knots :] != proposed[:, ahead.knots :]).any(axis=1)


@AXES
def test_the_first_sample_corrects_nothing_and_most_keep_their_rolls(axes):
    _, ahead = prepared(axes)
    proposed, aimed = proposed_and_aimed(ahead)
    np.testing.assert_array_equal(aimed[0], ahead.current)
    assert paired(proposed, aimed, ahead).sum() <= COUNT // 6
    assert (aimed[:, ahead.knots :] != ahead.current[ahead.knots :]).any(axis=1).sum() > COUNT // 2


@AXES
def test_a_linear_response_leaves_a_share_of_the_miss_with_the_rolls(axes):
    """From all of it to a fifth beyond the target; only changes within the bounds of the guide count."""
    _, ahead = prepared(axes)
    proposed, aimed = proposed_and_aimed(ahead)
    unmoved = proposed.copy()
    unmoved[:, : ahead.knots] = 0.0
    lower, upper = ahead.bounds
    free = ((aimed > lower) & (aimed < upper))[:, : ahead.knots].all(axis=1)
    free &= ~paired(proposed, aimed, ahead)
    assert free.sum() > 0.7 * COUNT
    share = linear_misses(ahead, aimed)[free] / linear_misses(ahead, unmoved)[free]
    np.testing.assert_allclose(share.imag, 0.0, atol=1e-9)
    assert -0.2 - 1e-9 <= share.real.min() < -0.1
    assert 0.9 < share.real.max() <= 1.0 + 1e-9
    assert (share.real < 1.0 - 1e-9).mean() > 0.7


@AXES
def test_some_leave_the_guide_as_it_is_and_have_other_rolls(axes):
    _, ahead = prepared(axes)
    _, aimed = proposed_and_aimed(ahead)
    still = (aimed[:, : ahead.knots] == 0.0).all(axis=1)
    assert COUNT // 12 <= still[1:].sum() <= COUNT // 6
    assert (aimed[1:][still[1:]] != ahead.current).any(axis=1).all()


@pytest.mark.parametrize("rolls", [(), (15.0,), (15.0, 30.0)])
@pytest.mark.parametrize("turn", [0.0, 0.7, -1.2])
@AXES
def test_pairs_of_rolls_undo_the_miss(axes, turn, rolls, monkeypatch):
    """Exactly if no other roll is between the two: along the chord from the bevel's direction."""
    monkeypatch.setattr(samples, "_SPREAD", 0.0)
    _, ahead = prepared(axes, rolls)
    # The bevel on the present side moves the end further from the target; after a half turn, towards it.
    miss = 0.3 * BEND[axes] / abs(BEND[axes]) * np.exp(1j * turn * (axes - 1))
    proposed, aimed = proposed_and_aimed(ahead, miss=miss)
    left = np.abs(linear_misses(ahead, aimed, miss))[paired(proposed, aimed, ahead)]
    assert left.size >= COUNT // 24
    assert (left < 1e-9).all() if not rolls else (left < 1e-9).any()


def test_no_pair_is_added_without_slots_or_where_the_bevel_has_no_effect():
    _, ahead = prepared(1, (12.0, 15.0, 20.0))
    proposed, aimed = proposed_and_aimed(ahead)
    assert not paired(proposed, aimed, ahead).any()
    _, ahead = prepared(1)
    which, misses = np.ones(COUNT, dtype=bool), np.full(COUNT, 0.4 + 0.0j)
    same, made = add_pairs(ahead, proposed, which, misses, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(same, proposed)
    assert not made.any()


def test_a_third_of_the_samples_move_the_guide_to_one_side_at_all_knots():
    """These only undo the miss; of the others some move it to both sides."""
    _, ahead = prepared(1)
    _, aimed = proposed_and_aimed(ahead)
    change = aimed[:, : ahead.knots]
    one_side = (change >= 0.0).all(axis=1) | (change <= 0.0).all(axis=1)
    assert one_side[::3].all()
    assert not one_side.all()


@AXES
@pytest.mark.parametrize("factor", [1.0, 1e6])
def test_bounds_are_kept_by_a_guide_that_hardly_moves_the_tip_too(axes, factor):
    _, ahead = prepared(axes)
    _, aimed = proposed_and_aimed(ahead, miss=factor * MISS[axes])
    lower, upper = ahead.bounds
    assert (aimed >= lower).all()
    assert (aimed <= upper).all()
    assert (np.abs(aimed) == upper)[:, : ahead.knots].any() == (factor > 1.0)


def test_without_an_effect_of_the_guide_its_corrections_are_random_and_finite():
    _, ahead = prepared(1)
    _, aimed = proposed_and_aimed(ahead, lever=0.0 * LEVER)
    assert np.isfinite(aimed).all()
    assert (aimed[:, : ahead.knots] != 0.0).any()


@AXES
def test_the_linear_model_predicts_the_ends_of_samples_with_other_rolls(axes):
    """Guide unmoved: the miss by the bevel's use against the simulation, within a factor of three at any depth."""
    estimate, ahead = prepared(axes)
    task = task_of(
        estimate.nominal,
        replace(make_plan("manipulation", (40.0, 0.5, 0.2), 0), scenario=ahead.state.scenario),
    )
    z = np.tile(ahead.current, (3, 1))
    z[1, ahead.depths.start] -= 2.0
    z[2, ahead.depths.start + 1] += 2.0
    ends = adaptive_mpc.find_ends(task, estimate, ahead)
    tips = adaptive_mpc.rollout_as_measured(estimate, ahead.controls(z)[0]).tips
    moved = adaptive_mpc.past_target(tips, task.plan.target)
    moved = (moved - moved[0])[1:]
    used = ahead.bevel_use(z)
    linear = adaptive_mpc.bend_of(ahead, ends) * (used - used[0])[1:]
    assert abs(linear).min() > 0.05
    assert (np.abs(np.log(np.abs(linear / moved))) < np.log(3.0)).all()
    assert (np.real(linear * moved.conj()) > 0.0).all()


@pytest.mark.parametrize("turn", [1.0, 1.0j])
def test_undoing_the_whole_miss_hits_the_target(turn):
    rng = np.random.default_rng(0)
    change, along = rng.normal(size=(9, 4)) * turn, rng.uniform(size=(9, 4))
    np.testing.assert_allclose(undo_miss(change, along, LEVER, 0.3 * turn) @ LEVER, -0.3 * turn, atol=1e-12)
    np.testing.assert_array_equal(undo_miss(change, along, 0.0 * LEVER, 0.3 * turn), change)
