"""Insertion plans: a few control primitives, their cost, and the search for the best (paper section III-A).

A primitive covers its share of the travel with equal steps. Its coordinates are the longest step of base x (mm), on
each lateral axis the step of the base (mm), of its slope (rad) and of the guide (mm), ε, the vector of the wanted bevel
direction, and the logarithm of its share, before normalisation. In the plane, and where the needle rolls by half turns,
the sign of ε_y is the direction. The needle is rolled, and charged by the angle, where the wanted direction changes.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.costs.weighted_sum import RolloutFunction
from flexneedle.planning.cross_entropy import Search, SearchState
from flexneedle.planning.entry import add_along, entry_bounds, mount_needle, read_entry
from flexneedle.planning.horizon import Found, OnIteration, Variables, find_best
from flexneedle.planning.problem import ADVANCE, LATERAL, MOVES, PlanProblem
from flexneedle.types import COLUMNS, DB_X, ROLL, Floats, wrap_angles

_LEAST_ADVANCE = 0.5  # of the longest step
_BEVEL_BOUND = 3.0  # ε has standard deviation 1 at first
_ENTRY_SIGMA = 0.25  # of the bounds
_SHARE_BOUND = 1.0  # no primitive is longer than e² times another
LEAST_ROLL = 0.1
"""Smallest roll (rad): a smaller one turns the path by less than it costs a driver to make it."""
_BEVEL_CORRELATION = 0.8  # of ε of neighbouring primitives at first: few flips are likelier than many


@dataclass(frozen=True)
class Solution:
    """The best controls of a plan, and the search behind them."""

    controls: Floats  # controls (m, 9)
    entry: tuple[complex, complex]  # entry as changes of y + iz (mm) and slope
    roll: float  # roll at the start (rad)
    cost: float
    terms: dict[str, float]  # cost by term
    search_state: SearchState


def search_primitives(
    rollout: RolloutFunction,
    problem: PlanProblem,
    search: Search,
    rng: np.random.Generator,
    progress: OnIteration = lambda _info: None,
) -> Solution:
    """Search the primitives.

    `rollout` starts without roll in air; a sample with another direction rolls in its first step, which is not charged.
    """
    found = find_best(variables_of(problem), rollout, problem.terms, search, rng, progress=progress)
    return make_solution(problem, found)


def widen_search(problem: PlanProblem) -> PlanProblem:
    """Return the problem with wider first samples.

    The standard deviation of each lateral step along the frame is at least the largest step; across it, the ratio is
    the same. Fixed coordinates remain fixed.
    """
    lateral, sigma = slice(LATERAL, problem.bevel.start), problem.sigma.copy()
    along = sigma[lateral][:: problem.axes]
    most = problem.step[list(MOVES[problem.axes])][:: problem.axes]
    ratio = np.divide(most, along, out=np.ones_like(along), where=along > 0.0)
    sigma[lateral] *= np.repeat(np.maximum(ratio, 1.0), problem.axes)
    return replace(problem, sigma=sigma)


def fix_guide(problem: PlanProblem) -> PlanProblem:
    """Return the problem with guide and base fixed, so that only the bevel steers."""
    sigma = problem.sigma.copy()
    sigma[LATERAL : problem.bevel.start] = 0.0
    return replace(problem, sigma=sigma)


def make_solution(problem: PlanProblem, found: Found) -> Solution:
    """Return the solution: without steps that do not advance, rolled before the first."""
    controls = found.trajectories.controls[0]
    entry = read_entry(problem, found.z[None, found.z.size - problem.entry_coordinates :])
    facing = np.cumsum(controls[:, ROLL])
    moving = controls[:, DB_X] > 0.0
    controls, facing = controls[moving], facing[moving]
    controls[:, ROLL] = np.diff(facing, prepend=facing[0])
    add_along(controls[None], -entry[1])
    place = complex(entry[0][0]), complex(entry[1][0])
    return Solution(controls, place, float(facing[0]), found.cost, found.terms, found.search_state)


def variables_of(problem: PlanProblem) -> Variables:
    """Return the variables of a search for primitives, and for the entry if it is free."""
    n, lateral = problem.primitives, problem.step[list(MOVES[problem.axes])]
    most, entry = [*lateral, *[_BEVEL_BOUND] * problem.axes, _SHARE_BOUND], entry_bounds(problem)
    return Variables(
        lower=np.append(np.tile([_LEAST_ADVANCE * problem.step[0], *np.negative(most)], n), -entry),
        upper=np.append(np.tile([problem.step[0], *most], n), entry),
        mean=np.append(np.tile([problem.step[0], *np.zeros(len(most))], n), 0.0 * entry),
        sigma=np.append(np.tile(problem.sigma, n), _ENTRY_SIGMA * entry * _entry_ratios(problem)),
        controls=lambda z: make_controls(problem, z)[0],
        correlation=_correlation(problem),
    )


def _entry_ratios(problem: PlanProblem) -> Floats:
    """Return the standard deviations of the coordinates of the entry, relative to those along the frame, as for ε."""
    return np.tile(problem.sigma[problem.bevel], 2)[: problem.entry_coordinates]


def _correlation(problem: PlanProblem) -> Floats:
    """Return the initial correlation of the coordinates: only ε is correlated, between primitives."""
    correlation = np.eye(problem.primitives * problem.coordinates + problem.entry_coordinates)
    index = np.arange(problem.primitives)
    apart = np.abs(index[:, None] - index)
    for k in range(problem.bevel.start, problem.bevel.stop):
        bevel = index * problem.coordinates + k
        correlation[np.ix_(bevel, bevel)] = _BEVEL_CORRELATION**apart
    return correlation


def make_controls(problem: PlanProblem, z: Floats) -> tuple[Floats, Floats]:
    """Return controls (N, m, 9), padded with zero steps, and bevel directions (N, P), rad, of samples z (N, c P + e).

    The sum of lateral steps is limited to the reach here, before any rollout.
    """
    known = problem.primitives * problem.coordinates
    entry, primitives = z[:, known:], z[:, :known].reshape(len(z), problem.primitives, problem.coordinates)
    share = np.exp(primitives[:, :, -1])
    share *= _travel(problem, entry)[:, None] / share.sum(axis=1, keepdims=True)
    count = np.ceil(share / primitives[:, :, ADVANCE] - 1e-9).astype(int)  # steps of each primitive
    steps = np.concatenate([(share / count)[:, :, None], _limit_reach(problem, primitives, count)], axis=2)
    wanted = _directions(problem, primitives[:, :, problem.bevel])
    ends = np.cumsum(count, axis=1)
    index = np.arange(ends[:, -1].max())
    # Primitive of each step; P when the last one is over.
    owner = (index[None, :, None] >= ends[:, None, :]).sum(axis=2)
    rows = np.arange(len(z))[:, None]
    steps = np.concatenate([steps, np.zeros((len(z), 1, steps.shape[2]))], axis=1)
    controls = np.zeros((len(z), index.size, len(COLUMNS)))
    controls[:, :, [DB_X, *MOVES[problem.axes]]] = steps[rows, owner]
    first = np.concatenate([np.zeros((len(z), 1), dtype=int), ends[:, :-1]], axis=1)
    wanted = drop_small_rolls(wanted)
    rolls = np.diff(_unwrap_in_range(wanted, problem.rotation), axis=1, prepend=0.0)
    controls[rows, first, ROLL] = rolls if np.isfinite(problem.rotation) else wrap_angles(rolls)
    return mount_needle(problem, controls, entry), wanted


def _travel(problem: PlanProblem, entry: Floats) -> Floats:
    """Return the travel (N,), mm, to the target's depth from entries (N, e): longer for an inclined needle."""
    if not problem.length or not problem.entry_coordinates:
        return np.full(len(entry), problem.travel)
    slopes = np.abs(problem.slope + read_entry(problem, entry)[1])
    cosine = 1.0 / np.sqrt(1.0 + slopes**2)
    straight = problem.travel + problem.length * (1.0 - cosine)
    travel: Floats = np.minimum(straight, problem.reach[0])
    return travel


