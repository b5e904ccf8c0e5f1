"""The limit that keeps a plan from its target, by the key that sets it."""

import math
from collections.abc import Iterable

import numpy as np

from flexneedle.costs.terms import SHARE_OF_LIMIT
from flexneedle.costs.weighted_sum import RolloutFunction
from flexneedle.planning.problem import LATERAL, PlanProblem
from flexneedle.planning.steering import radius, reach
from flexneedle.results import TARGET_RADIUS_MM, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.simulator.excess import Excess
from flexneedle.simulator.state import State
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, Floats, X, Z, across

_AT_LIMIT = 0.999  # share of a limit that counts as reached
_REACHED_MM = 0.05  # the hull of what a bevel with a range of angles reaches is known to about this


def find_limit(
    scenario: Scenario, problem: PlanProblem, rollout: RolloutFunction, rows: Floats, states: list[State]
) -> str:
    """Name the key of the limit that keeps the plan from its target; empty if it reaches it.

    A target out of the bevel's reach is named even if the plan ends within 1 mm of it. `setup.max_rotation_deg` is
    named where a driver without that limit would reach the target.
    """
    setup, end = scenario.setup, states[-1].tip
    off = math.dist(end[:3], problem.target)
    if rows[:, DB_X].sum() > _AT_LIMIT * setup.stroke_mm and end[X] < problem.target[0] - 0.5:
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
    travel = np.abs([state.travel for state in states]).max(axis=0)
    # The search bounds a step in the direction of its frame.
    steps = {first: np.abs(across(rows, first)).max() for first in (DB_Y, DB_THETA, DG_Y)}
    for name, largest in (
        ("max_guide_travel_mm", travel[DG_Y:].max()),
        ("max_base_travel_mm", travel[DB_Y:DB_THETA].max()),
        ("max_guide_step_mm", steps[DG_Y]),
        ("max_base_step_mm", steps[DB_Y]),
        ("max_base_turn_step_mrad", 1e3 * steps[DB_THETA]),
    ):
        if largest > _AT_LIMIT * getattr(setup, name):
            return f"setup.{name} = {getattr(setup, name):g}"
    charged = find_largest_load(problem, states)
    if charged.share > _AT_LIMIT * SHARE_OF_LIMIT:
        return f"guard.{charged.key} (a plan uses up to {SHARE_OF_LIMIT:.0%} of it)"
    return f"plan.samples = {scenario.plan.samples} (the search found no better plan)"


def find_largest_load(problem: PlanProblem, states: Iterable[State]) -> Excess:
    """Return the load of all states that is the largest share of its limit."""
    loads = (load for state in states for load in problem.loads.excesses(state))
    return max(loads, key=lambda load: load.share)


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
