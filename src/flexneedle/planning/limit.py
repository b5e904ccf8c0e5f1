"""The limit that keeps a plan from its target, by the key that sets it."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexneedle.costs.terms import PLAN, SHARE_OF_LIMIT
from flexneedle.costs.weighted_sum import RolloutFunction, Trajectories
from flexneedle.planning.problem import LATERAL, PlanProblem
from flexneedle.planning.steering import radius, reach
from flexneedle.results import TARGET_RADIUS_MM, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.simulator.excess import Excess, LoadLimits
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, Floats, X, Z, across

_AT_LIMIT = 0.999  # share of a limit that counts as reached
_REACHED_MM = 0.05  # the hull of what a bevel with a range of angles reaches is known to about this


def find_limit(
    scenario: Scenario,
    problem: PlanProblem,
    rollout: RolloutFunction,
    rows: Floats,
    end: Floats,
    terms: Mapping[str, float],
    load: Excess,
) -> str:
    """Name the key of the limit that keeps the plan from its target; empty if it reaches it.

    A load beyond a limit of the guard and a target out of the bevel's reach are named even if the plan ends within 1 mm
    of the target. `setup.max_rotation_deg` is named where a driver without that limit would reach the target.

    rows: controls (m, 9) of the plan; end: pose of its tip (5,); terms: its cost (mm) by name; load: the largest one.
    """
    setup, travel = scenario.setup, np.cumsum(rows[:, :ROLL], axis=0)
    if load.share > 1.0:
        return f"guard.{load.key}"
    off = math.dist(end[:3], problem.target)
    if travel[-1, DB_X] > _AT_LIMIT * setup.stroke_mm and end[X] < problem.target[0] - 0.5:
        return f"setup.stroke_mm = {setup.stroke_mm:g}"
    missed = not problem.narrow or off > _REACHED_MM
    if problem.bevel_alone and missed and (beyond := _limit_of_bevel(scenario, problem, rollout)):
        return beyond
    if off <= TARGET_RADIUS_MM:
        return ""
    if (
        setup.axes == 2
        and abs(end[Z] - problem.target[2]) > TARGET_RADIUS_MM
        and (key := _limit_along_z(setup, problem, rollout))
    ):
        return key
    most = np.abs(travel).max(axis=0)
    # The search bounds a step in the direction of its frame.
    steps = {first: np.abs(across(rows, first)).max() for first in (DB_Y, DB_THETA, DG_Y)}
    for name, largest in (
        ("max_guide_travel_mm", most[DG_Y:].max()),
        ("max_base_travel_mm", most[DB_Y:DB_THETA].max()),
        ("max_guide_step_mm", steps[DG_Y]),
        ("max_base_step_mm", steps[DB_Y]),
        ("max_base_turn_step_mrad", 1e3 * steps[DB_THETA]),
    ):
        if largest > _AT_LIMIT * getattr(setup, name):
            return f"setup.{name} = {getattr(setup, name):g}"
    if load.share > _AT_LIMIT * SHARE_OF_LIMIT:
        return f"guard.{load.key} (a plan uses up to {SHARE_OF_LIMIT:.0%} of it)"
    return _limit_of_search(scenario.plan, terms)


def find_largest_load(limits: LoadLimits, simulator: Simulator, start: State, steps: Trajectories) -> Excess:
    """Return the load after a step that is the largest share of its limit.

    steps: rollout of the plan (N = 1) from its start with strain, stretch and loads. Only the states at their extremes
    are evaluated, but all where layers differ in their limits of compression.
    """
    forces = np.hypot(steps.loads[0, :, 4], steps.loads[0, :, 5])
    worst = {int(steps.strain[0].argmax()), int(steps.stretch[0].argmin()), int(forces.argmax())}
    chosen = worst if np.ptp(limits.compression) == 0.0 else range(len(forces))
    states = (simulator.replay(start, steps.controls[0, : k + 1])[0] for k in sorted(chosen))
    return max((load for state in states for load in limits.excesses(state)), key=lambda load: load.share)


def _limit_of_search(settings: Any, terms: Mapping[str, float]) -> str:
    """Name the weight of the term that costs more than the miss; the size of the search if none does."""
    one_roll = PLAN.weights(settings)["rolls"]  # that the plan may lack
    charged = {**terms, "rolls": max(terms["rolls"], one_roll)}
    largest = max(charged, key=lambda name: charged[name])
    if largest in (term.term for term in settings.terms or ()):
        return f"plan.terms ({largest} costs more than the miss)"
    if key := next((weight.key for _, weight in PLAN.rows() if weight.name == largest), ""):
        return f"plan.{key} = {getattr(settings, key):g} (costs more than the miss)"
    return f"plan.samples = {settings.samples} (the search found no better plan)"


def _limit_of_bevel(scenario: Scenario, problem: PlanProblem, rollout: RolloutFunction) -> str:
    """Name the key that keeps the bevel alone from the target; empty if nothing does."""
    least, greatest = reach(rollout, problem)
    if least <= problem.lateral <= greatest:
        return ""
    from_axis = (
        f" from the needle's axis, the target is at {format_mm(problem.lateral)}" if problem.axis else ""
    )
    anywhere = " in any direction" if problem.axes == 2 and not problem.half_turns else ""
    why = f"the bevel alone reaches {least:.3f} to {format_mm(greatest)} lateral{anywhere}{from_axis}"
    if problem.narrow:
        size, most = radius(rollout, problem), scenario.setup.max_rotation_deg
        if problem.lateral <= size:
            there = f"{least:.3f} to {format_mm(greatest)}" if least <= greatest else "nothing"
            line = f"on the line from the needle's axis to the target at {format_mm(problem.lateral)}"
            return f"setup.max_rotation_deg = {most:g} ({line} the bevel alone reaches {there})"
        why = f"the bevel alone reaches at most {format_mm(size)} lateral{from_axis}"
    return f"needle.bevel.offset_mm = {scenario.needle.bevel.offset_mm:g} ({why})"


def _limit_along_z(setup: Setup, problem: PlanProblem, rollout: RolloutFunction) -> str:
    """Name the key that keeps the needle from the target's z; empty if guide, base or bevel reach it."""
    if problem.sigma[LATERAL + 1 : problem.bevel.start : 2].any():
        return ""
    if problem.half_turns:
        if problem.bevel_alone:
            return f"{setup.half_turns_by} (nothing steers along z)"
        return f"setup.guide_axes = 1 (nothing else steers along z with {setup.half_turns_by})"
    size = radius(rollout, problem)
    most = size * math.sin(min(problem.rotation, 0.5 * math.pi))
    if problem.bevel_alone or abs(problem.across.imag) <= most:
        return ""
    why = f"along z only the bevel steers, by up to {format_mm(most)}"
    limited = problem.narrow and abs(problem.across.imag) <= size
    key = f"max_rotation_deg = {setup.max_rotation_deg:g}" if limited else "guide_axes = 1"
    return f"setup.{key} ({why})"
