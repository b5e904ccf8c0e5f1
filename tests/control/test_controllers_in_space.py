"""Every controller in space, on the rigs it can steer: with guides on two axes and one, and none."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import flexneedle
from controllers import assert_predicted_shapes
from flexneedle.control.forecast import probability_beyond
from flexneedle.scenario.worlds import world
from flexneedle.types import DG_Z, ROLL
from synthetic_space import turned_plan

PERFECT = world(3, "perfect").with_values({"needle.nodes": 31, "setup.tip_to_skin_mm": 6.0})
"""A needle with a guide whose plant is the controllers' model, with the tracker's noise."""
DEPTH, OFF = 30.0, 1.5


def scenario_of(direction=0.6, off=OFF, **changes):
    """Return a scenario with a target in a direction (rad) across the axis."""
    return PERFECT.with_values(
        {
            "setup.axes": 2,
            "target.depth_mm": DEPTH,
            "target.lateral_mm": off * math.cos(direction),
            "target.lateral_z_mm": off * math.sin(direction),
            "plan.samples": 64,
            "plan.max_iterations": 25,
        }
        | {key.replace("__", "."): value for key, value in changes.items()}
    )


def inserted(scenario, controller, seed=0, force=True, plan=None):
    plan = plan or flexneedle.plan(scenario, threads=1)
    return flexneedle.insert(
        scenario,
        plan,
        seed,
        controller=controller,
        rig=flexneedle.VirtualRig("model"),
        force=force,
        threads=1,
    )


@cache
def done_of(plan, controller):
    """The insertion of a plan in its own scenario."""
    return inserted(plan.scenario, controller, plan=plan)


@pytest.fixture(scope="module")
def plans():
    rigs = {
        "two axes": scenario_of(),
        "one axis": scenario_of(setup__guide_axes=1, off=1.0),
        "no guide": scenario_of(setup__guide_to_skin_mm=None, off=0.4),
    }
    return {rig: flexneedle.plan(scenario, threads=1) for rig, scenario in rigs.items()}


@pytest.mark.parametrize(
    ("rig", "controller", "most"),
    [
        ("two axes", "open-loop", 0.05),
        ("two axes", "adaptive-mpc", 0.1),
        ("two axes", "ce-mpc", 0.2),
        ("two axes", "resolved-rate", 0.2),
        ("two axes", "broyden-mpc", 0.2),
        ("one axis", "open-loop", 0.05),
        *(
            pytest.param("one axis", controller, most, marks=pytest.mark.long)
            for controller, most in (("adaptive-mpc", 0.3), ("ce-mpc", 0.3), ("resolved-rate", 0.3))
        ),
        ("no guide", "open-loop", 0.05),
        ("no guide", "adaptive-mpc", 0.2),
        pytest.param("no guide", "ce-mpc", 0.3, marks=pytest.mark.long),
        ("no guide", "bevel-only", 0.3),
    ],
)
def test_a_controller_reaches_a_target_off_both_axes(plans, rig, controller, most):
    plan = plans[rig]
    done = done_of(plan, controller)
    assert done.outcome == "done"
    assert done.true_error_mm < most
    assert_predicted_shapes(done, plan.target)
    if rig == "one axis":
        assert all(period.command[DG_Z] == 0.0 for period in done.periods)


@pytest.mark.parametrize(
    "controller", [pytest.param("ce-mpc", marks=pytest.mark.long), "resolved-rate", "broyden-mpc"]
)
def test_the_guide_moves_about_its_home_on_each_axis(plans, controller):
    """If needle and plan are moved by more than the guide's travel, the commands stay the same."""
    y, z = -4.0, 7.0
    near = {"setup__max_guide_travel_mm": 3.0, "tracker__jitter_mm": 0.0}
    entry = {"entry__lateral_mm": y, "entry__lateral_z_mm": z}
    here = replace(plans["two axes"], scenario=scenario_of(**near))
    x, *off = here.target
    target = (x, off[0] + y, off[1] + z)
    goal = {"target__lateral_mm": target[1], "target__lateral_z_mm": target[2]}
    moved = {name: getattr(here, name) + np.array([0.0, y, z, 0.0, 0.0]) for name in ("tips", "shapes")}
    there = replace(
        here,
        scenario=scenario_of(**near, **entry, **goal),
        target=target,
        guide=here.guide + np.array([y, z]),
        **moved,
    )
    one, other = (inserted(plan.scenario, controller, plan=plan) for plan in (here, there))
    commands = [np.array([period.command for period in done.periods]) for done in (one, other)]
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-6)


@pytest.fixture(scope="module")
def quiet_plan():
    """A plan along y for a tracker without noise."""
    return flexneedle.plan(scenario_of(0.0, tracker__jitter_mm=0.0), threads=1)


