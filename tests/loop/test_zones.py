"""Zones in closed loop: the guard holds before a touch and lets a needle lead away; controllers keep the margin."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.loop.guard import Guard
from flexneedle.results import Outcome
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import zones_of
from flexneedle.types import Control, X
from observed import begun

PERFECT = load_scenario("world:7:perfect")
FREE = {"entry.free_radius_mm": 15.0, "entry.free_slope_mrad": 200.0}


def ball(center, radius=0.5):
    return {"shape": "sphere", "name": "artery", "center_mm": list(center), "radius_mm": radius}


def clearances_of(insertion, zones):
    return [
        float(zones.shape_clearances(p.true_shape)) for p in insertion.periods if p.true_shape is not None
    ]


@pytest.fixture(scope="module")
def plan():
    return flexneedle.plan(PERFECT)


def ahead_of(plan, depth):
    """Return the point of the planned path at a depth."""
    return plan.tips[np.searchsorted(plan.tips[:, X], depth), :3]


def guard_at(scenario, plan, depth):
    """Return guard and estimate of a needle that is driven straight to a depth."""
    simulator = Simulator(scenario, 1)
    state = simulator.advance_to(simulator.start(), depth)
    return Guard.of(scenario, plan), begun(simulator, state), state


@pytest.mark.parametrize(("off", "refused"), [(1.2, True), (2.5, False)])
def test_a_command_that_would_enter_the_buffer_of_a_zone_is_refused(plan, off, refused):
    """The sphere has a radius of 0.5 mm, the buffer is 0.5 mm; the next step passes it."""
    straight = Simulator(PERFECT, 1)
    there = straight.advance_to(straight.start(), 11.0).tip
    scenario = PERFECT.with_values({"zone": [ball((there[0] + 0.5, there[1] + off, there[2]))]})
    guard, estimate, _ = guard_at(scenario, plan, 10.0)
    reason = guard.refusal(estimate, Control(db_x=1.0))
    assert bool(reason) == refused
    if refused:
        assert reason.startswith("guard: clearance from zone artery would be ")


def test_in_the_buffer_a_needle_may_lead_away_but_not_nearer(plan):
    _, _, state = guard_at(PERFECT, plan, 10.0)
    x, y, z = state.tip[:3]
    radius = 0.5 * PERFECT.needle.outer_diameter
    scenario = PERFECT.with_values({"zone": [ball((x + 0.6 + radius, y, z), 0.3)]})
    guard, estimate, _ = guard_at(scenario, plan, 10.0)
    assert "artery" in guard.refusal(estimate, Control(db_x=0.2))
    assert guard.refusal(estimate, Control(db_x=-0.2)) == ""


def test_without_terms_of_zones_the_guard_holds_before_a_touch(plan):
    """A zone on the planned path that the plan did not know."""
    scenario = PERFECT.with_values(
        {"zone": [ball(ahead_of(plan, 20.0))], "control.adaptive_mpc.zone_weight": 0.0}
    )
    insertion = flexneedle.insert(scenario, _as_of(plan, scenario), force=True)
    assert insertion.outcome is Outcome.HELD
    assert "zone artery" in insertion.reason
    assert min(clearances_of(insertion, zones_of(scenario))) > 0.2


@pytest.mark.parametrize("controller", ["adaptive-mpc", "ce-mpc"])
def test_a_clear_plan_is_carried_out_clear(controller):
    """With the shipped mismatch of the world, and a zone where the plan without zones would go."""
    base = load_scenario("world:7").with_values(FREE)
    at = ahead_of(flexneedle.plan(base), 15.0)
    scenario = base.with_values({"zone": [ball(at)]})
    made = flexneedle.plan(scenario)
    insertion = flexneedle.insert(scenario, made, controller=controller)
    assert made.intrusion_mm == 0.0
    assert insertion.outcome is Outcome.DONE
    assert min(clearances_of(insertion, zones_of(scenario))) > 1.5
    recorded = [p.clearance for p in insertion.periods]
    assert min(recorded) == pytest.approx(min(clearances_of(insertion, zones_of(scenario))), abs=0.5)


def _as_of(plan, scenario):
    return replace(plan, scenario=scenario)


def test_an_insertion_in_open_loop_that_the_guard_holds_ends_as_held(plan):
    scenario = PERFECT.with_values({"zone": [ball(ahead_of(plan, 20.0))]})
    insertion = flexneedle.insert(scenario, _as_of(plan, scenario), controller="open-loop", force=True)
    assert insertion.outcome is Outcome.HELD
    assert "zone artery" in insertion.reason
