"""The search of sequences: bounds, the incumbent, samples of the first iteration, what is returned."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import controls as controls_of
from flexneedle.costs import terms
from flexneedle.costs.weighted_sum import Term, Trajectories, evaluate_cost
from flexneedle.planning import cross_entropy as ce
from flexneedle.planning import horizon
from flexneedle.types import DB_X, DG_Y, X, Y

SEARCH = ce.Search(samples=16, elite=4, iterations=3, smoothing=0.2, tolerance=1e-9)
TARGET = (4.0, 1.5, 0.0)


def controls(z):
    """Guide steps z (N, 4), 1 mm of advance each."""
    return controls_of(*z.shape, db_x=1.0, dg_y=z)


VARIABLES = horizon.Variables(
    np.full(4, -1.0), np.full(4, 1.0), np.zeros(4), np.array([0.3, 0.3, 0.3, 0.0]), controls
)
TERMS = (
    Term("miss", 1.0, lambda trajectories: terms.miss(trajectories, TARGET)),
    Term("guide", 0.4, terms.guide_slope),
)


def rigid(rows, failed=lambda tips: np.zeros(tips.shape[:2], dtype=bool)):
    """A tip that goes where the guide goes."""
    moved = np.cumsum(rows, axis=1)
    tips = np.zeros((*moved.shape[:2], 5))
    tips[:, :, X], tips[:, :, Y] = moved[:, :, DB_X], moved[:, :, DG_Y]
    return Trajectories(rows, tips, np.zeros(tips.shape[:2]), ~failed(tips))


class Taped:
    """A rollout that keeps the samples it was given."""

    def __init__(self):
        self.rows = []

    def __call__(self, rows):
        self.rows.append(rows[:, :, DG_Y].copy())
        return rigid(rows)


def search(rollout=rigid, variables=VARIABLES, settings=SEARCH, seed=0, **options):
    return horizon.find_best(variables, rollout, TERMS, settings, np.random.default_rng(seed), **options)


def test_the_result_has_its_terms_and_rollout():
    found = search()
    np.testing.assert_array_equal(found.trajectories.controls, controls(found.z[None]))
    assert found.cost == sum(found.terms.values()) == found.search_state.best_cost
    off = abs(found.z.sum() - 1.5)
    assert found.terms["miss"] == pytest.approx(off + off**2 / 0.1)
    assert list(found.terms) == ["miss", "guide"]


def test_it_is_cross_entropy_on_the_cost_and_nothing_else():
    """Cross-entropy called by hand gives the same samples and bytes."""
    settings = ce.Settings(**vars(SEARCH), lower=VARIABLES.lower, upper=VARIABLES.upper)
    by_hand = ce.minimize(
        lambda z: evaluate_cost(TERMS, rigid(controls(z))),
        ce.start(VARIABLES.mean, VARIABLES.sigma),
        settings,
        np.random.default_rng(0),
    )
    found = search()
    assert found.search_state.mean.tobytes() == by_hand.mean.tobytes()
    assert found.search_state.history == by_hand.history


def test_a_correlation_applies_to_the_first_samples():
    tape = Taped()
    together = replace(
        VARIABLES, sigma=np.array([0.1, 0.1, 0, 0]), correlation=np.eye(4) + 0.99 * np.eye(4)[[1, 0, 3, 2]]
    )
    search(tape, together, replace(SEARCH, samples=2000, iterations=1))
    assert np.corrcoef(tape.rows[0][:, :2].T)[0, 1] > 0.97


@given(seed=st.integers(0, 2**32), z=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
@hypothesis_settings(max_examples=40)
def test_it_is_never_worse_than_the_incumbent(seed, z):
    incumbent = np.array([z])
    before = evaluate_cost(TERMS, rigid(controls(incumbent)))[0]
    others = np.random.default_rng(seed).uniform(-1.0, 1.0, (16, 4))
    found = search(
        seed=seed, settings=replace(SEARCH, iterations=2), first=np.concatenate([incumbent, others])
    )
    assert found.cost <= before


def test_given_samples_form_the_first_iteration_and_are_kept_in_bounds():
    tape, first = Taped(), np.tile([[0.1], [0.2], [9.0], [0.3], [0.4]], (1, 4))
    search(tape, first=first)
    np.testing.assert_array_equal(tape.rows[0][:, 0], [0.1, 0.2, 1.0, 0.3, 0.4])
    assert [len(rows) for rows in tape.rows] == [5, 16, 16]


def test_where_every_sample_fails_the_cost_is_infinite_and_the_mean_is_kept():
    found = search(lambda rows: rigid(rows, lambda tips: np.ones(tips.shape[:2], dtype=bool)))
    assert found.cost == np.inf
    np.testing.assert_array_equal(found.z, VARIABLES.mean)
