"""Plan an insertion: the cross-entropy method on rollouts of the simulator (paper section III-A)."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flexneedle.arguments import check_point, check_whole
from flexneedle.costs.table import Trajectories
from flexneedle.costs.terms import PLAN
from flexneedle.errors import InputError
from flexneedle.planning.cross_entropy import Search, elite_count
from flexneedle.planning.horizon import OnIteration, count_iterations
from flexneedle.planning.insertion import LATERAL, PlanProblem, Solution, search_primitives, widen_search
from flexneedle.planning.steering import MOST_ROLLS, radius, reach, search_rolls
from flexneedle.results import Plan
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario, check_target
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import Limits, controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import (
    DB_PSI,
    DB_THETA,
    DB_X,
    DB_Y,
    DB_Z,
    DG_Y,
    Control,
    Floats,
    Laterals,
    Point,
    X,
    Z,
    across,
)

_TARGET = "depth and lateral offsets in mm"
STRATEGIES = ("manipulation", "steering")
_DEPTH_TOLERANCE_MM = 1e-6
_ACROSS = 0.1  # share of a standard deviation across the direction of the target
_SHARE_SIGMA = 0.1  # of the logarithm of a primitive's share of the travel
# plan.samples over this for each number of rolls and side, where only depths of rolls are searched
_SHARE_OF_A_SEARCH = 4
_LEAST_SAMPLES = 8
_ENOUGH_ROLLS = 1  # to reach a target, though not at the least cost
_AT_LIMIT = 0.999  # share of a limit that counts as reached
_REACHED_MM = 0.05  # the hull of what a bevel with a range of angles reaches is known to about this


def plan(
    scenario: str | Path | Scenario,
    target: Sequence[float] | None = None,
    strategy: str = "manipulation",
    seed: int = 0,
    progress: OnIteration | None = None,
    *,
    threads: int | None = None,
) -> Plan:
    """Plan an insertion to a target, the best found by cross-entropy. Same seed, same plan.

    A plan that misses its target although guide or base are free is searched again with wider samples, and the better
    of the two is returned.

    Args:
        scenario: A scenario, its name or its path, as for `load_scenario`.
        target: (x, y) or (x, y, z) in mm (default: the scenario's).
        strategy: "manipulation" moves guide and bevel; "steering" moves only the bevel (paper section III-A, but on the
            needle itself, not on a softer one).
        seed: Seed of the search.
        progress: Called with a dict after each iteration, which has the samples of the search as
            `planning.horizon.Samples`.
        threads: Threads of rollouts (default: all cores); changes no result.

    Raises:
        ScenarioError: The scenario excludes the target.
        InputError: Another argument cannot be used.
    """
    scenario, seed = load_scenario(scenario), check_whole("seed", seed, 0)
    if strategy not in STRATEGIES:
        raise InputError(f"strategy = {strategy!r}: must be one of {', '.join(STRATEGIES)}")
    goal = scenario.target.position if target is None else check_point("target", target, _TARGET)
    check_target(scenario, *goal)
    begun, rng = time.perf_counter(), np.random.default_rng(seed)
    simulator = Simulator(scenario, threads)
    problem = _make_problem(scenario, goal, strategy)
    found = _carry_out(simulator, problem, strategy, seed, _search(simulator, problem, rng, progress))
    if not found.reached and not _is_bevel_alone(problem):
        # A search that begins with small lateral steps can lose its spread before it gets to a far target.
        usual = found.iterations + scenario.plan.iterations
        after = count_iterations(progress, found.iterations, usual, found.cost)
        again = _search(simulator, widen_search(problem), rng, after)
        found = _choose_better(found, _carry_out(simulator, problem, strategy, seed, again))
    return replace(found, seconds=time.perf_counter() - begun)


@dataclass(frozen=True, eq=False)
class Sketch:
    """Result of one search, carried out without stops.

    Attributes:
        tips: Poses of the tip (m + 1, 5).
        needle: Nodes of the needle at the end (n, 5).
        roll: Its roll at the start (rad).
        error_mm: Distance from its tip to the target.
    """

    tips: Floats
    needle: Floats
    roll: float
    error_mm: float

    @property
    def reached(self) -> bool:
        """Whether the sketch ends within 1 mm of the target."""
        return self.error_mm <= 1.0


def sketch(
    scenario: Scenario,
    strategy: str = "manipulation",
    seed: int = 0,
    progress: OnIteration | None = None,
    *,
    threads: int | None = None,
) -> Sketch:
    """Search once for an insertion to the scenario's target, as `plan` does, for a quick preview.

    A target that is missed is not searched again, and neither the states between nor what limits the plan are found.
    The bevel alone gets one roll at most, which reaches whatever several reach.
    """
    simulator, goal = Simulator(scenario, threads), scenario.target.position
    problem = _make_problem(scenario, goal, strategy)
    found = _search(simulator, problem, np.random.default_rng(seed), progress, _ENOUGH_ROLLS)
    simulator, _ = _fix_entry(simulator, problem, found, strategy)
    rows = _end_at_depth(simulator, found.controls, found.roll, goal[0])
    start = simulator.start(found.roll)
    end, tips = simulator.replay(start, rows)
    error = math.dist(end.tip[: Z + 1].tolist(), goal)
    return Sketch(np.vstack([start.tip, tips]), end.nodes, found.roll, error)


def _choose_better(first: Plan, second: Plan) -> Plan:
    """Return the plan of less cost, the first if both cost the same, with the history of both searches."""
    later = tuple({**entry, "best": min(entry["best"], first.cost)} for entry in second.history)
    history = (*first.history, *later)
    best = second if second.cost < first.cost else first
    return replace(best, history=history, iterations=len(history))


def _carry_out(
    simulator: Simulator, problem: PlanProblem, strategy: str, seed: int, solution: Solution
) -> Plan:
    """Return the plan that ends at the target's depth, with its entry in the scenario if that was free."""
    simulator, problem = _fix_entry(simulator, problem, solution, strategy)
    goal = problem.target
    rows = _end_at_depth(simulator, solution.controls, solution.roll, goal[0])
    states = [simulator.start(solution.roll)]
    for row in rows:
        states.append(simulator.step(states[-1], Control.of(row.tolist())))
    return Plan(
        strategy=strategy,
        target=goal,
        seed=seed,
        roll=solution.roll,
        controls=rows,
        tips=np.array([state.tip for state in states]),
        strain_energy=np.array([state.strain_energy for state in states]),
        guide=np.array([state.guide for state in states]),
        shapes=np.array([state.nodes for state in states]),
        cost=solution.cost,
        terms=solution.terms,
        iterations=solution.search_state.iterations,
        converged=solution.search_state.converged,
        history=solution.search_state.history,
        limit=_binding_limit(simulator, problem, rows, states),
        scenario=simulator.scenario,
    )


def _fix_entry(
    simulator: Simulator, problem: PlanProblem, solution: Solution, strategy: str
) -> tuple[Simulator, PlanProblem]:
    """Return simulator and problem with the entry that was found, if it was free."""
    if not simulator.scenario.entry.free:
        return simulator, problem
    scenario = _with_entry(simulator.scenario, *solution.entry)
    return Simulator(scenario, simulator.threads), _make_problem(scenario, problem.target, strategy)


def bevel_reach(scenario: Scenario, depth: float, threads: int | None = None) -> tuple[float, float]:
    """Return the least and greatest y (mm) at a depth (mm) that the bevel alone reaches, at the axis's z."""
    simulator, axis = Simulator(scenario, threads), scenario.entry.lateral(depth)
    problem = _make_problem(scenario, (depth, axis.real, axis.imag), "steering")
    least, greatest = reach(_make_rollout(simulator), problem)
    return axis.real + least, axis.real + greatest


def _search(
    simulator: Simulator,
    problem: PlanProblem,
    rng: np.random.Generator,
    progress: OnIteration | None,
    most_rolls: int = MOST_ROLLS,
) -> Solution:
    """Return the best primitives, or the best rolls where only the bevel is free."""
    plan, rollout = simulator.scenario.plan, _make_rollout(simulator)
    if _is_bevel_alone(problem):
        share = 1 if problem.entry_coordinates or problem.narrow else _SHARE_OF_A_SEARCH
        search = _search_settings(plan, max(_LEAST_SAMPLES, plan.samples // share))
        return search_rolls(rollout, problem, search, rng, progress, most_rolls)
    return search_primitives(rollout, problem, _search_settings(plan, plan.samples), rng, progress)


def _make_rollout(simulator: Simulator) -> Callable[[Floats], Trajectories]:
    start, free = simulator.start(), simulator.scenario.entry.free

    def rollout(controls: Floats) -> Trajectories:
        # Base and guide are mounted at a free entry by the first control, which no limit applies to.
        axes = _mounted_axes(simulator.scenario, controls[:, 0]) if free else None
        result = simulator.rollout(start, controls, deflection=True, limits=not free, axes=axes)
        return Trajectories(controls, *result[:4])

    return rollout


def _mounted_axes(scenario: Scenario, first: Floats) -> Laterals:
    """Return the axes (N, 2) of needles that the controls (N, 9) mount: y + iz (mm) at x = 0, and slope (rad)."""
    slope = scenario.entry.slope + first[:, DB_THETA] + 1j * first[:, DB_PSI]
    base = scenario.entry.lateral(scenario.start_base_x) + first[:, DB_Y] + 1j * first[:, DB_Z]
    return np.stack([base - slope * scenario.start_base_x, slope], axis=1)


def _search_settings(plan: PlanSettings, samples: int) -> Search:
    return Search(
        samples=samples,
        elite=elite_count(samples, plan.elite_fraction),
        iterations=max(plan.iterations, plan.max_iterations),
        smoothing=plan.smoothing,
        tolerance=plan.tolerance,
        usual=plan.iterations,
    )


def _is_bevel_alone(problem: PlanProblem) -> bool:
    return not problem.sigma[LATERAL : problem.bevel.start].any()


def _make_problem(scenario: Scenario, goal: Point, strategy: str) -> PlanProblem:
    setup, plan = scenario.setup, scenario.plan
    limits = Limits.of(scenario)
    axes = setup.axes
    free = strategy != "steering"
    guide = plan.guide_sigma_mm if free and setup.has_guide else 0.0
    sizes = (plan.base_sigma_mm if free else 0.0, plan.base_turn_sigma if free else 0.0, guide)
    axis = scenario.entry.lateral(goal[0])
    toward = complex(*goal[1:]) - axis
    point, slope = scenario.entry.nearest(toward, goal[0], 0.0)
    turned = toward != 0.0 and setup.moved_guide_axes == 2 and not setup.half_turns
    shares = [1.0, _ACROSS if turned else 1.0][:axes]
    lateral = np.outer(sizes, shares).ravel()
    if setup.moved_guide_axes < axes:
        lateral[-1] = 0.0
    sigma = np.array([plan.advance_sigma_mm, *lateral, *shares, _SHARE_SIGMA])
    return PlanProblem(
        target=goal,
        travel=setup.tip_to_skin_mm + goal[0],
        air=setup.tip_to_skin_mm,
        primitives=plan.primitives,
        step=limits.step,
        reach=limits.travel[:, 1],
        sigma=sigma,
        settings=plan,
        axes=axes,
        half_turns=setup.half_turns,
        rotation=setup.max_rotation,
        frame=toward / abs(toward) if turned else 1.0,
        entry=(scenario.entry.free_radius_mm, 1e-3 * scenario.entry.free_slope_mrad),
        slope=scenario.entry.slope,
        steepest=1e-3 * STEEPEST_MRAD,
        lateral_travel=setup.max_lateral,
        home=scenario.entry.nearest(toward, goal[0], setup.max_lateral),
        left=toward - point - slope * goal[0],
        axis=axis,
        mounts=(scenario.start_base_x, setup.guide_x or 0.0),
    )


def _with_entry(scenario: Scenario, point: complex, slope: complex) -> Scenario:
    """Return the scenario with the entry fixed, changed by `point` (mm) and `slope` (rad)."""
    entry = scenario.entry

    def steep(now: float, change: float) -> float:
        """Return a slope (mrad) that the search keeps within its limit, up to rounding."""
        return max(-STEEPEST_MRAD, min(STEEPEST_MRAD, now + 1e3 * change))

    values = {
        "lateral_mm": entry.lateral_mm + point.real,
        "lateral_z_mm": entry.lateral_z_mm + point.imag,
        "slope_mrad": steep(entry.slope_mrad, slope.real),
        "slope_z_mrad": steep(entry.slope_z_mrad, slope.imag),
        "free_radius_mm": 0.0,
        "free_slope_mrad": 0.0,
    }
    return scenario.with_values({f"entry.{key}": value for key, value in values.items()})


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


def _binding_limit(simulator: Simulator, problem: PlanProblem, rows: Floats, states: list[State]) -> str:
    """Name the key of the limit that keeps the plan from its target; empty if it reaches it.

    A target out of the bevel's reach is named even if the plan ends within 1 mm of it. `setup.max_rotation_deg` is
    named where a driver without that limit would reach the target.
    """
    scenario, end = simulator.scenario, states[-1].tip
    setup, near = scenario.setup, math.dist(end[:3], problem.target) <= 1.0
    if rows[:, DB_X].sum() > _AT_LIMIT * setup.stroke_mm and end[X] < problem.target[0] - 0.5:
        return f"setup.stroke_mm = {setup.stroke_mm:g}"
    missed = not problem.narrow or math.dist(end[:3], problem.target) > _REACHED_MM
    if _is_bevel_alone(problem) and missed and (beyond := _limit_of_bevel(simulator, problem)):
        return beyond
    if near:
        return ""
    if (
        setup.axes == 2
        and abs(end[Z] - problem.target[2]) > 1.0
        and (key := _limit_along_z(simulator, problem))
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
    weight = PLAN.weights(scenario.plan)["accuracy"]
    return f"plan.{PLAN.key('accuracy')} = {weight:g} (other costs outweigh the miss)"


def _limit_of_bevel(simulator: Simulator, problem: PlanProblem) -> str:
    """Name the key that keeps the bevel alone from the target; empty if nothing does."""
    scenario, rollout = simulator.scenario, _make_rollout(simulator)
    least, greatest = reach(rollout, problem)
    if least <= problem.lateral <= greatest:
        return ""
    from_axis = f" from the needle's axis, the target is at {problem.lateral:.2f} mm" if problem.axis else ""
    anywhere = " in any direction" if problem.axes == 2 and not problem.half_turns else ""
    why = f"the bevel alone reaches {least:.2f} to {greatest:.2f} mm lateral{anywhere}{from_axis}"
    if problem.narrow:
        size, most = radius(rollout, problem), scenario.setup.max_rotation_deg
        if problem.lateral <= size:
            there = f"{least:.2f} to {greatest:.2f} mm" if least <= greatest else "nothing"
            line = f"on the line from the needle's axis to the target at {problem.lateral:.2f} mm"
            return f"setup.max_rotation_deg = {most:g} ({line} the bevel alone reaches {there})"
        why = f"the bevel alone reaches at most {size:.2f} mm lateral{from_axis}"
    return f"needle.bevel.offset_mm = {scenario.needle.bevel.offset_mm:g} ({why})"


def _limit_along_z(simulator: Simulator, problem: PlanProblem) -> str:
    """Name the key that keeps the needle from the target's z; empty if guide, base or bevel reach it."""
    setup = simulator.scenario.setup
    if problem.sigma[LATERAL + 1 : problem.bevel.start : 2].any():
        return ""
    if problem.half_turns:
        if _is_bevel_alone(problem):
            return f"{setup.half_turns_by} (nothing steers along z)"
        return f"setup.guide_axes = 1 (nothing else steers along z with {setup.half_turns_by})"
    size = radius(_make_rollout(simulator), problem)
    most = size * math.sin(min(problem.rotation, 0.5 * math.pi))
    if _is_bevel_alone(problem) or abs(problem.across.imag) <= most:
        return ""
    why = f"along z only the bevel steers, by up to {most:.2f} mm"
    limited = problem.narrow and abs(problem.across.imag) <= size
    key = f"max_rotation_deg = {setup.max_rotation_deg:g}" if limited else "guide_axes = 1"
    return f"setup.{key} ({why})"
