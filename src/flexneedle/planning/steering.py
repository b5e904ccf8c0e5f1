"""Insertion plans with the bevel as the only input: its side at the start, and the depths of a few rolls.

The end of the tip is a continuous function of the depth of a roll. A roll at the skin is an insertion with the other
side, a roll at the target one without a roll; so by the intermediate value theorem one roll reaches every target
between the ends of the two insertions without any, and no sequence of rolls is needed to find it. More rolls can only
lower the cost.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.horizon import Found, Variables, best
from flexneedle.planning.insertion import PlanProblem, Solution, cost_terms, solution
from flexneedle.planning.terms import RolloutFunction
from flexneedle.types import Floats

MOST_ROLLS = 4
_USUAL_SEARCHES = 5  # one roll and two, from either side, and the last
_WIDE, _NARROW = 0.3, 0.02  # first standard deviations of a roll's depth, as a share of the target's

OnIteration = Callable[[dict[str, Any]], None]


def steer(
    rollout: RolloutFunction,
    problem: PlanProblem,
    search: Search,
    rng: np.random.Generator,
    progress: OnIteration | None = None,
) -> Solution:
    """Search the depths of 0 to 4 rolls with either side at the start, until one more roll does not lower the cost.

    The best of all is searched once more with the travel that it needs to end at the target's depth: a bent needle
    ends short of it. `rollout` starts with bevel +1 in air; `search` is that of each number of rolls and side.
    """
    found: list[tuple[float, Found]] = []
    for rolls in range(MOST_ROLLS + 1):
        before = min((one.cost for _, one in found), default=np.inf)
        for side in (1.0, -1.0):
            count = search.samples if rolls else search.elite  # without a roll all samples are one
            first = np.sort(rng.uniform(size=(count, rolls)), axis=1)
            variables = _variables(problem, side, np.arange(1, rolls + 1) / (rolls + 1), _WIDE)
            shown = _counted(progress, search, [one for _, one in found])
            found.append(
                (
                    side,
                    best(variables, rollout, cost_terms(problem), search, rng, first=first, progress=shown),
                )
            )
        if rolls > 0 and min(one.cost for _, one in found) == before:
            break
    side, one = min(found, key=lambda pair: pair[1].cost)
    short = max(0.0, problem.target[0] - float(one.trajectories.tips[0, -1, 0]))
    longer = replace(problem, travel=min(problem.travel + short, float(problem.reach[0])))
    shown = _counted(progress, search, [one for _, one in found])
    variables = _variables(longer, side, np.sort(one.z), _NARROW)
    return solution(best(variables, rollout, cost_terms(longer), search, rng, progress=shown))


def _variables(problem: PlanProblem, side: float, mean: Floats, sigma: float) -> Variables:
    """The depths of the rolls, as shares of the target's."""
    ones = np.ones(mean.size)
    return Variables(0.0 * ones, ones, mean, sigma * ones, lambda z: rolled(problem, z, side))


def rolled(problem: PlanProblem, z: Floats, side: float) -> Floats:
    """Controls (N, m, 5) of an insertion that starts with the bevel to `side` and rolls it at shares z (N, k) of the
    target's depth, in any order.

    Its steps are even except where a roll divides one: so no roll changes the other steps, whose length has an effect
    near the skin, and the end of the tip is continuous in z.
    """
    n = len(z)
    even = np.linspace(0.0, problem.travel, int(np.ceil(problem.travel / problem.step[0] - 1e-9)) + 1)
    rolls = problem.air + z * problem.target[0]
    starts = np.concatenate([np.tile(even[:-1], (n, 1)), rolls], axis=1)
    order = np.argsort(starts, axis=1, kind="stable")
    edges = np.take_along_axis(starts, order, axis=1)
    controls = np.zeros((n, edges.shape[1], 5))
    controls[:, :, 0] = np.diff(edges, axis=1, append=problem.travel)
    controls[:, :, 4] = np.where(order < even.size - 1, -1.0, 1.0)
    controls[:, 0, 4] = -side
    return controls


def reach(rollout: RolloutFunction, problem: PlanProblem) -> tuple[float, float]:
    """Least and greatest lateral position (mm) at the target's depth that the bevel alone can reach."""
    ends = []
    for side in (-1.0, 1.0):
        end = rollout(rolled(problem, np.empty((1, 0)), side)).tips[0, -1]
        ends.append(float(end[1] + np.tan(end[2]) * (problem.target[0] - end[0])))
    return min(ends), max(ends)


def _counted(progress: OnIteration | None, search: Search, found: list[Found]) -> OnIteration | None:
    """`progress` with iterations and best cost counted through all searches."""
    if progress is None:
        return None
    before, usual = (
        sum(one.search_state.iterations for one in found),
        _USUAL_SEARCHES * (search.usual or search.iterations),
    )
    least = min((one.cost for one in found), default=np.inf)

    def show(info: dict[str, Any]) -> None:
        now = before + info["iteration"]
        progress({**info, "iteration": now, "iterations": max(now, usual), "best": min(info["best"], least)})

    return show
