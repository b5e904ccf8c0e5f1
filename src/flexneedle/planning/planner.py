"""Plan an insertion: the cross-entropy method on rollouts of the simulator (paper section III-A)."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flexneedle.arguments import check_point, check_whole
from flexneedle.costs.terms import charge_miss
from flexneedle.costs.weighted_sum import RolloutFunction, Term, Trajectories, outputs_of
from flexneedle.errors import InputError
from flexneedle.planning import STRATEGIES
from flexneedle.planning.cross_entropy import Search, elite_count
from flexneedle.planning.detours import refine, search_detours
from flexneedle.planning.entry import mounted_axes, with_entry
from flexneedle.planning.events import Iterated, Listener, send_event
from flexneedle.planning.freedom import find_freedom
from flexneedle.planning.horizon import OnIteration, count_iterations
from flexneedle.planning.limit import find_largest_load, find_limit
from flexneedle.planning.primitives import Solution, fix_guide, search_primitives, widen_search
from flexneedle.planning.problem import PlanProblem, make_problem
from flexneedle.planning.second_opinion import exact_clearances
from flexneedle.planning.steering import MOST_ROLLS, reach, search_rolls
from flexneedle.planning.ways import Room
from flexneedle.results import TARGET_RADIUS_MM, Plan, format_mm
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario, check_target
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import controls
from flexneedle.simulator.excess import LoadLimits
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import DB_X, DG_Y, DG_Z, Floats, Point, X, Z

_TARGET = "depth and lateral offsets in mm"
_DEPTH_TOLERANCE_MM = 1e-6
_PRECISE_MM = 0.1  # miss of a plan above which other searches are made
# plan.samples over this for each number of rolls and side, where only depths of rolls are searched
_SHARE_OF_A_SEARCH = 4
_LEAST_SAMPLES = 8
_RESERVE_MM = 0.1  # of clearance in a search, beyond the margin
_REPEATS = 2  # of a search with more clearance, where the exact rod enters a margin
_MENDED_MM = 1.5  # largest intrusion for which it is repeated
_CLEAR_MM = 5.0  # cost of the margins of a plan that nearly keeps them by the simulator
_OVERLOAD_MM = 10.0  # rank of a load beyond a limit of the guard
_OUTPUTS = ("energy", "stretch", "strain", "loads", "shapes", "clearance")
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
    problem = make_problem(scenario, goal, strategy)
    found = _carry_out(simulator, problem, strategy, seed, _search(simulator, problem, rng, progress))
    for change in _other_searches(problem):
        if found.error_mm <= _PRECISE_MM:
            break
        usual = found.iterations + scenario.plan.iterations
        after = count_iterations(progress, found.iterations, usual, found.cost)
        again = _search(simulator, change(problem), rng, after)
        found = _choose_better(found, _carry_out(simulator, problem, strategy, seed, again))
    zones = zones_of(scenario)
    if not found.intrusion_mm:
        return found
    return _avoid(simulator, problem, zones, found, rng, progress)


def _avoid(
    simulator: Simulator,
    problem: PlanProblem,
    zones: ZoneMap,
    found: Plan,
    rng: np.random.Generator,
    progress: OnIteration,
) -> Plan:
    """Return the first plan that keeps all margins and reaches the target; of others, the best with what it lacks."""
    plan, needle = simulator.scenario.plan, simulator.scenario.needle
    around = replace(problem, clear=zones.margin + _RESERVE_MM, length=needle.length_mm)
    shapes_of, room = _make_rollout(simulator, (), at_end=("shapes",)), make_room(simulator.scenario, zones)
    rollout, search = _make_rollout(simulator, around.terms), _search_settings(plan, plan.samples)
    after = count_iterations(progress, found.iterations, found.iterations + plan.iterations, np.inf)
    solutions = search_detours(rollout, shapes_of, around, room, search, rng, after)
    best, history = found, found.history
    for solution in solutions:
        for repeat in range(1 + _REPEATS):
            new = _carry_out(simulator, problem, found.strategy, found.seed, solution)
            history = (*history, *new.history)
            best = min(best, new, key=_rank)
            near = 0.0 < new.intrusion_mm <= _MENDED_MM and solution.terms["zones"] <= _CLEAR_MM
            if repeat == _REPEATS or not near:
                break
            farther = replace(around, clear=zones.margin + _RESERVE_MM + (1 + repeat) * new.intrusion_mm)
            solution = refine(rollout, farther, solution, search, rng, progress)
        if best.hit and best.error_mm <= _PRECISE_MM:
            break
    best = replace(best, history=history, iterations=len(history))
    if best.hit:
        return best
    help_by = find_freedom(shapes_of, around, room)
    margin = f"zones.margin_mm = {zones.margin:g}"
    return replace(best, limit=f"{margin}; {help_by} may suffice" if help_by else margin)


def _rank(plan: Plan) -> tuple[float, float]:
    """Return the order of plans: by the intrusion into margins (mm) and the miss beyond what is precise, then cost."""
    off = plan.intrusion_mm + max(0.0, plan.error_mm - _PRECISE_MM)
    return off + _OVERLOAD_MM * plan.limit.startswith("guard."), plan.cost


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

    @property
    def reached(self) -> bool:
        """Whether the sketch ends within 1 mm of the target."""
        return self.error_mm <= TARGET_RADIUS_MM

    @property
    def summary(self) -> str:
        """One line: distance from its tip to the target. A sketch that misses leaves open whether a plan reaches it."""
        ends = f"ends {format_mm(self.error_mm)} from the target"
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
    problem = make_problem(scenario, scenario.target.position, strategy)
    progress = _report_to(listeners, strategy)
    solution = _search(simulator, problem, rng, progress, _ENOUGH_ROLLS)
    found = _make_sketch(simulator, problem, strategy, solution)
    for change in _other_searches(problem):
        if found.reached:
            break
        solution = _search(simulator, change(problem), rng, progress, _ENOUGH_ROLLS)
        again = _make_sketch(simulator, problem, strategy, solution)
        found = min(found, again, key=lambda each: each.error_mm)
    return found


def _make_sketch(simulator: Simulator, problem: PlanProblem, strategy: str, solution: Solution) -> Sketch:
    simulator, _ = _fix_entry(simulator, problem, solution, strategy)
    rows = _end_at_depth(simulator, solution.controls, solution.roll, problem.target[0])
    start = simulator.start(solution.roll)
    end, tips = simulator.replay(start, rows)
    error = math.dist(end.tip[: Z + 1].tolist(), problem.target)
    return Sketch(np.vstack([start.tip, tips]), end.nodes, solution.roll, error)


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


def _carry_out(
    simulator: Simulator, problem: PlanProblem, strategy: str, seed: int, solution: Solution
) -> Plan:
    """Return the plan that ends at the target's depth, with its entry in the scenario if that was free."""
    simulator, problem = _fix_entry(simulator, problem, solution, strategy)
    goal = problem.target
    rows = _end_at_depth(simulator, solution.controls, solution.roll, goal[0])
    start = simulator.start(solution.roll)
    steps = simulator.rollout(start, rows[None], outputs=_OUTPUTS)
    load, end = find_largest_load(problem.loads, simulator, start, steps), steps.tips[0, -1]
    plan = Plan(
        strategy=strategy,
        target=goal,
        seed=seed,
        roll=solution.roll,
        controls=rows,
        tips=np.vstack([start.tip, steps.tips[0]]),
        strain_energy=np.append(start.strain_energy, steps.energy[0]),
        guide=np.cumsum([start.guide, *rows[:, DG_Y : DG_Z + 1]], axis=0),
        shapes=np.concatenate([start.nodes[None], steps.shapes[0]]),
        cost=solution.cost,
        terms=solution.terms,
        iterations=solution.search_state.iterations,
        converged=solution.search_state.converged,
        history=solution.search_state.history,
        limit=find_limit(
            simulator.scenario, problem, _make_rollout(simulator, ()), rows, end, solution.terms, load
        ),
        refusal=load.text if load.share > 1.0 else "",
        least_stretch=np.append(start.least_stretch, steps.stretch[0]),
        scenario=simulator.scenario,
    )
    return _measure_clearance(plan, simulator, start, steps.clearance[0])


