"""Primitives as controls, the terms of a plan's cost, and the search on a rigid needle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flexneedle import controls as controls_of
from flexneedle.costs.terms import PLAN
from flexneedle.costs.weighted_sum import Trajectories, evaluate_terms
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.primitives import make_controls, search_primitives, widen_search
from flexneedle.planning.problem import PlanProblem
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.excess import LoadLimits
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, X, Y

WEIGHTS = PlanSettings(
    end_energy_weight_mm=0.2,
    mean_energy_weight_mm=0.3,
    peak_energy_weight_mm=0.4,
    bend_weight=0.16,
    limit_weight_mm=100.0,
    slope_weight=0.05,
    roll_weight_mm=0.015,
)
PROBLEM = PlanProblem(
    target=(8.0, 2.0, 0.0), travel=12.0, air=4.0, primitives=3,
    step=np.array([1.0, 0.5, 0.0, 0.005, 0.0, 0.5, 0.0]),
    reach=np.array([20.0, 1.0, 1.0, np.inf, np.inf, 2.0, 2.0]),
    sigma=np.array([0.1, 0.0, 0.0, 0.25, 1.0, 0.3]),
    settings=WEIGHTS, energy_scale=0.5, loads=LoadLimits(np.array([0.7, 0.5]), 0.01, 2.0),
)  # fmt: skip
SEARCH = Search(samples=64, elite=8, iterations=30, smoothing=0.2, tolerance=1e-6)
BOUNDS = np.array([0.25, 0.5, 0.005, 0.5, 3.0, 1.0])


def primitives(*rows):
    """Samples z (1, 6 P) of rows (longest advance, base y, base θ, guide, ε, log share)."""
    return np.array(rows, dtype=float).reshape(1, -1)


def sampled():
    """z (4, 18) within the bounds of the search."""
    unit = st.floats(-1.0, 1.0, allow_subnormal=False)
    offset = np.array([0.75, 0, 0, 0, 0, 0])
    return arrays(float, (4, 3, 6), elements=unit).map(lambda a: (offset + a * BOUNDS).reshape(4, 18))


def test_equal_shares_and_full_steps():
    """12 mm in three primitives of four steps; the bevel rolls at the second and again at the third."""
    z = primitives((1, 0, 0, 0.1, 2.0, 0), (1, 0.02, 0, 0, -0.1, 0), (1, 0, 0.001, -0.2, 0.1, 0))
    controls, wanted = make_controls(PROBLEM, z)
    expected = controls_of(12, db_x=1.0)
    expected[:4, DG_Y], expected[4:8, DB_Y], expected[8:, DB_THETA], expected[8:, DG_Y] = (
        0.1,
        0.02,
        0.001,
        -0.2,
    )
    expected[[4, 8], ROLL] = np.pi
    np.testing.assert_allclose(controls[0], expected, atol=1e-14)
    np.testing.assert_array_equal(wanted, [[0.0, np.pi, 0.0]])


def test_shares_are_the_exponentials_and_steps_no_longer_than_asked():
    """Shares 2 : 1 : 1 of 12 mm with longest steps of 1, 0.7 and 0.5: 6, 5 and 6 steps."""
    z = primitives((1, 0, 0, 0, 1, np.log(2)), (0.7, 0, 0, 0, 1, 0), (0.5, 0, 0, 0, 1, 0))
    controls, _ = make_controls(PROBLEM, z)
    np.testing.assert_allclose(controls[0, :, DB_X], [*[1.0] * 6, *[0.6] * 5, *[0.5] * 6])


def test_rounding_makes_no_further_step():
    """2.1 / 0.7 is a little more than 3 in double precision."""
    assert 2.1 / 0.7 > 3.0
    one = replace(PROBLEM, travel=2.1, primitives=1)
    controls, _ = make_controls(one, primitives((0.7, 0, 0, 0, 1, 0)))
    assert controls.shape == (1, 3, 9)


def test_guide_stops_at_its_reach_and_comes_back_from_there():
    """Four steps of 0.5 reach 2.0, the limit; four more stay; four back end at 0."""
    up = (1, 0, 0, 0.5, 1, 0)
    controls, _ = make_controls(PROBLEM, primitives(up, up, (1, 0, 0, -0.5, 1, 0)))
    np.testing.assert_allclose(controls[0, :, DG_Y], [*[0.5] * 4, *[0.0] * 4, *[-0.5] * 4], atol=1e-14)
    halfway, _ = make_controls(PROBLEM, primitives((1, 0, 0, 0.4, 1, 0), up, up))
    np.testing.assert_allclose(halfway[0, :, DG_Y], [*[0.4] * 4, *[0.1] * 4, *[0.0] * 4], atol=1e-14)


@given(z=sampled())
@hypothesis_settings(max_examples=100)
def test_any_sample_keeps_travel_limits_and_turns(z):
    controls, wanted = make_controls(PROBLEM, z)
    np.testing.assert_allclose(controls[:, :, DB_X].sum(axis=1), PROBLEM.travel, rtol=1e-12)
    assert (np.abs(controls[:, :, :ROLL]) <= PROBLEM.step + 1e-12).all()
    travel = np.abs(np.cumsum(controls[:, :, :ROLL], axis=1))
    assert (travel <= PROBLEM.reach + 1e-12).all()
    rolls = (np.diff(wanted, axis=1, prepend=0.0) != 0.0).sum(axis=1)
    np.testing.assert_array_equal((controls[:, :, ROLL] == np.pi).sum(axis=1), rolls)
    assert set(np.unique(controls[:, :, ROLL])) <= {0.0, np.pi}
    facing = np.cumprod(np.cos(controls[:, :, ROLL]), axis=1)
    np.testing.assert_array_equal(facing[:, 0], np.cos(wanted[:, 0]))
    np.testing.assert_array_equal(facing[:, -1], np.cos(wanted[:, -1]))
    for row, sample in zip(controls, z.reshape(4, 3, 6), strict=True):
        moving = row[row[:, DB_X] > 0.0]
        assert (row[len(moving) :, :ROLL] == 0.0).all()
        assert (moving[:, DB_X] <= sample[:, 0].max() + 1e-12).all()
        share = np.exp(sample[:, 5]) / np.exp(sample[:, 5]).sum() * PROBLEM.travel
        least = np.ceil(share / sample[:, 0] - 1e-9).sum()
        assert len(moving) == least  # no more steps than needed


def made_up(n):
    """A rollout of n samples, 12 steps: the tip ends at (7.5, 1.5) with slope 0.2, in tissue for the last 8.

    The seventh has the largest energy and loads.
    """
    x = np.arange(12.0) - 3.0
    tips = np.zeros((n, 12, 5))
    tips[:, :, X] = np.where(x < 1.0, x, x - 0.5)
    tips[:, -1] = 7.5, 1.5, 0.0, 0.2, 0.0
    energy, strain, stretch, clearance, loads = (
        np.full((n, 12), 0.1),
        np.zeros((n, 12)),
        np.ones((n, 12)),
        np.full((n, 12), 5.0),
        np.zeros((n, 12, 6)),
    )
    clearance[:, 6], clearance[:, 7] = -0.5, 1.5
    energy[:, 6], strain[:, 6], stretch[:, 6], loads[:, 6, 4] = 0.8, 0.009, 0.55, 2.4
    deflection = np.tile(np.arange(12.0), (n, 1))
    values = {
        "energy": energy,
        "deflection": deflection,
        "strain": strain,
        "stretch": stretch,
        "loads": loads,
        "clearance": clearance,
    }
    return {"tips": tips, "converged": np.ones((n, 12), dtype=bool), **values}


def terms(z, steps=12, problem=PROBLEM):
    controls, _ = make_controls(problem, z)
    arrays = {name: values[:, :steps] for name, values in made_up(len(controls)).items()}
    trajectories = Trajectories(controls, **arrays)
    return {name: float(value[0]) for name, value in evaluate_terms(problem.terms, trajectories).items()}


GUIDED = primitives((1, 0, 0, 0.1, 1, 0), (1, 0, 0, -0.2, -1, 0), (1, 0, 0, 0.05, 1, 0))


def test_cost_term_by_term_against_a_computation_by_hand():
    """The target is 8 mm deep, E₁ 0.5 mJ; x > 0 from the fifth step on: deflection 4 + 5 + … + 11 = 60.

    Slopes of the guide's path are 0.1, −0.2 and 0.05. Strain and compression are 0.9 of their limits, the force 1.2.
    """
    found, d = terms(GUIDED), abs(1.5 + np.tan(0.2) * 0.5 - 2.0)
    assert found == {
        "miss": pytest.approx(d + d**2 / 0.1),
        "end energy": pytest.approx(0.2 * 0.1 / 0.5),
        "mean energy": pytest.approx(0.3 * (7 * 0.1 + 0.8) / 8 / 0.5),
        "peak energy": pytest.approx(0.4 * 0.8 / 0.5),
        "deflection": pytest.approx(0.16 * 60.0 / 8 / 8.0),
        "limits": pytest.approx(100.0 * 2.0 * (0.9 / 0.8 - 1.0) * 0.2 / 0.1),
        "guide force": pytest.approx(100.0 * (1.2 / 0.8 - 1.0) * 0.2 / 0.002),
        "guide": pytest.approx(0.05 * 8.0 * (0.01 + 0.04 + 0.0025) / 3.0),
        "rolls": pytest.approx(0.015 * 2),
    }


def test_zones_are_charged_by_the_intrusion_into_their_margin():
    """The needle is 0.5 mm in a zone after one step, and 0.5 mm in its margin of 2 mm after the next."""
    found = terms(GUIDED, problem=replace(PROBLEM, clear=2.0))
    assert found.items() >= terms(GUIDED).items()
    assert found["zones"] == pytest.approx(60.0 * (2.5 + 0.1 * (2.5 + 0.5) / 12 + 1.5 * 0.5))
    assert found["compression"] == pytest.approx(100.0 * (0.45 - 0.3))


def test_each_weight_scales_its_own_term_alone():
    near = replace(PROBLEM, clear=2.0)
    base = terms(GUIDED, problem=near)
    for weight in PLAN.settings():
        settings = WEIGHTS.model_copy(update={weight.key: 7.0})
        changed = terms(GUIDED, problem=replace(near, settings=settings))
        scaled = {"limits", "guide force"} if weight.name == "limits" else {weight.name}
        assert {name for name in base if changed[name] != pytest.approx(base[name])} == scaled


def test_first_turn_is_free_and_padding_costs_nothing():
    """Neither a start with −1 nor a step that does nothing is charged."""
    assert terms(primitives(*[(1, 0, 0, 0, -1, 0)] * 3))["rolls"] == 0.0
    shorter = replace(PROBLEM, travel=9.0)
    found = terms(primitives(*[(1, 0, 0, 0.1, 1, 0)] * 3), steps=9, problem=shorter)
    assert found["deflection"] == pytest.approx(0.16 * (4 + 5 + 6 + 7 + 8) / 5 / 8.0)


def rigid(controls, bevel=1.0):
    """A needle that goes where guide (mm) and bevel (0.1 mm a mm in tissue) push it, without tissue energy."""
    x = np.cumsum(controls[:, :, DB_X], axis=1) - 4.0
    facing = bevel * np.cumprod(np.cos(controls[:, :, ROLL]), axis=1)
    bent = 0.1 * np.cumsum(facing * controls[:, :, DB_X] * (x > 0.0), axis=1)
    tips = np.zeros((*x.shape, 5))
    tips[:, :, X], tips[:, :, Y] = x, np.cumsum(controls[:, :, DG_Y], axis=1) + bent
    zero, loads = np.zeros_like(x), np.zeros((*x.shape, 6))
    converged = np.ones(x.shape, dtype=bool)
    return Trajectories(controls, tips, zero, converged, zero, stretch=1.0 + zero, strain=zero, loads=loads)


def test_search_meets_the_target_of_a_rigid_needle():
    found = search_primitives(rigid, PROBLEM, SEARCH, np.random.default_rng(0))
    end = rigid(found.controls[None], math.cos(found.roll)).tips[0, -1]
    np.testing.assert_allclose(end[:2], [8.0, 2.0], atol=0.01)
    assert sum(found.terms.values()) == pytest.approx(found.search_state.best_cost)


def bevel_only(sign):
    sigma = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.3])
    return replace(PROBLEM, target=(8.0, 0.8 * sign, 0.0), sigma=sigma)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_start_roll_is_separate_from_the_first_step(sign):
    """The target is to one side, where 8 mm at 0.1 a mm lead without a roll."""
    found = search_primitives(rigid, bevel_only(sign), SEARCH, np.random.default_rng(0))
    assert math.cos(found.roll) == sign
    assert (found.controls[:, ROLL] == 0.0).all()
    assert found.terms["rolls"] == 0.0
    assert found.terms["miss"] == pytest.approx(0.0, abs=1e-4)
    assert (found.controls[:, DB_Y:ROLL] == 0.0).all()


def test_bounds_of_the_search_keep_the_steps():
    """No step exceeds its limit, and the number of steps is bounded."""
    wild = replace(PROBLEM, sigma=np.array([5.0, 5.0, 1.0, 5.0, 9.0, 9.0]))
    evaluated = []

    def rollout(controls):
        evaluated.append(controls)
        return rigid(controls)

    search_primitives(rollout, wild, replace(SEARCH, iterations=4), np.random.default_rng(0))
    for controls in evaluated:
        assert (np.abs(controls[:, :, :ROLL]) <= PROBLEM.step + 1e-12).all()
        assert controls.shape[1] <= 2 * 12 + 3
    shares = [controls[:, :, DB_X].sum(axis=1) for controls in evaluated]
    np.testing.assert_allclose(np.concatenate(shares), 12.0)


def test_neighbouring_primitives_want_the_same_bevel_more_often_than_not():
    """ε is correlated at first: 0.8 between neighbours, so they differ in 1 of 5, not of 2, and ε are unit."""
    rolls = []

    def rollout(controls):
        rolls.append((controls[:, 1:, ROLL] > 0.0).sum(axis=1))
        return rigid(controls)

    many = replace(SEARCH, samples=4000, iterations=1, elite=100)
    search_primitives(rollout, replace(PROBLEM, primitives=6), many, np.random.default_rng(0))
    expected = 5 * np.arccos(0.8) / np.pi
    assert rolls[0].mean() == pytest.approx(expected, abs=0.06)


def test_wider_samples_span_the_largest_steps_of_what_is_free():
    """Fixed inputs, longest step, ε, share, and a deviation beyond the largest step stay as they are."""
    np.testing.assert_array_equal(widen_search(PROBLEM).sigma, [0.1, 0.0, 0.0, 0.5, 1.0, 0.3])
    wide = replace(PROBLEM, sigma=np.array([0.1, 0.9, 0.001, 0.25, 1.0, 0.3]))
    np.testing.assert_array_equal(widen_search(wide).sigma, [0.1, 0.9, 0.005, 0.5, 1.0, 0.3])


def test_wider_samples_in_space_keep_the_ratio_across_the_frame():
    """Guide in two axes with a tenth across, in one axis with none; step 0.5 mm on each."""
    step = np.array([1.0, 0.5, 0.5, 0.005, 0.005, 0.5, 0.5])
    for across, expected in ((0.006, 0.05), (0.0, 0.0)):
        sigma = np.array([0.03, 0, 0, 0, 0, 0.06, across, 1.0, 0.1, 0.1])
        made = widen_search(replace(PROBLEM, axes=2, step=step, sigma=sigma)).sigma
        np.testing.assert_allclose(made, [0.03, 0, 0, 0, 0, 0.5, expected, 1.0, 0.1, 0.1])
