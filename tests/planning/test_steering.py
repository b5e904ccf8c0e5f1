"""Rolls of the bevel as controls, and the search of their depths on a kinematic needle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flexneedle.costs.terms import PLAN
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.planning import steering
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.problem import PlanProblem
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.types import DB_X, DB_Y, ROLL, THETA, X, Y

SEARCH = Search(samples=16, elite=4, iterations=60, smoothing=0.2, tolerance=1e-6)
BEND = 0.01  # curvature of the tip's path, 1/mm


def problem(lateral, energy_weight=0.0, **changes):
    """8 mm in air and 20 mm in tissue, steps of 3 mm, which do not divide it."""
    settings = PlanSettings(
        **PLAN.only("miss") | {"end_energy_weight_mm": energy_weight, "roll_weight_mm": 5e-4},
    )
    made = PlanProblem(
        target=(20.0, lateral, 0.0), travel=28.0, air=8.0, primitives=1,
        step=np.array([3.0, 0.5, 0.0, 0.005, 0.0, 0.5, 0.0]),
        reach=np.array([50.0, 1.0, 1.0, np.inf, np.inf, 2.0, 2.0]), sigma=np.zeros(6),
        settings=settings, energy_scale=1.0,
    )  # fmt: skip
    return replace(made, **changes)


def kinematic(controls, start=1.0, charge=lambda y: 0.0 * y):
    """A tip that bends by ±BEND in tissue, integrated exactly over each step; `charge` returns an energy for y."""
    advance = controls[:, :, DB_X]
    facing = start * np.cumprod(np.cos(controls[:, :, ROLL]), axis=1)
    x = np.cumsum(advance, axis=1) - 8.0
    inside = np.maximum(x, 0.0) - np.maximum(x - advance, 0.0)
    bent = np.cumsum(BEND * facing * inside, axis=1)
    before = bent - BEND * facing * inside
    y = np.cumsum(before * inside + 0.5 * BEND * facing * inside**2, axis=1)
    tips = np.zeros((*x.shape, 5))
    tips[:, :, X], tips[:, :, Y], tips[:, :, THETA] = x, y, np.arctan(bent)
    return Trajectories(controls, tips, charge(y), np.ones(x.shape, dtype=bool), 0.0 * y)


def end(z, side, p=None):
    """Return the y of the tip's end for rolls at shares z of the depth."""
    return float(
        kinematic(steering.controls_with_flips(p or problem(0.0), np.array([z]), side)).tips[0, -1, Y]
    )


@pytest.mark.parametrize(("z", "side"), [((), 1.0), ((0.3,), -1.0), ((0.25, 0.9), 1.0)])
def test_rolls_are_made_at_their_depths(z, side):
    """By the double integral of ±κ, a roll at depth r changes the end by −κ (20 − r)²."""
    expected = side * BEND * (200.0 + sum((-1) ** (k + 1) * (20.0 - 20.0 * r) ** 2 for k, r in enumerate(z)))
    assert end(z, side) == pytest.approx(expected, rel=1e-12)


@given(z=arrays(float, (3, 4), elements=st.floats(0.0, 1.0)), side=st.sampled_from([-1.0, 1.0]))
@hypothesis_settings(max_examples=100)
def test_any_sample_keeps_travel_and_steps_and_has_its_rolls(z, side):
    controls = steering.controls_with_flips(problem(0.0), z, side)
    np.testing.assert_allclose(controls[:, :, DB_X].sum(axis=1), 28.0, rtol=1e-12)
    assert (controls[:, :, DB_X] >= 0.0).all()
    assert (controls[:, :, DB_X] <= 3.0 + 1e-12).all()
    assert not controls[:, :, DB_Y:ROLL].any()
    assert ((controls[:, 1:, ROLL] > 0.0).sum(axis=1) == 4).all()
    assert (np.cos(controls[:, 0, ROLL]) == side).all()


def test_the_order_of_the_rolls_does_not_matter():
    assert end((0.7, 0.2), 1.0) == end((0.2, 0.7), 1.0)


@pytest.mark.parametrize("at", [3.0 / 20.0, 0.5, 1.0])
def test_the_end_is_continuous_where_a_roll_crosses_a_step(at):
    """The steps are 2.8 mm long; 6.2 mm deep is the end of one of them, 10 mm is within one."""
    assert end((at - 1e-9,), 1.0) == pytest.approx(end((at,), 1.0), abs=1e-7)


def test_a_roll_leaves_the_other_steps_where_they_are():
    edges = [
        np.cumsum(steering.controls_with_flips(problem(0.0), np.array([[z]]), 1.0)[0, :, DB_X])
        for z in (0.31, 0.32)
    ]
    assert len(np.setdiff1d(np.round(edges[0], 9), np.round(edges[1], 9))) == 1


@given(share=st.floats(-0.95, 0.95), seed=st.integers(0, 2**32))
@hypothesis_settings(max_examples=5)
def test_every_target_within_reach_is_reached(share, seed):
    found = steering.search_rolls(kinematic, problem(share * 2.0), SEARCH, np.random.default_rng(seed))
    tip = kinematic(found.controls[None], math.cos(found.roll)).tips[0, -1]
    assert abs(tip[1] - share * 2.0) < 1e-3
    assert (found.controls[:, DB_X] > 0.0).all()
    assert found.controls[0, ROLL] == 0.0


def test_reach_is_between_the_ends_without_a_roll():
    assert steering.reach(kinematic, problem(0.0)) == pytest.approx((-2.0, 2.0))


@pytest.mark.parametrize("side", [1, -1])
def test_beyond_reach_the_bevel_stays_on_the_targets_side(side):
    found = steering.search_rolls(kinematic, problem(side * 3.0), SEARCH, np.random.default_rng(0))
    assert math.cos(found.roll) == side
    assert (found.controls[:, ROLL] == 0.0).all()
    assert found.terms["miss"] == pytest.approx(11.0)


def test_more_rolls_are_made_where_they_pay():
    """On the way to the middle of the reach y² is charged: three rolls swing less than one."""

    def swinging(controls, start=1.0):
        return kinematic(controls, start, lambda y: np.cumsum(y**2, axis=1))

    rolls = [
        int((found.controls[:, ROLL] > 0.0).sum())
        for weight in (0.0, 5.0)
        for found in [
            steering.search_rolls(
                swinging, problem(0.0, energy_weight=weight), SEARCH, np.random.default_rng(0)
            )
        ]
    ]
    assert rolls[0] == 1
    assert 1 < rolls[1] <= steering.MOST_ROLLS


def test_progress_counts_through_all_searches_and_the_best_never_rises():
    calls = []
    steering.search_rolls(kinematic, problem(0.5), SEARCH, np.random.default_rng(0), calls.append)
    assert [call["iteration"] for call in calls] == list(range(1, len(calls) + 1))
    assert (np.diff([call["best"] for call in calls]) <= 0.0).all()
    assert all(call["iteration"] <= call["iterations"] for call in calls)
    assert calls[0]["iterations"] == 5 * SEARCH.iterations  # of the five searches that a plan usually takes