def _measure_clearance(plan: Plan, simulator: Simulator, start: State, searched: Floats) -> Plan:
    """Return a plan with its clearance by the simulator and by the exact rod, and with a refusal if it enters a margin.

    searched (m,): clearance after each step, as a search compares it.
    """
    scenario, rows = simulator.scenario, plan.controls
    if not (zones := zones_of(scenario)):
        return replace(plan, clearance=np.full(len(plan.tips), np.inf))
    least = simulator.with_zones(zones.exact).rollout(start, rows[None], outputs="clearance").clearance[0]
    inside = zones.margin - float(searched.min())
    deepest = zones.clearances(simulator.replay(start, rows[: searched.argmin() + 1])[0].body)
    if inside <= 0.0:  # the exact rod takes longer
        exact = exact_clearances(scenario, zones, rows, plan.roll)
        least, deepest = np.minimum(least, exact.min(axis=0)), exact
        inside = float((zones.margins[:, None] - exact).max())
    clearance = np.append(np.inf, np.where(plan.tips[1:, X] > 0.0, least, np.inf))
    plan = replace(plan, clearance=clearance, intrusion_mm=max(0.0, inside))
    if not plan.intrusion_mm or plan.refusal:
        return plan
    refusal = _describe_intrusion(zones, deepest)
    return replace(plan, refusal=refusal, limit=f"zones.margin_mm = {zones.margin:g}")