@pytest.mark.parametrize(
    "controller",
    ["resolved-rate", *(pytest.param(one, marks=pytest.mark.long) for one in ("broyden-mpc", "bevel-only"))],
)
def test_a_target_on_the_other_axis_is_reached_in_the_same_way(quiet_plan, controller):
    """Target and plan turned by 90° turn all commands and tips.

    Only the start that is fitted in air differs: both axes share the sensitivity along y.
    """
    other = replace(
        turned_plan(quiet_plan, math.pi / 2), scenario=scenario_of(math.pi / 2, tracker__jitter_mm=0.0)
    )
    first, second = (inserted(plan.scenario, controller, plan=plan) for plan in (quiet_plan, other))
    assert len(first.periods) == len(second.periods)
    for before, after in zip(first.periods, second.periods, strict=True):
        assert after.true_tip.z == pytest.approx(before.true_tip.y, abs=2e-3)
        assert after.true_tip.y == pytest.approx(-before.true_tip.z, abs=2e-3)
        assert after.command.dg_z == pytest.approx(before.command.dg_y, abs=2e-3)
        assert after.command.roll == pytest.approx(before.command.roll, abs=2e-3)


def test_a_driver_with_a_limited_rotation_stays_within_it():
    limit = 90.0
    scenario = scenario_of(2.5, setup__guide_axes=1, off=0.8, setup__max_rotation_deg=limit)
    plan = flexneedle.plan(scenario, threads=1)
    angle = plan.roll + np.cumsum(plan.controls[:, ROLL])
    assert np.abs(angle).max() <= math.radians(limit) + 1e-9
    done = inserted(scenario, "adaptive-mpc", plan=plan)
    assert max(abs(period.roll) for period in done.periods) <= math.radians(limit) + 1e-9


def test_half_turns_stay_half_turns():
    """With a guide on two axes the bevel still rolls by 180° alone."""
    scenario = scenario_of(1.0, setup__rotation="half-turns")
    done = inserted(scenario, "resolved-rate")
    assert {period.command.roll for period in done.periods} <= {0.0, math.pi}
    assert done.true_error_mm < 0.3


def test_where_nothing_steers_along_z_the_needle_is_held():
    """One-axis guide and half turns: the plan names the limit, the controller holds."""
    few = {"plan__max_iterations": 1, "plan__iterations": 1, "control__hold_limit_s": 0.1}
    rig = {"setup__guide_axes": 1, "setup__rotation": "half-turns"}
    scenario = scenario_of(math.pi / 2, off=6.0, **rig, **few)
    plan = flexneedle.plan(scenario, threads=1)
    assert plan.limit.startswith("setup.guide_axes = 1")
    done = inserted(scenario, "adaptive-mpc", plan=plan, force=False)
    assert done.outcome == "held"
    assert "predicted miss" in done.reason


@pytest.mark.parametrize(("miss", "sd"), [(0.3, 0.2), (2.0, 0.4), (0.0, 1.0), (0.9, 0.05)])
def test_the_probability_of_a_miss_in_space_agrees_with_samples(miss, sd):
    rng = np.random.default_rng(0)
    samples = np.hypot(miss + sd * rng.standard_normal(400_000), sd * rng.standard_normal(400_000))
    expected = np.mean(samples > 1.0)
    assert probability_beyond(1.0, miss * np.exp(0.7j).item(), sd) == pytest.approx(expected, abs=3e-3)


def test_a_certain_miss_in_space_is_beyond_the_limit_or_not():
    assert probability_beyond(1.0, complex(0.8, 0.8), 0.0) == 1.0
    assert probability_beyond(1.0, complex(0.6, 0.6), 0.0) == 0.0
    assert probability_beyond(1.0, complex(np.nan, 0.0), 0.1) == 0.0


def test_the_predicted_shape_ends_at_the_predicted_miss(plans):
    """The predicted nodes end at the target's depth, and are as uncertain there as the miss and the run-out."""
    done = done_of(plans["two axes"], "adaptive-mpc")
    predicted = [period for period in done.periods if math.isfinite(period.miss_sd)]
    assert len(predicted) > 20
    for period in predicted:
        nodes, sd = period.predicted
        assert nodes.shape == (31, 5)
        assert sd.shape == (31, 2)
        assert nodes[-1, 0] == pytest.approx(DEPTH, abs=0.4)
        assert (sd[-1] > 0.99 * period.miss_sd).all()
        assert (sd[-1] < np.hypot(period.miss_sd, 0.15)).all()
        assert np.isfinite(sd).all()
    last = predicted[-1].predicted
    true = done.periods[-1].true_tip
    assert abs(last.nodes[-1, 1] - true.y) < 4.0 * last.sd[-1, 0]
    assert abs(last.nodes[-1, 2] - true.z) < 4.0 * last.sd[-1, 1]
