"""Insertion plans: a few control primitives, their cost, and the search for the best (paper section III-A).

A primitive covers its share of the travel with equal steps. Its coordinates are the longest step of base x (mm), on
each lateral axis the step of the base (mm), of its slope (rad) and of the guide (mm), ε, the vector of the wanted bevel
direction, and the logarithm of its share, before normalisation. In the plane, and where the needle rolls by half turns,
the sign of ε_y is the direction. The needle is rolled, and charged by the angle, where the wanted direction changes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.costs.table import RolloutFunction, Term
from flexneedle.costs.terms import PLAN
from flexneedle.planning.cross_entropy import Search, SearchState
from flexneedle.planning.horizon import Found, Variables, find_best
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.types import (
    COLUMNS,
    DB_PSI,
    DB_THETA,
    DB_X,
    DB_Y,
    DB_Z,
    DG_Y,
    DG_Z,
    ROLL,
    Floats,
    Laterals,
    Point,
    wrap_angles,
)

ADVANCE, LATERAL = range(2)
"""Coordinates of a primitive: the longest step, then `MOVES`, ε on each axis, and the share."""
MOVES = {1: (DB_Y, DB_THETA, DG_Y), 2: (DB_Y, DB_Z, DB_THETA, DB_PSI, DG_Y, DG_Z)}
"""Columns of a control of the lateral coordinates, by the number of axes."""
_LEAST_ADVANCE = 0.5  # of the longest step
_BEVEL_BOUND = 3.0  # ε has standard deviation 1 at first
_ENTRY_SIGMA = 0.25  # of the bounds
_SHARE_BOUND = 1.0  # no primitive is longer than e² times another
_ROUNDING = 1e-10  # mm, or of a length
LEAST_ROLL = 0.1
"""Smallest roll (rad): a smaller one turns the path by less than it costs a driver to make it."""
_BEVEL_CORRELATION = 0.8  # of ε of neighbouring primitives at first: few flips are likelier than many


@dataclass(frozen=True)
class PlanProblem:
    """Target, limits and cost of a plan: mm, rad.

    Attributes:
        target: x, y, z.
        travel: Insertion from the start to the target depth.
        air: The part of the travel before the skin.
        primitives: Number of primitives.
        step: Largest step of each column of travel of a control, (7,).
        reach: Largest sum of the steps of each column, (7,).
        sigma: Initial standard deviation of each coordinate of a primitive, (c,); 0: fixed.
        settings: Weights of the cost.
        axes: 1 or 2 lateral axes.
        half_turns: Whether the needle rolls by half turns only.
        rotation: Largest angle of the needle to either side.
        frame: Direction of the first of two lateral coordinates.
        entry: Largest change of the point on the skin and of the slope.
        mounts: x of base and guide at the start.
        axis: y + iz of the needle's axis at the target's depth.
        slope: Slope of the axis.
        steepest: Largest slope of the axis on each lateral axis.
        lateral_travel: Largest distance of the target from the axis, on each lateral axis.
        home: Changes of point and slope of an entry within `lateral_travel`.
        left: Vector y + iz from the nearest axis that is permitted to the target.
    """

    target: Point
    travel: float
    air: float
    primitives: int
    step: Floats
    reach: Floats
    sigma: Floats
    settings: PlanSettings
    axes: int = 1
    half_turns: bool = True
    rotation: float = np.inf
    frame: complex = 1.0
    entry: tuple[float, float] = (0.0, 0.0)
    mounts: tuple[float, float] = (0.0, 0.0)
    axis: complex = 0.0
    slope: complex = 0.0
    steepest: float = np.inf
    lateral_travel: float = np.inf
    home: tuple[complex, complex] = (0.0, 0.0)
    left: complex = 0.0

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms of the cost. A roll before the first step is not charged."""
        return PLAN.terms(self.settings, target=self.target, first=1)

    @property
    def entry_coordinates(self) -> int:
        """Number of coordinates of the entry; 0 if it is fixed."""
        return 2 * self.axes if any(self.entry) else 0

    @property
    def across(self) -> complex:
        """Lateral vector y + iz (mm) from the needle's axis to the target."""
        return complex(*self.target[1:]) - self.axis

    @property
    def direction(self) -> complex:
        """Direction in which the bevel alone steers: from the needle's axis to the target; y with half turns.

        Where a limit keeps a free entry from moving straight to the target: from the nearest axis that is free.
        """
        aside = abs((self.left * self.across.conjugate()).imag)
        across = self.left if aside > _ROUNDING * abs(self.across) ** 2 else self.across
        return 1.0 if self.half_turns or across == 0.0 else across / abs(across)

    @property
    def lateral(self) -> float:
        """Lateral offset (mm) of the target from the needle's axis in that direction."""
        return (self.across * self.direction.conjugate()).real

    @property
    def narrow(self) -> bool:
        """Whether the driver's range is less than a turn, so that the bevel cannot face every direction."""
        return not self.half_turns and self.rotation < np.pi

    @property
    def bevel(self) -> slice:
        """Coordinates of ε."""
        first = LATERAL + len(MOVES[self.axes])
        return slice(first, first + self.axes)

    @property
    def coordinates(self) -> int:
        """Number of coordinates of a primitive."""
        return LATERAL + len(MOVES[self.axes]) + self.axes + 1


