"""Insertion plans with the bevel as the only input: its side at the start, and the depths of a few rolls.

The end of the tip is a continuous function of the depth of a roll. A roll at the skin is an insertion with the other
side, a roll at the target one without a roll; so by the intermediate value theorem one roll reaches every target
between the ends of the two insertions without any, and no sequence of rolls is needed to find it. More rolls can only
lower the cost.
"""

import cmath
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.horizon import Found, Variables, best
from flexneedle.planning.insertion import PlanProblem, Solution, cost_terms, entry_bounds, mounted, solution
from flexneedle.planning.terms import RolloutFunction, Term, Trajectories, past
from flexneedle.simulator.control import controls
from flexneedle.types import DB_THETA, DB_Y, ROLL, Floats, X, across

MOST_ROLLS = 4
_INNER = 0.5  # of the reach
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
    charged = (*cost_terms(problem), *_margin(rollout, problem))
    for rolls in range(MOST_ROLLS + 1):
        before = min((one.cost for _, one in found), default=np.inf)
        for side in (1.0, -1.0):
            alone = rolls == 0 and problem.entry_coordinates == 0  # all samples are one
            count = search.elite if alone else search.samples
            first = np.sort(rng.uniform(size=(count, rolls)), axis=1)
            variables = _variables(problem, side, np.arange(1, rolls + 1) / (rolls + 1), _WIDE)
            first = np.concatenate([first, _entries(problem, count, rng)], axis=1)
            shown = _counted(progress, search, [one for _, one in found])
            found.append(
                (
                    side,
                    best(variables, rollout, charged, search, rng, first=first, progress=shown),
                )
            )
        if rolls > 0 and min(one.cost for _, one in found) == before:
            break
    side, one = min(found, key=lambda pair: pair[1].cost)
    short = max(0.0, problem.target[0] - float(one.trajectories.tips[0, -1, X]))
    longer = replace(problem, travel=min(problem.travel + short, float(problem.reach[0])))
    shown = _counted(progress, search, [one for _, one in found])
    rolls = one.z.size - problem.entry_coordinates
    variables = _variables(longer, side, np.sort(one.z[:rolls]), _NARROW, one.z[rolls:])
    return solution(longer, best(variables, rollout, charged, search, rng, progress=shown))


def _margin(rollout: RolloutFunction, problem: PlanProblem) -> tuple[Term, ...]:
    """With a free entry, the distance (mm) of the target from the inner half of the bevel's reach, as a miss.

    At the end of its reach the bevel could correct no error to one side.
    """
    if not problem.entry_coordinates:
        return ()
    least, greatest = reach(rollout, problem)
    half = _INNER * 0.5 * (greatest - least)

    def beyond(trajectories: Trajectories) -> Floats:
        first, base = trajectories.controls[:, 0], problem.mounts[0]
        slope = across(first, DB_THETA)
        point = across(first, DB_Y) - slope * base
        off = complex(*problem.target[1:]) - problem.axis - point - slope * problem.target[0]
        return np.maximum(np.abs(off) - half, 0.0)

    return (Term("margin", problem.accuracy_weight, beyond),)


def _variables(
    problem: PlanProblem, side: float, mean: Floats, sigma: float, entry: Floats | float = 0.0
) -> Variables:
    """The depths of the rolls, as shares of the target's, and the coordinates of the entry, of mean `entry`."""
    ones, bounds = np.ones(mean.size), entry_bounds(problem)
    return Variables(
        np.append(0.0 * ones, -bounds),
        np.append(ones, bounds),
        np.append(mean, entry + 0.0 * bounds),
        sigma * np.append(ones, bounds),
        lambda z: mounted(problem, rolled(problem, z[:, : mean.size], side), z[:, mean.size :]),
    )


def _entries(problem: PlanProblem, count: int, rng: np.random.Generator) -> Floats:
    """Coordinates (count, e) of the entry, the present one first."""
    bounds = entry_bounds(problem)
    entries = rng.uniform(-1.0, 1.0, (count, bounds.size)) * bounds
    entries[:1] = 0.0
    return entries


def rolled(problem: PlanProblem, z: Floats, side: float) -> Floats:
    """Controls (N, m, 9) of an insertion that starts with the bevel to `side` of the problem's direction and flips it
    at shares z (N, k) of the target's depth, in any order.

    Its steps are even except where a roll divides one: so no roll changes the other steps, whose length has an effect
    near the skin, and the end of the tip is continuous in z.
    """
    n = len(z)
    even = np.linspace(0.0, problem.travel, int(np.ceil(problem.travel / problem.step[0] - 1e-9)) + 1)
    rolls = problem.air + z * problem.target[0]
    starts = np.concatenate([np.tile(even[:-1], (n, 1)), rolls], axis=1)
    order = np.argsort(starts, axis=1, kind="stable")
    edges = np.take_along_axis(starts, order, axis=1)
    rows = controls(n, edges.shape[1], db_x=np.diff(edges, axis=1, append=problem.travel))
    rows[:, :, ROLL] = np.where(order < even.size - 1, 0.0, np.pi)
    rows[:, 0, ROLL] = cmath.phase(side * problem.direction)
    return rows


def reach(rollout: RolloutFunction, problem: PlanProblem) -> tuple[float, float]:
    """Least and greatest lateral position (mm) at the target's depth that the bevel alone can reach.

    In the problem's direction.
    """
    ahead = (problem.target[0], 0.0, 0.0)
    ends = [past(rollout(rolled(problem, np.empty((1, 0)), side)), ahead)[0] for side in (-1.0, 1.0)]
    along = [float((end * problem.direction.conjugate()).real) for end in ends]
    return min(along), max(along)


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
