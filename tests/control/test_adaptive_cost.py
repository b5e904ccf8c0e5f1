"""Cost of a path by the default controller: weights, miss and reach."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive import ADAPTIVE, BARE, PHANTOM, QUICK, decide, decided, estimate_of, unrolled
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.path import path_of_plan
from flexneedle.costs import terms
from flexneedle.planning.planner import bevel_reach
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control
from tasks import task_of


def weights(scenario, plan, x, memory=None):
    """Return the weights of the cost's terms with the tip at a depth."""
    simulator = Simulator(scenario, threads=1)
    state = simulator.start()
    while state.tip[0] < x:
        state = simulator.step(state, Control(db_x=1.0))
    estimate, task = estimate_of(state, scenario), task_of(simulator, plan)
    memory = memory or ADAPTIVE.begin(task)
    ahead = adaptive_mpc.Ahead.of(task, state, memory.path)
    listed = adaptive_mpc.cost_terms(task, estimate, memory, ahead)
    return {term.name: term.weight for term in listed}, task, estimate, ahead


def test_weights_are_the_settings_over_scales_of_the_scenario(quick_plan):
    """Energy relative to the scale of this tissue, line and slope by the path left, late rolls by their effect."""
    found, task, estimate, ahead = weights(PHANTOM, quick_plan, 10.0)
    settings, scale = task.settings, PHANTOM.energy_scale(40.0)
    assert found == {
        "miss": 1.0,
        "large miss": (ahead.left / 40.0) ** -settings.urgency - 1.0,
        "energy": settings.energy_weight_mm / scale,
        "line": settings.line_weight * ahead.left / 40.0,
        "slope": settings.slope_weight_mm * ahead.left / 40.0,
        "flips": settings.roll_weight_mm,
        "late": settings.late_roll_weight * estimate.roll_sd,
        "reach": settings.reach_weight,
    }
    assert 0.7 < ahead.left / 40.0 < 0.8
    assert estimate.roll_sd > 0.0
    bare, task, _, _ = weights(BARE, quick_plan, 10.0)
    assert bare["energy"] == task.settings.unguided_energy_weight_mm / scale
    assert bare["line"] == task.settings.unguided_line_weight
    assert bare["reach"] == task.settings.unguided_reach_weight


def test_near_the_target_a_large_miss_gets_no_more_urgent(quick_plan):
    """From there on a correction takes no effect."""
    late, later = (weights(PHANTOM, quick_plan, x)[0]["large miss"] for x in (36.0, 38.0))
    assert late == later == pytest.approx((adaptive_mpc.UNCORRECTED / 40.0) ** -1.5 - 1.0)


def test_a_miss_below_its_standard_deviation_counts_little(quick_plan, along):
    """The blur is the last standard deviation without a miss, times the share of the path that is left."""
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    task = task_of(estimate.nominal, quick_plan)
    memory = replace(ADAPTIVE.begin(task), blur=0.3)
    ahead = adaptive_mpc.Ahead.of(task, estimate.state, memory.path)
    trajectories = adaptive_mpc.rollout_as_measured(estimate, ahead.controls(ahead.current[None])[0])
    (term,) = (term for term in adaptive_mpc.cost_terms(task, estimate, memory, ahead) if term.name == "miss")
    past = float(terms.past_target(trajectories, quick_plan.target)[0].real)
    assert abs(past) > 1e-3
    blur = 0.3 * ahead.left / 40.0
    assert blur < 0.25
    assert term.value(trajectories)[0] == pytest.approx(np.hypot(past, blur) - blur)


def test_the_blur_is_the_standard_deviation_of_the_linear_model_without_a_miss(quick_plan, along):
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    decision, memory = decided(quick_plan, estimate)
    assert memory.blur == memory.outlook.sd_to_come(estimate, quick_plan.target[0])
    assert 0.0 < 0.7 * memory.blur <= decision.miss_sd
    alone, memory = decided(replace(quick_plan, strategy="steering"), estimate)
    assert alone.miss_sd >= memory.blur


