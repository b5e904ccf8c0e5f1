"""Plan an insertion: the cross-entropy method on rollouts of the simulator (paper section III-A)."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flexneedle.arguments import check_point, check_whole
from flexneedle.costs.terms import charge_miss
from flexneedle.errors import InputError
from flexneedle.planning import STRATEGIES
from flexneedle.planning.avoidance import PRECISE_MM, avoid_zones, sketch_detour
from flexneedle.planning.carry_out import carry_out, end_at_depth, fix_entry, make_rollout
from flexneedle.planning.events import Iterated, Listener, send_event
from flexneedle.planning.horizon import OnIteration, count_iterations, search_settings
from flexneedle.planning.primitives import Solution, fix_guide, search_primitives, widen_search
from flexneedle.planning.problem import PlanProblem, make_problem
from flexneedle.planning.steering import MOST_ROLLS, reach, search_rolls
from flexneedle.results import TARGET_RADIUS_MM, Plan, format_mm
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario, check_target
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import Floats, Point, Z

_TARGET = "depth and lateral offsets in mm"
# plan.samples over this for each number of rolls and side, where only depths of rolls are searched
_SHARE_OF_A_SEARCH = 4
_LEAST_SAMPLES = 8
_ENOUGH_ROLLS = 1  # to reach a target, though not at the least cost


def plan(
    scenario: str | Path | Scenario,
    target: Sequence[float] | None = None,
    strategy: str = "manipulation",
    seed: int = 0,
    *,
    threads: int | None = None,
    listeners: Sequence[Listener] = (),
) -> Plan:
    """Plan an insertion to a target by the cross-entropy method. Same seed, same plan.

    If the plan misses its target by more than 0.1 mm although guide or base may move, the search is repeated with wider
    samples, then with the bevel alone, and the plan of least cost is returned.

    Args:
        scenario: A scenario, its name or its path, as for `load_scenario`.
        target: (x, y) or (x, y, z) in mm (default: the scenario's).
        strategy: "manipulation" moves guide and bevel; "steering" moves only the bevel (paper section III-A, but on the
            needle itself, not on a softer one).
        seed: Seed of the search.
        threads: Threads of rollouts (default: all cores), without effect on the result.
        listeners: Functions that receive an `Iterated` after each iteration.

    Raises:
        ScenarioError: The scenario excludes the target.
        InputError: Another argument cannot be used.
    """
    scenario, seed = load_scenario(scenario), check_whole("seed", seed, 0)
    if strategy not in STRATEGIES:
        raise InputError(f"strategy = {strategy!r}: must be one of {', '.join(STRATEGIES)}")
    goal = scenario.target.position if target is None else check_point("target", target, _TARGET)
    check_target(scenario, *goal)
    begun, simulator = time.perf_counter(), Simulator(scenario, threads)
    found = search_plan(simulator, goal, strategy, seed, _report_to(listeners, strategy))
    return replace(found, seconds=time.perf_counter() - begun)


def search_plan(simulator: Simulator, goal: Point, strategy: str, seed: int, progress: OnIteration) -> Plan:
    """Return the plan from the simulator's start to the goal (mm), as `plan` does, for a simulator of any needle."""
    scenario, rng = simulator.scenario, np.random.default_rng(seed)
    problem, zones = make_problem(scenario, goal, strategy), zones_of(scenario)
    found = carry_out(simulator, problem, zones, strategy, seed, _search(simulator, problem, rng, progress))
    for change in _other_searches(problem):
        if found.error_mm <= PRECISE_MM:
            break
        usual = found.iterations + scenario.plan.iterations
        after = count_iterations(progress, found.iterations, usual, found.cost)
        again = _search(simulator, change(problem), rng, after)
        found = _choose_better(found, carry_out(simulator, problem, zones, strategy, seed, again))
    if not found.intrusion_mm:
        return found
    return avoid_zones(simulator, problem, zones, found, rng, progress)


def _other_searches(problem: PlanProblem) -> tuple[Callable[[PlanProblem], PlanProblem], ...]:
    """Return the changes of the problem with which it is searched again after a miss, if guide or base may move.

    A search that begins with small lateral steps can lose its spread before it gets to a far target. In stiff tissue
    rolls alone can reach targets that a search of guide and bevel of 20 times the size misses.
    """
    return () if problem.bevel_alone else (widen_search, fix_guide)


def _report_to(listeners: Sequence[Listener], strategy: str) -> OnIteration:
    return lambda info: send_event(Iterated(strategy, info), listeners)


@dataclass(frozen=True, eq=False)
class Sketch:
    """Result of a quick search, carried out without stops."""

    tips: Floats  # poses of the tip (m + 1, 5)
    needle: Floats  # nodes of the needle at the end (n, 5)
    roll: float  # its roll at the start (rad)
    error_mm: float  # distance from its tip to the target
    intrusion_mm: float = 0.0  # largest distance by which it enters the margin of a zone

    @property
    def reached(self) -> bool:
        """Whether the sketch ends within 1 mm of the target, outside of all margins."""
        return self.error_mm <= TARGET_RADIUS_MM and not self.intrusion_mm

    @property
    def summary(self) -> str:
        """One line: distance from its tip to the target. A sketch that misses leaves open whether a plan reaches it."""
        ends = f"ends {format_mm(self.error_mm)} from the target"
        if self.intrusion_mm:
            ends += f", {format_mm(self.intrusion_mm)} inside the margin of a zone"
        return ends if self.reached else f"{ends}; whether a plan reaches it is not known yet"


def sketch(
    scenario: Scenario,
    strategy: str = "manipulation",
    seed: int = 0,
    *,
    threads: int | None = None,
    listeners: Sequence[Listener] = (),
) -> Sketch:
    """Search for an insertion to the scenario's target, as `plan` does, for a quick preview.

    Neither the states between nor what limits the plan are found. The bevel alone gets at most one roll, which reaches
    every target that several reach.
    """
    simulator, rng = Simulator(scenario, threads), np.random.default_rng(seed)
    problem, zones = make_problem(scenario, scenario.target.position, strategy), zones_of(scenario)
    progress = _report_to(listeners, strategy)
    solution = _search(simulator, problem, rng, progress, _ENOUGH_ROLLS)
    found = _make_sketch(simulator, problem, zones, strategy, solution)
    for change in _other_searches(problem):
        if found.error_mm <= TARGET_RADIUS_MM:
            break
        solution = _search(simulator, change(problem), rng, progress, _ENOUGH_ROLLS)
        again = _make_sketch(simulator, problem, zones, strategy, solution)
        found = min(found, again, key=lambda each: each.error_mm)
    if found.intrusion_mm:
        around = sketch_detour(simulator, problem, zones, rng, progress)
        again = _make_sketch(simulator, problem, zones, strategy, around)
        found = min(found, again, key=lambda each: each.intrusion_mm + each.error_mm)
    return found


def _make_sketch(
    simulator: Simulator, problem: PlanProblem, zones: ZoneMap, strategy: str, solution: Solution
) -> Sketch:
    simulator, _ = fix_entry(simulator, problem, solution, strategy)
    rows = end_at_depth(simulator, solution.controls, solution.roll, problem.target[0])
    start = simulator.start(solution.roll)
    end, tips = simulator.replay(start, rows)
    error = math.dist(end.tip[: Z + 1].tolist(), problem.target)
    intrusion = 0.0
    if zones:
        least = simulator.rollout(start, rows[None], outputs="clearance", limits=False).clearance.min()
        intrusion = max(0.0, zones.margin - float(least))
    return Sketch(np.vstack([start.tip, tips]), end.nodes, solution.roll, error, intrusion)


def _choose_better(first: Plan, second: Plan) -> Plan:
    """Return the plan of less cost as carried out, the first of equals, with the history of both searches."""
    later = tuple({**entry, "best": min(entry["best"], first.cost)} for entry in second.history)
    history = (*first.history, *later)
    best = min(first, second, key=_cost_as_carried_out)
    return replace(best, history=history, iterations=len(history))


def _cost_as_carried_out(plan: Plan) -> float:
    """Return the cost with the miss of the plan's end.

    A search measures the miss of a tip that ends before the target on its tangent line.
    """
    return plan.cost - plan.terms["miss"] + float(charge_miss(np.asarray(plan.error_mm)))


def bevel_reach(scenario: Scenario, depth: float, threads: int | None = None) -> tuple[float, float]:
    """Return the least and greatest y (mm) at a depth (mm) that the bevel alone reaches, at the axis's z."""
    simulator, axis = Simulator(scenario, threads), scenario.entry.lateral(depth)
    problem = make_problem(scenario, (depth, axis.real, axis.imag), "steering")
    least, greatest = reach(make_rollout(simulator, ()), problem)
    return axis.real + least, axis.real + greatest


def _search(
    simulator: Simulator,
    problem: PlanProblem,
    rng: np.random.Generator,
    progress: OnIteration,
    most_rolls: int = MOST_ROLLS,
) -> Solution:
    """Return the best primitives, or the best rolls where only the bevel is free."""
    plan, rollout = simulator.scenario.plan, make_rollout(simulator, problem.terms)
    if problem.bevel_alone:
        share = 1 if problem.entry_coordinates or problem.narrow else _SHARE_OF_A_SEARCH
        search = search_settings(plan, max(_LEAST_SAMPLES, plan.samples // share))
        return search_rolls(rollout, problem, search, rng, progress, most_rolls)
    return search_primitives(rollout, problem, search_settings(plan, plan.samples), rng, progress)
