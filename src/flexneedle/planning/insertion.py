"""Insertion plans: a few control primitives, their cost, and the search for the best (paper section III-A).

A primitive covers its share of the travel with equal steps. Its six coordinates are the longest step of base x
(mm), the step of base y (mm), base θ (rad) and guide (mm), ε, whose sign is the wanted bevel direction, and the
logarithm of its share, before normalisation. A flip is issued, counted and charged where the wanted direction
changes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.planning import terms
from flexneedle.planning.cross_entropy import Search, SearchState
from flexneedle.planning.horizon import Found, Variables, best
from flexneedle.planning.terms import RolloutFunction, Term
from flexneedle.types import Floats

ADVANCE, BASE_Y, BASE_TURN, GUIDE, BEVEL, SHARE = range(6)
COORDINATES = 6
_LEAST_ADVANCE = 0.5  # of the longest step
_BEVEL_BOUND = 3.0  # ε has standard deviation 1 at first
_SHARE_BOUND = 1.0  # no primitive is longer than e² times another
_BEVEL_CORRELATION = 0.8  # of ε of neighbouring primitives at first: few flips are likelier than many


@dataclass(frozen=True)
class PlanProblem:
    """Target, limits and weights of a plan: mm, rad.

    travel: insertion from the start to the target depth, of which `air` comes before the skin; step (4,) and reach
    (4,): largest step of base x, y, θ, guide and largest sum of steps; sigma (6,): first standard deviation of each
    coordinate, 0 if not free.
    """

    target: tuple[float, float]
    travel: float
    air: float
    primitives: int
    step: Floats
    reach: Floats
    sigma: Floats
    accuracy_weight: float  # gamma_1, 1/mm
    energy_weight: float  # gamma_2, 1/mJ
    deflection_weight: float  # Q, 1/mm²
    guide_weight: float  # R, 1/mm²
    flip_weight: float  # R of a flip


@dataclass(frozen=True)
class Solution:
    """The best controls (m, 5) and bevel at the start, its cost by term, and the search behind it."""

    controls: Floats
    bevel: int
    cost: float
    terms: dict[str, float]
    search_state: SearchState


def optimise(
    rollout: RolloutFunction,
    problem: PlanProblem,
    search: Search,
    rng: np.random.Generator,
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> Solution:
    """Search the primitives.

    `rollout` starts with bevel +1 in air; a sample that wants −1 flips in its first step, which is not charged.
    """
    found = best(_variables(problem), rollout, cost_terms(problem), search, rng, progress=progress)
    return solution(found)


def solution(found: Found) -> Solution:
    """The solution: without steps that do not advance, the bevel set before the first."""
    controls = found.trajectories.controls[0]
    facing = np.cumprod(-controls[:, 4])
    moving = controls[:, 0] > 0.0
    controls, facing = controls[moving], facing[moving]
    controls[:, 4] = np.where(np.diff(facing, prepend=facing[0]) != 0.0, 1.0, -1.0)
    return Solution(controls, int(facing[0]), found.cost, found.terms, found.search_state)


def _variables(problem: PlanProblem) -> Variables:
    n, most = problem.primitives, [*problem.step[1:], _BEVEL_BOUND, _SHARE_BOUND]
    return Variables(
        lower=np.tile([_LEAST_ADVANCE * problem.step[0], *np.negative(most)], n),
        upper=np.tile([problem.step[0], *most], n),
        mean=np.tile([problem.step[0], 0.0, 0.0, 0.0, 0.0, 0.0], n),
        sigma=np.tile(problem.sigma, n),
        controls=lambda z: schedule(problem, z)[0],
        correlation=_correlation(n),
    )


def cost_terms(problem: PlanProblem) -> tuple[Term, ...]:
    """The cost of a plan (paper eq. 9 and 10)."""
    return (
        Term("accuracy", problem.accuracy_weight, partial(terms.miss, target=problem.target)),
        Term("energy", problem.energy_weight, terms.energy_at_end),
        Term("deflection", problem.deflection_weight, terms.deflection),
        Term("guide", problem.guide_weight, terms.guide_motion),
        Term("flips", problem.flip_weight, partial(terms.flips, first=1)),
    )


def _correlation(primitives: int) -> Floats:
    """Correlation of the coordinates at first: only that of ε between primitives."""
    correlation = np.eye(primitives * COORDINATES)
    index = np.arange(primitives)
    apart = np.abs(index[:, None] - index)
    bevel = index * COORDINATES + BEVEL
    correlation[np.ix_(bevel, bevel)] = _BEVEL_CORRELATION**apart
    return correlation


def schedule(problem: PlanProblem, z: Floats) -> tuple[Floats, Floats]:
    """Primitives z (N, 6 P) to controls (N, m, 5), padded with zero steps, and bevel directions (N, P).

    The sum of lateral steps is limited to the reach here, before any rollout.
    """
    primitives = z.reshape(len(z), problem.primitives, COORDINATES)
    share = np.exp(primitives[:, :, SHARE])
    share *= problem.travel / share.sum(axis=1, keepdims=True)
    count = np.ceil(share / primitives[:, :, ADVANCE] - 1e-9).astype(int)  # steps of each primitive
    steps = np.concatenate([(share / count)[:, :, None], _within_reach(problem, primitives, count)], axis=2)
    wanted = np.where(primitives[:, :, BEVEL] >= 0.0, 1.0, -1.0)
    ends = np.cumsum(count, axis=1)
    index = np.arange(ends[:, -1].max())
    owner = (index[None, :, None] >= ends[:, None, :]).sum(
        axis=2
    )  # primitive of each step; P when it is over
    rows = np.arange(len(z))[:, None]
    steps = np.concatenate([steps, np.zeros((len(z), 1, 4))], axis=1)
    controls = np.full((len(z), index.size, 5), -1.0)
    controls[:, :, :4] = steps[rows, owner]
    first = np.concatenate([np.zeros((len(z), 1), dtype=int), ends[:, :-1]], axis=1)
    rolls = wanted != np.concatenate([np.ones((len(z), 1)), wanted[:, :-1]], axis=1)
    controls[rows, first, 4] = np.where(rolls, 1.0, -1.0)
    return controls, wanted


def _within_reach(problem: PlanProblem, primitives: Floats, count: NDArray[np.int64]) -> Floats:
    """Lateral steps (N, P, 3) whose running sums stay within reach."""
    lateral = primitives[:, :, BASE_Y : GUIDE + 1].copy()
    total = np.zeros((len(primitives), 3))
    for p in range(problem.primitives):
        n = count[:, p, None]
        moved = np.clip(total + n * lateral[:, p], -problem.reach[1:], problem.reach[1:])
        lateral[:, p] = (moved - total) / n
        total = moved
    return lateral
