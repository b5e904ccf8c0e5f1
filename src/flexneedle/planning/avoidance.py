"""Plans that keep the margins of zones, found where a plan without zones does not (`planning.detours`)."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from flexneedle.planning.carry_out import carry_out, make_rollout
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.detours import lengthen, refine, search_detours
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
from flexneedle.types import DB_X, Floats

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

    def attempt(solution: Solution, own: PlanProblem) -> _Try:
        plan = carry_out(simulator, problem, zones, found.strategy, found.seed, solution)
        return tries.add(_Try(plan, solution, own))

    for solution, own in solutions:
        clear, before, new = zones.margin + _RESERVE_MM, np.inf, attempt(solution, own)
        for repeat in range(_REPEATS):
            near = new.off <= min(_MENDED_MM, before) and new.solution.terms["zones"] <= _CLEAR_MM
            if tries.found or not near:
                break
            clear, before = clear + (1 + repeat) * new.plan.intrusion_mm, _MENDED * new.off
            mended = new.mend(clear)
            new = attempt(refine(rollout, mended, new.solution, search, rng, progress), mended)
        if tries.found:
            break
    if not tries.plan.hit and tries.best and tries.best.off <= _NEARLY_MM:
        more = replace(search, samples=_MORE * search.samples, elite=_MORE * search.elite)
        mended = tries.best.mend(zones.margin + _RESERVE_MM + 2.0 * tries.best.plan.intrusion_mm)
        attempt(refine(rollout, mended, tries.best.solution, more, rng, progress), mended)
    best = tries.plan
    if best.hit or best.limit.startswith("guard."):
        return best
    closest = zones.closest(best.shapes)
    limit = best.limit if best.intrusion_mm or closest is None else f"zone {closest.zone}"
    help_by = find_freedom(shapes_of, around, room, simulator.scenario.guard.zone_buffer_mm)
    return replace(best, limit=f"{limit}; {help_by} may suffice" if help_by else limit)


@dataclass(frozen=True, eq=False)
class _Try:
    """A plan, the solution that it carries out, and the problem that this solves."""

    plan: Plan
    solution: Solution
    problem: PlanProblem

    @property
    def off(self) -> float:
        """Intrusion into margins and miss of the plan beyond what is precise (mm)."""
        return _off(self.plan)

    def mend(self, clear: float) -> PlanProblem:
        """Return the problem at a clearance (mm), without a preference for more, and with the travel of the plan.

        The search measures the miss of a needle that ends short of the target's depth on its tangent.
        """
        short = float(self.plan.controls[:, DB_X].sum() - self.solution.controls[:, DB_X].sum())
        return lengthen(replace(self.problem, clear=clear, spare=0.0), short)


class _Tries:
    """The plan without zones, the best of the tries, and the history of all."""

    def __init__(self, found: Plan) -> None:
        self._without, self._history = found, found.history
        self.best: _Try | None = None

    def add(self, new: _Try) -> _Try:
        """Add a try and return it."""
        self._history = (*self._history, *new.plan.history)
        if _rank(new.plan) < _rank(self.best.plan if self.best else self._without):
            self.best = new
        return new

    @property
    def plan(self) -> Plan:
        """The best plan, with the history of all."""
        best = self.best.plan if self.best else self._without
        return replace(best, history=self._history, iterations=len(self._history))

    @property
    def found(self) -> bool:
        """True if the best plan keeps all margins and reaches its target precisely."""
        return self.best is not None and self.best.plan.hit and self.best.plan.error_mm <= PRECISE_MM


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
    rollout = make_rollout(simulator, around.terms)
    return next(search_detours(rollout, shapes_of, around, room, short, rng, progress))[0]


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