def drop_small_rolls(wanted: Floats) -> Floats:
    """Return directions (N, P), rad, in which one that hardly differs from the direction before it is the same."""
    kept = wanted.copy()
    for p in range(1, wanted.shape[1]):
        small = np.abs(wrap_angles(kept[:, p] - kept[:, p - 1])) < LEAST_ROLL
        kept[small, p] = kept[small, p - 1]
    return kept


def _unwrap_in_range(wanted: Floats, rotation: float) -> Floats:
    """Return the angles (N, P), rad, of directions (N, P), −π to π: each the nearest in range to the one before."""
    if not np.pi < rotation < np.inf:
        return wanted
    angles = wanted.copy()
    for p in range(1, wanted.shape[1]):
        near = angles[:, p - 1] + wrap_angles(wanted[:, p] - angles[:, p - 1])
        back = near - 2.0 * np.pi * np.sign(near)
        angles[:, p] = np.where(np.abs(near) <= rotation, near, back)
    return angles


def _directions(problem: PlanProblem, bevel: Floats) -> Floats:
    """Return angles (N, P) of wanted directions (N, P, axes)."""
    if problem.half_turns:
        return np.where(bevel[:, :, 0] >= 0.0, 0.0, np.pi)
    angles = wrap_angles(np.arctan2(bevel[:, :, 1], bevel[:, :, 0]) + np.angle(problem.frame))
    return np.clip(angles, -problem.rotation, problem.rotation)


def _limit_reach(problem: PlanProblem, primitives: Floats, count: NDArray[np.int64]) -> Floats:
    """Return the lateral steps (N, P, k) whose running sums stay within reach."""
    columns = list(MOVES[problem.axes])
    lateral, reach = primitives[:, :, LATERAL : problem.bevel.start].copy(), problem.reach[columns]
    if problem.frame != 1.0:
        turned = (lateral[:, :, ::2] + 1j * lateral[:, :, 1::2]) * problem.frame
        lateral[:, :, ::2], lateral[:, :, 1::2] = turned.real, turned.imag
        lateral = np.clip(lateral, -problem.step[columns], problem.step[columns])
    total = np.zeros((len(primitives), len(columns)))
    for p in range(problem.primitives):
        n = count[:, p, None]
        moved = np.clip(total + n * lateral[:, p], -reach, reach)
        lateral[:, p] = (moved - total) / n
        total = moved
    return lateral