def _describe_intrusion(zones: ZoneMap, clearances: Floats) -> str:
    """Return the clearance, of some (z, n), that is deepest in its margin."""
    least = clearances.min(axis=1, initial=np.inf)
    worst = int((least - zones.margins).argmin())
    where = "from" if least[worst] >= 0.0 else "inside"
    distance, margin = format_mm(abs(float(least[worst]))), zones.margins[worst]
    return f"{distance} {where} zone {zones.names[worst]} (margin {margin:g} mm)"


def _fix_entry(
    simulator: Simulator, problem: PlanProblem, solution: Solution, strategy: str
) -> tuple[Simulator, PlanProblem]:
    """Return simulator and problem with the entry that was found, if it was free."""
    if not simulator.scenario.entry.free:
        return simulator, problem
    scenario = with_entry(simulator.scenario, *solution.entry)
    return Simulator(scenario, simulator.threads), make_problem(scenario, problem.target, strategy)


def bevel_reach(scenario: Scenario, depth: float, threads: int | None = None) -> tuple[float, float]:
    """Return the least and greatest y (mm) at a depth (mm) that the bevel alone reaches, at the axis's z."""
    simulator, axis = Simulator(scenario, threads), scenario.entry.lateral(depth)
    problem = make_problem(scenario, (depth, axis.real, axis.imag), "steering")
    least, greatest = reach(_make_rollout(simulator, ()), problem)
    return axis.real + least, axis.real + greatest


def _search(
    simulator: Simulator,
    problem: PlanProblem,
    rng: np.random.Generator,
    progress: OnIteration,
    most_rolls: int = MOST_ROLLS,
) -> Solution:
    """Return the best primitives, or the best rolls where only the bevel is free."""
    plan, rollout = simulator.scenario.plan, _make_rollout(simulator, problem.terms)
    if problem.bevel_alone:
        share = 1 if problem.entry_coordinates or problem.narrow else _SHARE_OF_A_SEARCH
        search = _search_settings(plan, max(_LEAST_SAMPLES, plan.samples // share))
        return search_rolls(rollout, problem, search, rng, progress, most_rolls)
    return search_primitives(rollout, problem, _search_settings(plan, plan.samples), rng, progress)


def make_room(scenario: Scenario, zones: ZoneMap) -> Room:
    """Return what first paths are judged by."""
    curvature = 2.0 * LoadLimits.of(scenario).strain / scenario.needle.outer_diameter
    return Room(zones.least_clearances, partial(_compression_lengths, scenario), curvature)


def _compression_lengths(scenario: Scenario, depths: Floats) -> Floats:
    """Return the compression lengths (p,), mm, of the layers at depths (p,)."""
    layer = np.searchsorted(scenario.layer_tops, depths, side="right") - 1
    lengths: Floats = np.array([each.compression_length_mm for each in scenario.tissue])[layer]
    return lengths


def _make_rollout(
    simulator: Simulator, terms: Sequence[Term], at_end: tuple[str, ...] = ()
) -> RolloutFunction:
    start, free, wanted = simulator.start(), simulator.scenario.entry.free, outputs_of(terms)
    last = (*wanted.at_end, *at_end)

    def rollout(controls: Floats) -> Trajectories:
        # Base and guide are mounted at a free entry by the first control, which no limit applies to.
        axes = mounted_axes(simulator.scenario, controls[:, 0]) if free else None
        return simulator.rollout(
            start, controls, outputs=wanted.outputs, at_end=last, limits=not free, axes=axes
        )

    return rollout


def _search_settings(plan: PlanSettings, samples: int) -> Search:
    return Search(
        samples=samples,
        elite=elite_count(samples, plan.elite_fraction),
        iterations=max(plan.iterations, plan.max_iterations),
        smoothing=plan.smoothing,
        tolerance=plan.tolerance_mm,
        usual=plan.iterations,
        relative=False,
    )


def _end_at_depth(simulator: Simulator, rows: Floats, roll: float, depth: float) -> Floats:
    """Shorten or add last steps until the tip ends at the target depth."""
    start, setup = simulator.start(roll), simulator.scenario.setup
    for _ in range(8):
        short = depth - float(simulator.rollout(start, rows[None]).tips[0, -1, X])
        if abs(short) < _DEPTH_TOLERANCE_MM:
            break
        last = float(rows[-1, DB_X]) + short
        stroke_left = setup.stroke_mm - float(rows[:, DB_X].sum())
        if last <= 0.0 and len(rows) > 1:
            rows = rows[:-1]
        elif last > setup.max_advance_mm and stroke_left > _DEPTH_TOLERANCE_MM:
            # The rest is no more than the shortening, so it takes a single further step.
            rows = np.concatenate([rows, controls(1, db_x=min(short, setup.max_advance_mm, stroke_left))])
        else:
            rows = rows.copy()
            rows[-1, DB_X] = min(last, setup.max_advance_mm, float(rows[-1, DB_X]) + stroke_left)
    return rows
