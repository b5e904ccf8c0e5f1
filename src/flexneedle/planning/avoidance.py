"""Plans that keep the margins of zones, found where a plan without zones does not (`planning.detours`)."""

from dataclasses import replace
from functools import partial

import numpy as np

from flexneedle.planning.carry_out import carry_out, make_rollout
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.detours import refine, search_detours
from flexneedle.planning.freedom import find_freedom
from flexneedle.planning.horizon import OnIteration, count_iterations, search_settings
from flexneedle.planning.primitives import Solution
from flexneedle.planning.problem import PlanProblem
from flexneedle.planning.steering import inner_reach
from flexneedle.planning.ways import Room
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.excess import LoadLimits
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import ZoneMap
from flexneedle.types import Floats

PRECISE_MM = 0.1
"""Miss of a plan above which other searches are made."""
_RESERVE_MM = 0.1  # of clearance in a search, beyond the margin
_SPARE = 0.5  # of the margin, which is preferred beyond it
_SKETCHED = 10  # iterations of a sketch after the race
_REPEATS = 2  # of a search, with more clearance where the exact rod enters a margin
_MENDED_MM = 1.0  # largest intrusion and miss for which it is repeated,
_MENDED = 0.8  # and share of those before
_CLEAR_MM = 5.0  # cost of the margins of a plan that nearly keeps them by the simulator
_NEARLY_MM = 0.5  # of intrusion and miss, for which a last search with more samples is made
_MORE = 3
_OVERLOAD_MM = 10.0  # rank of a load beyond a limit of the guard


def avoid_zones(
    simulator: Simulator,
    problem: PlanProblem,
    zones: ZoneMap,
    found: Plan,
    rng: np.random.Generator,
    progress: OnIteration,
) -> Plan:
    """Return the first plan that keeps all margins and reaches the target; of others, the best with what it lacks."""
    around, search = _go_around(simulator, problem, zones), _search_settings(simulator)
    shapes_of, room = make_rollout(simulator, (), at_end=("shapes",)), make_room(simulator.scenario, zones)
    rollout, usual = make_rollout(simulator, around.terms), found.iterations + (search.usual or 0)
    after = count_iterations(progress, found.iterations, usual, np.inf)
    solutions = search_detours(rollout, shapes_of, around, room, search, rng, after)
    tries = _Tries(found)
    for solution in solutions:
        clear, before = zones.margin + _RESERVE_MM, np.inf
        for repeat in range(1 + _REPEATS):
            new = tries.add(
                carry_out(simulator, problem, zones, found.strategy, found.seed, solution), solution
            )
            near = _off(new) <= min(_MENDED_MM, before) and solution.terms["zones"] <= _CLEAR_MM
            if tries.found or repeat == _REPEATS or not near:
                break
            clear, before = clear + (1 + repeat) * new.intrusion_mm, _MENDED * _off(new)
            farther = replace(around, clear=clear, spare=0.0)
            solution = refine(rollout, farther, solution, search, rng, progress)
        if tries.found:
            break
    if not tries.found and tries.solution is not None and _off(tries.best) <= _NEARLY_MM:
        more = replace(search, samples=_MORE * search.samples, elite=_MORE * search.elite)
        clear = zones.margin + _RESERVE_MM + 2.0 * tries.best.intrusion_mm
        farther = replace(around, clear=clear, spare=0.0)
        solution = refine(rollout, farther, tries.solution, more, rng, progress)
        tries.add(carry_out(simulator, problem, zones, found.strategy, found.seed, solution), solution)
    best = replace(tries.best, history=tries.history, iterations=len(tries.history))
    if best.hit or best.limit.startswith("guard."):
        return best
    closest = zones.closest(best.shapes)
    limit = best.limit if best.intrusion_mm or closest is None else f"zone {closest.zone}"
    help_by = find_freedom(shapes_of, around, room, simulator.scenario.guard.zone_buffer_mm)
    return replace(best, limit=f"{limit}; {help_by} may suffice" if help_by else limit)


class _Tries:
    """The best of the plans that were tried, its solution, and the history of all."""

    def __init__(self, found: Plan) -> None:
        self.best, self.history = found, found.history
        self.solution: Solution | None = None

    def add(self, plan: Plan, solution: Solution) -> Plan:
        """Add a plan and return it."""
        self.history = (*self.history, *plan.history)
        if _rank(plan) < _rank(self.best):
            self.best, self.solution = plan, solution
        return plan

    @property
    def found(self) -> bool:
        """Whether the best plan keeps all margins and reaches its target precisely."""
        return self.best.hit and self.best.error_mm <= PRECISE_MM


def sketch_detour(
    simulator: Simulator,
    problem: PlanProblem,
    zones: ZoneMap,
    rng: np.random.Generator,
    progress: OnIteration,
) -> Solution:
    """Return the best way past zones after a short search."""
    around = _go_around(simulator, problem, zones)
    shapes_of, room = make_rollout(simulator, (), at_end=("shapes",)), make_room(simulator.scenario, zones)
    short = replace(_search_settings(simulator), iterations=_SKETCHED, usual=_SKETCHED)
    return next(
        search_detours(make_rollout(simulator, around.terms), shapes_of, around, room, short, rng, progress)
    )


def _go_around(simulator: Simulator, problem: PlanProblem, zones: ZoneMap) -> PlanProblem:
    """Return the problem with zones."""
    length, spare = simulator.scenario.needle.length_mm, _SPARE * zones.margin
    problem = replace(problem, clear=zones.margin + _RESERVE_MM, spare=spare, length=length)
    if not problem.entry_coordinates:
        return problem
    return replace(problem, inner=inner_reach(make_rollout(simulator, ()), problem))


def _search_settings(simulator: Simulator) -> Search:
    plan = simulator.scenario.plan
    return search_settings(plan, plan.samples)


def _rank(plan: Plan) -> tuple[float, float]:
    """Return the order of plans: by what they lack (mm), then cost."""
    return _off(plan) + _OVERLOAD_MM * plan.limit.startswith("guard."), plan.cost


def _off(plan: Plan) -> float:
    """Return the intrusion of a plan into margins and its miss beyond what is precise (mm)."""
    return plan.intrusion_mm + max(0.0, plan.error_mm - PRECISE_MM)


def make_room(scenario: Scenario, zones: ZoneMap) -> Room:
    """Return what first paths are judged by."""
    curvature = 2.0 * LoadLimits.of(scenario).strain / scenario.needle.outer_diameter
    return Room(zones.least_clearances, partial(_compression_lengths, scenario), curvature)


def _compression_lengths(scenario: Scenario, depths: Floats) -> Floats:
    """Return the compression lengths (p,), mm, of the layers at depths (p,)."""
    layer = np.searchsorted(scenario.layer_tops, depths, side="right") - 1
    lengths: Floats = np.array([each.compression_length_mm for each in scenario.tissue])[layer]
    return lengths