@given(st.floats(-3.0, 3.0), st.floats(0.01, 2.0))
def test_the_mean_above_zero_is_the_integral(mean, sd):
    x = np.linspace(0.0, mean + 9.0 * sd, 20001)
    density = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    expected = np.trapezoid(x * density, x) if x[-1] > 0.0 else 0.0
    found = adaptive_mpc.mean_above_zero(np.array([mean]), np.array([sd]))[0]
    assert found == pytest.approx(expected, abs=1e-4 * sd)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("roll", [0.0, math.pi])
def test_reach_is_not_given_away_by_a_step_with_the_bevel_on_the_wrong_side(quick_plan, side, roll):
    """The target is near the end of the bevel's reach."""
    simulator = Simulator(BARE, threads=1)
    state = simulator.replay(simulator.start(roll), controls(1, db_x=31.0))[0]
    estimate = estimate_of(state, BARE)
    least, greatest = bevel_reach(BARE, 40.0, threads=1)
    plan = replace(quick_plan, target=(40.0, 0.9 * (greatest if side > 0 else least), 0.0), roll=roll)
    task = task_of(simulator, plan)
    ahead = adaptive_mpc.Ahead.of(task, state, unrolled(path_of_plan(plan)))
    expected, angle = adaptive_mpc.expected_out_of_reach(task, estimate, ahead, ADAPTIVE.begin(task), 1.0)
    rollout = adaptive_mpc.rollout_as_measured(estimate, ahead.constant)
    kept, _, rolled, _ = terms.out_of_reach(rollout, expected, angle)
    assert min(kept, rolled) >= 0.0
    assert (kept < rolled) == (side == state.bevel.real)


@pytest.mark.parametrize("scenario", [PHANTOM, BARE], ids=["a guide", "no guide"])
def test_the_bevel_keeps_its_reach_with_a_margin_where_it_steers_alone(quick_plan, scenario):
    """The reach is charged with the deviations of the estimate, or with a multiple of them without a guide."""
    simulator = Simulator(scenario, threads=1)
    state = simulator.replay(simulator.start(), controls(1, db_x=31.0))[0]
    estimate, task = estimate_of(state, scenario), task_of(simulator, quick_plan)
    memory = ADAPTIVE.begin(task)
    ahead = adaptive_mpc.Ahead.of(task, state, memory.path)
    charged = {term.name: term.value for term in adaptive_mpc.cost_terms(task, estimate, memory, ahead)}
    sure, wide, wider = (
        adaptive_mpc.expected_out_of_reach(task, estimate, ahead, memory, margin)[0]
        for margin in (0.0, 1.0, task.settings.unguided_reach_margin)
    )
    assert (sure <= wide).all()
    assert (wide < wider).all()
    assert charged["reach"].keywords["expected"] == pytest.approx(
        wider if scenario is BARE else wide, rel=1e-12
    )


def test_cost_is_a_length_that_no_scale_of_tissue_changes(quick_plan, along):
    """Needle and tissue k times as stiff: the same shapes, so the same cost and command."""
    factor = 3.7
    stiffer = {f"tissue.{k}.shear_modulus_kpa": factor * PHANTOM.tissue[k].shear_modulus_kpa for k in (0, 1)}
    scaled = PHANTOM.with_values(
        stiffer | {"needle.youngs_modulus_gpa": factor * PHANTOM.needle.youngs_modulus_gpa}
    )
    here, there = (
        decide(quick_plan, estimate_of(along(quick_plan, 40, scenario), scenario))
        for scenario in (PHANTOM, scaled)
    )
    assert there.cost == pytest.approx(here.cost, rel=1e-6)
    assert there.command == pytest.approx(here.command, abs=1e-6)
    assert there.miss == pytest.approx(here.miss, abs=1e-6)
