"""Plans from the controls that a search has found: with the states on the way, clearance, loads and limits."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexneedle.costs.weighted_sum import RolloutFunction, Term, Trajectories, outputs_of
from flexneedle.planning.entry import mounted_axes, with_entry
from flexneedle.planning.limit import find_largest_load, find_limit
from flexneedle.planning.primitives import Solution
from flexneedle.planning.problem import PlanProblem, make_problem
from flexneedle.planning.second_opinion import exact_clearances
from flexneedle.results import Plan, format_mm
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.simulator.zones import ZoneMap
from flexneedle.types import DB_X, DG_Y, DG_Z, Floats, X

_DEPTH_TOLERANCE_MM = 1e-6
_ROUNDING_MM = 1e-3  # of an intrusion
_OUTPUTS = ("energy", "stretch", "strain", "loads", "shapes", "clearance")


def carry_out(
    simulator: Simulator, problem: PlanProblem, zones: ZoneMap, strategy: str, seed: int, solution: Solution
) -> Plan:
    """Return the plan that ends at the target's depth, with its entry in the scenario if that was free."""
    simulator, problem = fix_entry(simulator, problem, solution, strategy)
    goal = problem.target
    rows = end_at_depth(simulator, solution.controls, solution.roll, goal[0])
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
            simulator.scenario, problem, make_rollout(simulator, ()), rows, end, solution.terms, load
        ),
        refusal=load.text if load.share > 1.0 else "",
        least_stretch=np.append(start.least_stretch, steps.stretch[0]),
        scenario=simulator.scenario,
    )
    return _measure_clearance(plan, simulator, zones, start, steps.clearance[0])


def _measure_clearance(
    plan: Plan, simulator: Simulator, zones: ZoneMap, start: State, searched: Floats
) -> Plan:
    """Return a plan with its clearance by the simulator and by the exact rod, and with a refusal if it enters a margin.

    searched (m,): clearance after each step, as a search compares it.
    """
    scenario, rows = simulator.scenario, plan.controls
    if not zones:
        return replace(plan, clearance=np.full(len(plan.tips), np.inf))
    least = simulator.with_zones(zones.exact).rollout(start, rows[None], outputs="clearance").clearance[0]
    inside = zones.margin - float(searched.min())
    deepest = zones.clearances(simulator.replay(start, rows[: searched.argmin() + 1])[0].body)
    if inside <= 0.0:  # the exact rod takes longer
        exact = exact_clearances(scenario, zones, rows, plan.roll)
        least, deepest = np.minimum(least, exact.min(axis=0)), exact
        inside = float((zones.margins[:, None] - exact).max())
    clearance = np.append(np.inf, np.where(plan.tips[1:, X] > 0.0, least, np.inf))
    plan = replace(plan, clearance=clearance, intrusion_mm=inside if inside > _ROUNDING_MM else 0.0)
    if not plan.intrusion_mm or plan.refusal:
        return plan
    least = deepest.min(axis=1, initial=np.inf)
    worst = int((least - zones.margins).argmin())
    distance = f"{format_mm(abs(float(least[worst])))} {'from' if least[worst] >= 0.0 else 'inside'}"
    refusal = f"{distance} zone {zones.names[worst]} (margin {zones.margins[worst]:g} mm)"
    return replace(plan, refusal=refusal, limit=f"zone {zones.names[worst]}")


def fix_entry(
    simulator: Simulator, problem: PlanProblem, solution: Solution, strategy: str
) -> tuple[Simulator, PlanProblem]:
    """Return simulator and problem with the entry that was found, if it was free."""
    if not simulator.scenario.entry.free:
        return simulator, problem
    scenario = with_entry(simulator.scenario, *solution.entry)
    fixed = Simulator(scenario, simulator.threads, zones=simulator.zones)  # whose zones are read already
    return fixed, make_problem(scenario, problem.target, strategy)


def make_rollout(
    simulator: Simulator, terms: Sequence[Term], at_end: tuple[str, ...] = ()
) -> RolloutFunction:
    """Return the rollout from the simulator's start, with the outputs for terms and others at the end."""
    start, free, wanted = simulator.start(), simulator.scenario.entry.free, outputs_of(terms)
    last = (*wanted.at_end, *at_end)

    def rollout(controls: Floats) -> Trajectories:
        # Base and guide are mounted at a free entry by the first control, which no limit applies to.
        axes = mounted_axes(simulator.scenario, controls[:, 0]) if free else None
        return simulator.rollout(
            start, controls, outputs=wanted.outputs, at_end=last, limits=not free, axes=axes
        )

    return rollout


def end_at_depth(simulator: Simulator, rows: Floats, roll: float, depth: float) -> Floats:
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
