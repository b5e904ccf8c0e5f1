"""Plan an insertion: the cross-entropy method on rollouts of the simulator (paper section III-A)."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.arguments import pair, whole
from flexneedle.errors import InputError
from flexneedle.planning.cross_entropy import Search, elite_count
from flexneedle.planning.insertion import BASE_Y, GUIDE, PlanProblem, Solution, optimise
from flexneedle.planning.steering import reach, steer
from flexneedle.planning.terms import Trajectories
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario, check_target
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import Control, Limits
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import Floats, Plan

_TARGET = "depth and lateral offset in mm"
STRATEGIES = ("manipulation", "steering")
_DEPTH_TOLERANCE_MM = 1e-6
_SHARE_SIGMA = 0.1  # of the logarithm of a primitive's share of the travel
_SHARE_OF_A_SEARCH = 4  # plan.samples over this for each number of rolls and side, which have few coordinates
_LEAST_SAMPLES = 8
_AT_LIMIT = 0.999  # share of a limit that counts as reached


def plan(
    scenario: str | Path | Scenario,
    target: tuple[float, float] | None = None,
    strategy: str = "manipulation",
    seed: int = 0,
    progress: Callable[[dict[str, Any]], None] | None = None,
    *,
    threads: int | None = None,
) -> Plan:
    """Plan an insertion to `target` (x, y) in mm (default: the scenario's), best found by cross-entropy.

    scenario: also by its name or path, as for `load_scenario`;
    strategy: "manipulation" moves guide and bevel; "steering" moves only the bevel (paper section III-A, but on the
    needle itself, not on a softer one). `progress` gets a dict after each iteration. `threads` is for rollouts
    (default: all cores) and changes no result. Same seed, same plan.
    Raises ScenarioError for a target that the scenario excludes, InputError for another argument that cannot be used.
    """
    scenario, seed = load_scenario(scenario), whole("seed", seed, 0)
    if strategy not in STRATEGIES:
        raise InputError(f"strategy = {strategy!r}: must be one of {', '.join(STRATEGIES)}")
    goal = scenario.target.position if target is None else pair("target", target, _TARGET)
    check_target(scenario, *goal)
    begun = time.perf_counter()
    simulator = Simulator(scenario, threads)
    problem = _problem(scenario, goal, strategy)
    solution = _search(simulator, problem, np.random.default_rng(seed), progress)
    controls = _end_at_depth(simulator, solution.controls, solution.bevel, goal[0])
    states = [simulator.start(solution.bevel)]
    for row in controls:
        states.append(simulator.step(states[-1], Control.from_row(row.tolist())))
    return Plan(
        strategy=strategy,
        target=goal,
        seed=seed,
        bevel=solution.bevel,
        controls=controls,
        tips=np.array([state.tip for state in states]),
        strain_energy=np.array([state.strain_energy for state in states]),
        guide=np.array([state.guide for state in states]),
        shapes=np.array([state.nodes for state in states]),
        cost=solution.cost,
        terms=solution.terms,
        iterations=solution.search_state.iterations,
        converged=solution.search_state.converged,
        history=solution.search_state.history,
        limit=_binding_limit(simulator, problem, controls, states),
        seconds=time.perf_counter() - begun,
        scenario=scenario,
    )


def bevel_reach(scenario: Scenario, depth: float, threads: int | None = None) -> tuple[float, float]:
    """Least and greatest lateral position (mm) at a depth (mm) that the bevel alone can reach."""
    simulator = Simulator(scenario, threads)
    return reach(_rollout(simulator), _problem(scenario, (depth, 0.0), "steering"))


def _search(
    simulator: Simulator,
    problem: PlanProblem,
    rng: np.random.Generator,
    progress: Callable[[dict[str, Any]], None] | None,
) -> Solution:
    """The best primitives, or the best rolls where only the bevel is free."""
    plan, rollout = simulator.scenario.plan, _rollout(simulator)
    if _bevel_alone(problem):
        search = _settings(plan, max(_LEAST_SAMPLES, plan.samples // _SHARE_OF_A_SEARCH))
        return steer(rollout, problem, search, rng, progress)
    return optimise(rollout, problem, _settings(plan, plan.samples), rng, progress)


def _rollout(simulator: Simulator) -> Callable[[Floats], Trajectories]:
    start = simulator.start()

    def rollout(controls: Floats) -> Trajectories:
        result, deflection = simulator.rollout_with_deflection(start, controls)
        return Trajectories(controls, *result, deflection)

    return rollout


def _settings(plan: PlanSettings, samples: int) -> Search:
    return Search(
        samples=samples,
        elite=elite_count(samples, plan.elite_fraction),
        iterations=max(plan.iterations, plan.max_iterations),
        smoothing=plan.smoothing,
        tolerance=plan.tolerance,
        usual=plan.iterations,
    )


def _bevel_alone(problem: PlanProblem) -> bool:
    return not problem.sigma[BASE_Y : GUIDE + 1].any()


def _problem(scenario: Scenario, goal: tuple[float, float], strategy: str) -> PlanProblem:
    setup, plan = scenario.setup, scenario.plan
    limits = Limits.of(scenario)
    sigma = np.array(
        [
            plan.advance_sigma_mm,
            plan.base_sigma_mm,
            plan.base_turn_sigma,
            plan.guide_sigma_mm,
            1.0,
            _SHARE_SIGMA,
        ]
    )
    if strategy == "steering":
        sigma[1:4] = 0.0
    elif not setup.has_guide:
        sigma[3] = 0.0
    return PlanProblem(
        target=goal,
        travel=setup.tip_to_skin_mm + goal[0],
        air=setup.tip_to_skin_mm,
        primitives=plan.primitives,
        step=limits.step,
        reach=limits.travel[:, 1],
        sigma=sigma,
        accuracy_weight=plan.accuracy_weight_per_mm,
        energy_weight=plan.energy_weight_per_mj,
        deflection_weight=plan.deflection_weight,
        guide_weight=plan.guide_weight,
        flip_weight=plan.flip_weight,
    )


def _end_at_depth(simulator: Simulator, controls: Floats, bevel: int, depth: float) -> Floats:
    """Shorten or add last steps until the tip ends at the target depth."""
    start, setup = simulator.start(bevel), simulator.scenario.setup
    for _ in range(8):
        short = depth - float(simulator.rollout(start, controls[None]).tips[0, -1, 0])
        if abs(short) < _DEPTH_TOLERANCE_MM:
            break
        last = float(controls[-1, 0]) + short
        stroke_left = setup.stroke_mm - float(controls[:, 0].sum())
        if last <= 0.0 and len(controls) > 1:
            controls = controls[:-1]
        elif last > setup.max_advance_mm and stroke_left > _DEPTH_TOLERANCE_MM:
            # The rest is no more than the shortening, so it takes a single further step.
            extra = np.array([[min(short, setup.max_advance_mm, stroke_left), 0.0, 0.0, 0.0, -1.0]])
            controls = np.concatenate([controls, extra])
        else:
            controls = controls.copy()
            controls[-1, 0] = min(last, setup.max_advance_mm, float(controls[-1, 0]) + stroke_left)
    return controls


def _binding_limit(simulator: Simulator, problem: PlanProblem, controls: Floats, states: list[State]) -> str:
    """Name the key of the limit that keeps the plan from its target; empty if it reaches it.

    A target out of the bevel's reach is named even if the plan ends within 1 mm of it.
    """
    scenario, end = simulator.scenario, states[-1].tip
    setup, near = scenario.setup, math.dist(end[:2], problem.target) <= 1.0
    guide = max(abs(state.guide) for state in states)
    if controls[:, 0].sum() > _AT_LIMIT * setup.stroke_mm and end[0] < problem.target[0] - 0.5:
        return f"setup.stroke_mm = {setup.stroke_mm:g}"
    if _bevel_alone(problem):
        least, greatest = reach(_rollout(simulator), problem)
        if not least <= problem.target[1] <= greatest:
            why = f"the bevel alone reaches {least:.2f} to {greatest:.2f} mm lateral"
            return f"needle.bevel.offset_mm = {scenario.needle.bevel.offset_mm:g} ({why})"
    if near:
        return ""
    if guide > _AT_LIMIT * setup.max_guide_travel_mm:
        return f"setup.max_guide_travel_mm = {setup.max_guide_travel_mm:g}"
    if np.abs(controls[:, 3]).max() > _AT_LIMIT * setup.max_guide_step_mm:
        return f"setup.max_guide_step_mm = {setup.max_guide_step_mm:g}"
    return f"plan.accuracy_weight_per_mm = {scenario.plan.accuracy_weight_per_mm:g} (other costs outweigh the miss)"