@dataclass(frozen=True)
class Solution:
    """The best controls of a plan, and the search behind them.

    Attributes:
        controls: Controls (m, 9).
        entry: Entry as changes of y + iz (mm) and slope.
        roll: Roll at the start (rad).
        cost: Cost.
        terms: Cost by term.
        search_state: State of the search.
    """

    controls: Floats
    entry: tuple[complex, complex]
    roll: float
    cost: float
    terms: dict[str, float]
    search_state: SearchState


def search_primitives(
    rollout: RolloutFunction,
    problem: PlanProblem,
    search: Search,
    rng: np.random.Generator,
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> Solution:
    """Search the primitives.

    `rollout` starts without roll in air; a sample with another direction rolls in its first step, which is not charged.
    """
    found = find_best(_variables(problem), rollout, problem.terms, search, rng, progress=progress)
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


def make_solution(problem: PlanProblem, found: Found) -> Solution:
    """Return the solution: without steps that do not advance, rolled before the first."""
    controls = found.trajectories.controls[0]
    entry = read_entry(problem, found.z[None, found.z.size - problem.entry_coordinates :])
    facing = np.cumsum(controls[:, ROLL])
    moving = controls[:, DB_X] > 0.0
    controls, facing = controls[moving], facing[moving]
    controls[:, ROLL] = np.diff(facing, prepend=facing[0])
    _add_along(controls[None], -entry[1])
    place = complex(entry[0][0]), complex(entry[1][0])
    return Solution(controls, place, float(facing[0]), found.cost, found.terms, found.search_state)


def _variables(problem: PlanProblem) -> Variables:
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


def entry_bounds(problem: PlanProblem) -> Floats:
    """Return the bounds to either side of the coordinates of the entry: of the point, then of the slope."""
    return np.repeat(problem.entry, problem.axes)[: problem.entry_coordinates]


def read_entry(problem: PlanProblem, z: Floats) -> tuple[Laterals, Laterals]:
    """Return changes (N,) of point (mm) and slope (rad) of the entry, for its coordinates (N, 2 axes) or none (N, 0).

    The slope keeps its limit, and the target the lateral travel: an entry that is too far from it is moved towards
    `home` as far as necessary.
    """
    if not z.size:
        none = np.zeros(len(z), dtype=complex)
        return none, none
    parts = z.reshape(len(z), 2, problem.axes)
    across = problem.frame * (parts[:, :, 0] + (1j * parts[:, :, 1] if problem.axes > 1 else 0.0))
    size = np.maximum(np.abs(across) / np.maximum(problem.entry, np.finfo(float).tiny), 1.0)
    point, slope = (across / size).T
    _keep_steepness(problem, slope)
    _keep_travel(problem, point, slope)
    return point, slope


def _keep_steepness(problem: PlanProblem, slope: Laterals) -> None:
    """Limit the slope on each axis, for changes (N,) of it; in the plane these are real."""
    parts = ((slope.real, problem.slope.real), (slope.imag, problem.slope.imag))
    for part, now in parts[: problem.axes]:
        np.clip(part, -problem.steepest - now, problem.steepest - now, out=part)


def _keep_travel(problem: PlanProblem, point: Laterals, slope: Laterals) -> None:
    """Move entries (N,) from which the target is beyond the lateral travel towards `home`, no further than need be."""
    depth, home = problem.target[0], problem.home
    off = problem.across - point - slope * depth
    least = problem.across - home[0] - home[1] * depth
    share = np.zeros(len(off))
    for there, near in ((off.real, least.real), (off.imag, least.imag)):
        far = np.abs(there) - problem.lateral_travel
        out = far > _ROUNDING
        share[out] = np.maximum(share[out], np.minimum(far[out] / np.abs(there - near)[out], 1.0))
    moved = share > 0.0
    for changes, to in ((point, home[0]), (slope, home[1])):
        changes[moved] += share[moved] * ((to.real if problem.axes == 1 else to) - changes[moved])


def _add_along(rows: Floats, slope: Laterals) -> None:
    """Add the lateral part of the advance of controls (N, m, 9) along axes with these slopes (N,)."""
    rows[:, :, DB_Y] += slope.real[:, None] * rows[:, :, DB_X]
    rows[:, :, DB_Z] += slope.imag[:, None] * rows[:, :, DB_X]


def mount_needle(problem: PlanProblem, rows: Floats, z: Floats) -> Floats:
    """Return controls (N, m, 9) after one more that moves base and guide to the entry (N, 2 axes), and rolls, in air.

    The advance is along the axis of the entry.
    """
    if not z.size:
        return rows
    point, slope = read_entry(problem, z)
    base, guide = (point + slope * x for x in problem.mounts)
    first = np.zeros_like(rows[:, :1])
    for column, value in ((DB_Y, base), (DB_THETA, slope), (DG_Y, guide)):
        first[:, 0, column], first[:, 0, column + 1] = value.real, value.imag
    first[:, 0, ROLL] = rows[:, 0, ROLL]
    rest = rows.copy()
    rest[:, 0, ROLL] = 0.0
    _add_along(rest, slope)
    return np.concatenate([first, rest], axis=1)


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
    share *= problem.travel / share.sum(axis=1, keepdims=True)
    count = np.ceil(share / primitives[:, :, ADVANCE] - 1e-9).astype(int)  # steps of each primitive
    steps = np.concatenate([(share / count)[:, :, None], _limit_reach(problem, primitives, count)], axis=2)
    wanted = _directions(problem, primitives[:, :, problem.bevel])
    ends = np.cumsum(count, axis=1)
    index = np.arange(ends[:, -1].max())
    owner = (index[None, :, None] >= ends[:, None, :]).sum(
        axis=2
    )  # primitive of each step; P when it is over
    rows = np.arange(len(z))[:, None]
    steps = np.concatenate([steps, np.zeros((len(z), 1, steps.shape[2]))], axis=1)
    controls = np.zeros((len(z), index.size, len(COLUMNS)))
    controls[:, :, [DB_X, *MOVES[problem.axes]]] = steps[rows, owner]
    first = np.concatenate([np.zeros((len(z), 1), dtype=int), ends[:, :-1]], axis=1)
    wanted = drop_small_rolls(wanted)
    rolls = np.diff(_unwrap_in_range(wanted, problem.rotation), axis=1, prepend=0.0)
    controls[rows, first, ROLL] = rolls if np.isfinite(problem.rotation) else wrap_angles(rolls)
    return mount_needle(problem, controls, entry), wanted


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
