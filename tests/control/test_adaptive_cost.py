"""Cost of a path by the default controller: weights, miss and reach."""

import math
from dataclasses import replace

import pytest

from adaptive import ADAPTIVE, BARE, PHANTOM, QUICK, decide, decided, estimate_of, unrolled
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.outlook import Outlook
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
    listed = adaptive_mpc.cost_terms(
        task, estimate, memory, ahead, adaptive_mpc.find_ends(task, estimate, ahead)
    )
    return {term.name: term.weight for term in listed}, task, estimate, ahead


def test_weights_are_the_settings_over_scales_of_the_scenario(quick_plan):
    """Energies relative to the scale of this tissue, slope by the path left, late rolls by their effect.

    The reach counts where only the bevel steers, the guide's force where it has a limit.
    """
    found, task, estimate, ahead = weights(PHANTOM, quick_plan, 10.0)
    settings, scale = task.settings, PHANTOM.energy_scale(40.0)
    expected = {
        "miss": 1.0,
        "end energy": settings.end_energy_weight_mm / scale,
        "mean energy": settings.mean_energy_weight_mm / scale,
        "peak energy": settings.peak_energy_weight_mm / scale,
        "limits": settings.limit_weight_mm,
        "guide force": 0.0,
        "travel": settings.travel_weight,
        "slope": settings.slope_weight_mm * ahead.left / 40.0,
        "rolls": settings.roll_weight_mm,
        "late": settings.late_roll_weight * estimate.roll_sd,
        "reach": 0.0,
        "reserve": 0.0,
    }
    assert found == expected
    assert 0.7 < ahead.left / 40.0 < 0.8
    assert estimate.roll_sd > 0.0
    limited = PHANTOM.with_values({"guard.guide_force_n": 1.0})
    assert weights(limited, quick_plan, 10.0)[0] == expected | {"guide force": settings.limit_weight_mm}
    bare, task, _, _ = weights(BARE, quick_plan, 10.0)
    assert bare["reach"] == task.settings.unguided_reach_weight > 0.0
    assert bare["peak energy"] == expected["peak energy"]


@pytest.mark.parametrize(
    ("strategy", "steps", "share"),
    [
        ("manipulation", 40, 1.0), ("manipulation", 71, 1.0),
        ("steering", 10, 1.0), ("steering", 40, None), ("steering", 71, 5.0 / 40.0),
    ],
)  # fmt: skip
def test_a_miss_is_charged_with_the_precision_of_the_settings(quick_plan, along, strategy, steps, share):
    """|d| + d²/s of the path's end as the tracker measures it.

    With the bevel alone s shrinks with the path left, up to five steps before the target.
    """
    scenario = QUICK.with_values({"control.adaptive_mpc.precision_mm": 0.7})
    estimate = estimate_of(along(quick_plan, steps), scenario)
    plan = replace(quick_plan, target=(40.0, 9.0, 0.0), strategy=strategy)
    task = task_of(estimate.nominal, plan)
    memory = ADAPTIVE.begin(task)
    ahead = adaptive_mpc.Ahead.of(task, estimate.state, memory.path)
    trajectories = adaptive_mpc.rollout_as_measured(estimate, ahead.controls(ahead.current[None])[0])
    (term,) = (
        term
        for term in adaptive_mpc.cost_terms(
            task, estimate, memory, ahead, adaptive_mpc.find_ends(task, estimate, ahead)
        )
        if term.name == "miss"
    )
    off = abs(float(terms.past_target(trajectories.tips, plan.target)[0].real))
    assert off > 0.5
    precision = 0.7 * (share or ahead.left / 40.0)
    assert term.value(trajectories)[0] == pytest.approx(off + off**2 / precision)


@pytest.mark.parametrize("strategy", ["manipulation", "steering"])
def test_the_deviation_of_the_miss_is_the_outlooks(quick_plan, along, strategy):
    """With a guide corrections to come are counted on."""
    plan = replace(quick_plan, strategy=strategy)
    estimate = estimate_of(along(plan, 40), QUICK)
    decision, memory = decided(plan, estimate)
    expected = memory.outlook.sd(estimate, 40.0, decision.miss, guided=strategy == "manipulation")
    assert decision.miss_sd == expected > 0.0


@pytest.mark.parametrize(("margin", "charged"), [(0.0, False), (1.5, True)])
def test_the_reserve_is_charged_from_the_second_decision_on_with_a_guide(quick_plan, along, margin, charged):
    scenario = QUICK.with_values({"control.adaptive_mpc.reserve_margin": margin})
    estimate = estimate_of(along(quick_plan, 40), scenario)
    memory = decided(quick_plan, estimate)[1]
    assert memory.lever is not None
    assert (weights(scenario, quick_plan, 10.0, memory)[0]["reserve"] == 1.0) == charged
    steering = replace(quick_plan, strategy="steering")
    assert weights(scenario, steering, 10.0, decided(steering, estimate)[1])[0]["reserve"] == 0.0


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
    expected, angle = adaptive_mpc.expected_out_of_reach(
        task, estimate, ahead, Outlook.of(estimate), adaptive_mpc.find_ends(task, estimate, ahead), 1.0
    )
    rollout = adaptive_mpc.rollout_as_measured(estimate, ahead.constant)
    kept, _, rolled, _ = terms.out_of_reach(rollout, expected, angle)
    assert min(kept, rolled) >= 0.0
    assert (kept < rolled) == (side == state.bevel.real)


def test_the_bevel_keeps_its_reach_with_a_margin_where_it_steers_alone(quick_plan):
    """The reach is charged with a multiple of the deviations of the estimate."""
    simulator = Simulator(BARE, threads=1)
    state = simulator.replay(simulator.start(), controls(1, db_x=31.0))[0]
    estimate, task = estimate_of(state, BARE), task_of(simulator, quick_plan)
    memory = ADAPTIVE.begin(task)
    ahead = adaptive_mpc.Ahead.of(task, state, memory.path)
    charged = {
        term.name: term.value
        for term in adaptive_mpc.cost_terms(
            task, estimate, memory, ahead, adaptive_mpc.find_ends(task, estimate, ahead)
        )
    }
    sure, wide, wider = (
        adaptive_mpc.expected_out_of_reach(
            task, estimate, ahead, Outlook.of(estimate), adaptive_mpc.find_ends(task, estimate, ahead), margin
        )[0]
        for margin in (0.0, 1.0, task.settings.unguided_reach_margin)
    )
    assert (sure <= wide).all()
    assert (wide < wider).all()
    assert charged["reach"].keywords["expected"] == pytest.approx(wider, rel=1e-12)


def test_cost_is_a_length_that_no_scale_of_tissue_changes(quick_plan, along):
    """Needle and tissue k times as stiff: the same shapes, so the same cost and command."""
    factor = 100.0
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
