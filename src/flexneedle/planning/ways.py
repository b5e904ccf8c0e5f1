"""Ways past zones to avoid: first paths by superposition, without a rollout of each.

Layers are flat and slopes are small, so a path with a changed entry is nearly the old path plus the line of the change,
and the effect of the guide nearly adds up, on the path of the tip and on the needle at the end. So a few rollouts, one
for each pattern of rolls and one for each motion of the guide, describe thousands of paths to the target, with their
clearance and, by the distance of the needle from the path that it has cut, the compression of the tissue.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.costs.terms import LITTLE_CLEARANCE, SHARE_OF_LIMIT
from flexneedle.costs.weighted_sum import RolloutFunction
from flexneedle.planning.entry import entry_bounds, read_entry
from flexneedle.planning.primitives import make_controls, variables_of
from flexneedle.planning.problem import LATERAL, PlanProblem
from flexneedle.types import PSI, THETA, Floats, Laterals, X, Y, Z, across

_PLACES = 6  # at which the bevel may be rolled in a pattern, and one more
_MOST_ROLLS = 2
_ANGLES = 8  # of the bevel in space
_SURE = 1.5  # of ε in a pattern: its standard deviation is 1
_SLOPES = {1: 81, 2: 300}  # of entries, by the number of axes
_GUIDES = 2000  # random motions of the guide
_WIDE = 4.0  # standard deviations of the guide's steps, of the plan's
_POINTS = 64  # of a path
_APART_MM = 2.0  # largest distance of two paths that are different ways
_BEST = 100  # of the ways without the guide, with which it moves
_CANDIDATES = 100  # from which each way is chosen
_COMPRESSION = 0.3  # of the tissue, beyond which it is charged
_LOAD_MM = 20.0
_MEAN = 0.3  # weight of the mean intrusion
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class Room:
    """Properties of a room by which a path is judged.

    clearances: maps points (…, 3) of the needle's axis to their clearances (…), mm; lengths: maps depths (p,), mm, to
    the tissue's compression lengths there (p,), mm; curvature: of the needle at the limit of its strain (1/mm).
    """

    clearances: Callable[[Floats], Floats]
    lengths: Callable[[Floats], Floats]
    curvature: float


@dataclass(frozen=True, eq=False)
class Ways:
    """N paths to the target: coordinates z (N, d) of the search, and y + iz (mm) at depths (p,).

    paths (N, p): of the tip; bodies (N, p): of the needle at the end; bends (N, n): curvature along it (1/mm).
    """

    z: Floats
    paths: Laterals
    bodies: Laterals
    bends: Laterals
    depths: Floats

    def take(self, which: slice | NDArray[np.intp]) -> "Ways":
        """Return some of the paths."""
        return Ways(self.z[which], self.paths[which], self.bodies[which], self.bends[which], self.depths)


def find_ways(
    rollout: RolloutFunction,
    problem: PlanProblem,
    room: Room,
    count: int,
    rng: np.random.Generator,
) -> Floats:
    """Return coordinates (n, d) of up to `count` paths that differ, the best first.

    Entries are on a grid, the guide's motions random. rollout: with the shapes at the end.
    """
    responses = Responses.of(rollout, problem)
    ways = responses.at_entries()
    costs = rate(problem, ways, room)
    if not responses.columns:
        return _choose(ways, costs, count)
    moved = responses.with_guide(ways, costs, rng)
    still = _choose(ways, costs, count // 2)  # gentler where both are clear
    return np.concatenate([still, _choose(moved, rate(problem, moved, room), count - len(still))])


def rate(problem: PlanProblem, ways: Ways, room: Room) -> Floats:
    """Return costs (N,), mm: of what the ways lack, of little clearance and of little reserve of the bevel."""
    gaps = measure_gaps(ways, room)
    wanted = (problem.clear or 0.0) + problem.spare
    costs = rate_lack(problem, ways, room, gaps)
    costs += LITTLE_CLEARANCE * np.maximum(wanted - gaps.min(axis=(0, 2)), 0.0)
    if problem.entry_coordinates:
        costs += problem.beyond_reach(*read_entry(problem, ways.z[:, -problem.entry_coordinates :]))
    return costs


def rate_lack(problem: PlanProblem, ways: Ways, room: Room, gaps: Floats) -> Floats:
    """Return intrusion into margins, miss, loads of tissue and needle (N,), as mm, at clearances (2, N, p)."""
    inside = np.maximum((problem.clear or 0.0) - gaps, 0.0)
    worst = (inside.max(axis=2) + _MEAN * inside.mean(axis=2)).max(axis=0)
    miss = np.abs(ways.paths[:, -1] - complex(*problem.target[1:]))
    pressed = np.abs(ways.bodies - ways.paths) / room.lengths(ways.depths)
    excess = np.maximum(pressed.max(axis=1) - _COMPRESSION, 0.0)
    bent = np.abs(ways.bends).max(axis=1) / room.curvature
    excess += np.maximum(bent / SHARE_OF_LIMIT - 1.0, 0.0)
    costs: Floats = worst + 0.5 * miss + _LOAD_MM * excess + 0.1 * (pressed.max(axis=1) + bent)
    return costs


def measure_gaps(ways: Ways, room: Room) -> Floats:
    """Return the clearances (2, N, p), mm, of the path of the tip and of the needle at the end."""
    points = np.empty((2, *ways.paths.shape, 3))
    points[..., X] = ways.depths
    for k, lines in enumerate((ways.paths, ways.bodies)):
        points[k, ..., Y], points[k, ..., Z] = lines.real, lines.imag
    return room.clearances(points)


def _choose(ways: Ways, costs: Floats, count: int) -> Floats:
    """Return the coordinates (n, d) of the best paths that are apart from each other."""
    order = np.argsort(costs, kind="stable")[: _CANDIDATES * count]
    chosen: list[int] = []
    while len(chosen) < count and order.size:
        chosen.append(int(order[0]))
        order = order[np.abs(ways.paths[order] - ways.paths[order[0]]).max(axis=1) > _APART_MM]
    return ways.z[chosen]


class Entries(NamedTuple):
    """N entries: pattern of rolls, change of the point y + iz (mm) and of the slope (rad)."""

    pattern: NDArray[np.intp]
    point: Laterals
    slope: Laterals


@dataclass(frozen=True, eq=False)
class Responses:
    """Rollouts of which paths are superposed.

    patterns: insertions with rolls alone; columns (J,): coordinates of the guide's motions; guide: changes of path and
    needle per unit of each; scale (J,): their standard deviations.
    """

    problem: PlanProblem
    patterns: Ways
    columns: list[int]
    guide: Ways
    scale: Floats

    @staticmethod
    def of(rollout: RolloutFunction, problem: PlanProblem) -> "Responses":
        """Return the responses by a rollout of each."""
        z = _patterns(problem)
        columns, scale = _guide_coordinates(problem)
        moved = np.tile(z[:1], (len(columns), 1))
        moved[np.arange(len(columns)), columns] = scale
        found = rollout(make_controls(problem, np.concatenate([z, moved]))[0])
        depths = np.linspace(0.0, problem.target[0], _POINTS + 1)[1:]
        paths = np.array([_resample(depths, each) for each in found.tips])
        bodies = np.array([_resample(depths, each) for each in found.shapes[:, -1]])
        both = Ways(np.concatenate([z, moved]), paths, bodies, _curvatures(found.shapes[:, -1]), depths)
        guide, one = both.take(slice(len(z), None)), scale[:, None]
        changes = Ways(
            guide.z,
            (guide.paths - paths[0]) / one,
            (guide.bodies - bodies[0]) / one,
            (guide.bends - both.bends[0]) / one,
            depths,
        )
        return Responses(problem, both.take(slice(len(z))), columns, changes, scale)

    def at_entries(self) -> Ways:
        """Return paths with each pattern to the target, from entries of a grid of slopes."""
        problem = self.problem
        radius, most = problem.entry
        entries = self.spread_entries(most)
        size = np.abs(entries.point)
        kept = size <= radius if (size <= radius).any() else np.ones_like(size, dtype=bool)
        point = entries.point * np.minimum(1.0, radius / np.maximum(size, np.finfo(float).tiny))
        return self.enter(entries.pattern[kept], point[kept], entries.slope[kept])

    def spread_entries(self, most: float) -> Entries:
        """Return entries with changes of the slope up to `most` (rad) from which each pattern ends at the target."""
        problem = self.problem
        slopes = _disc(_SLOPES[problem.axes] if most else 1, most, problem.axes)
        steep = slopes + problem.slope
        slopes = slopes[np.maximum(np.abs(steep.real), np.abs(steep.imag)) <= problem.steepest]
        ends = self.patterns.paths[:, -1:] + slopes * problem.target[0]  # (K, S)
        pattern = np.broadcast_to(np.arange(len(ends))[:, None], ends.shape)
        point = complex(*problem.target[1:]) - ends
        return Entries(pattern.ravel(), point.ravel(), np.broadcast_to(slopes, ends.shape).ravel())

    def enter(self, pattern: NDArray[np.intp], point: Laterals, slope: Laterals) -> Ways:
        """Return paths of patterns (N,) from an entry changed by `point` (N,), mm, and `slope` (N,)."""
        problem, ways = self.problem, self.patterns
        line = point[:, None] + slope[:, None] * ways.depths
        z = ways.z[pattern]
        if problem.entry_coordinates:
            own = np.stack([point, slope], axis=1) / problem.frame
            parts = [own.real] if problem.axes == 1 else [own.real, own.imag]
            z[:, -problem.entry_coordinates :] = np.stack(parts, axis=2).reshape(len(z), -1)
        paths, bodies = ways.paths[pattern] + line, ways.bodies[pattern] + line
        return Ways(z, paths, bodies, ways.bends[pattern], ways.depths)

    def with_guide(self, ways: Ways, costs: Floats, rng: np.random.Generator) -> Ways:
        """Return the best of ways with random motions of the guide, by which they end at the target as well."""
        best = np.argsort(costs, kind="stable")[:_BEST]
        chosen = best[rng.integers(len(best), size=_GUIDES)]
        wide = self.scale * _WIDE * 10.0 ** rng.uniform(-1.0, 0.0, (_GUIDES, 1))
        moved = wide * rng.standard_normal((_GUIDES, len(self.columns)))
        guide, axes = self.guide, self.problem.axes
        ends = guide.paths[:, -1]
        miss = complex(*self.problem.target[1:]) - ways.paths[chosen, -1] - moved @ ends
        effect, wanted = (np.stack([each.real, each.imag])[:axes] for each in (ends, miss))
        moved += wanted.T @ np.linalg.pinv(effect, rcond=1e-3).T
        z = ways.z[chosen]
        z[:, self.columns] = moved
        paths = ways.paths[chosen] + moved @ guide.paths
        bodies = ways.bodies[chosen] + moved @ guide.bodies
        return Ways(z, paths, bodies, ways.bends[chosen] + moved @ guide.bends, ways.depths)


def correct_miss(rollout: RolloutFunction, problem: PlanProblem, z: Floats) -> Floats:
    """Return coordinates (N, d) with the entry point moved by what the rollouts miss, within its bounds."""
    if not problem.entry[0]:
        return z
    tips = rollout(make_controls(problem, z)[0]).tips
    ends = np.array([_resample(np.array([problem.target[0]]), each)[0] for each in tips])
    miss = (complex(*problem.target[1:]) - ends) / problem.frame
    moved, first = z.copy(), -problem.entry_coordinates
    moved[:, first] += miss.real
    if problem.axes == 2:
        moved[:, first + 1] += miss.imag
    bounds = entry_bounds(problem)
    moved[:, first:] = np.clip(moved[:, first:], -bounds, bounds)
    return moved


def _resample(depths: Floats, tips: Floats) -> Laterals:
    """Return lateral positions (p,) at depths of poses (m, 5) of a tip, on its last tangent beyond its end."""
    x = np.maximum.accumulate(tips[:, X])
    lateral = across(tips, Y)
    found: Laterals = np.interp(depths, x, lateral.real) + 1j * np.interp(depths, x, lateral.imag)
    beyond = np.maximum(depths - x[-1], 0.0)
    slope = np.tan(tips[-1, THETA]) + 1j * np.tan(tips[-1, PSI])
    line: Laterals = found + beyond * slope
    return line


def _curvatures(shapes: Floats) -> Laterals:
    """Return curvatures (N, n − 1), 1/mm, of needles (N, n, 5)."""
    slopes = across(shapes, THETA)
    lengths = np.linalg.norm(np.diff(shapes[..., :3], axis=1), axis=2)
    found: Laterals = np.diff(slopes, axis=1) / np.maximum(lengths, np.finfo(float).tiny)
    return found


def _patterns(problem: PlanProblem) -> Floats:
    """Return coordinates (K, d) of insertions with up to two half turns, from several angles of the bevel."""
    count = problem.primitives
    places = np.unique(np.linspace(0, count, min(count, _PLACES) + 1).astype(int))[1:-1].tolist()
    signs = []
    for rolls in range(_MOST_ROLLS + 1 if problem.half_turns else 2):
        for chosen in combinations(places, rolls):
            turned = (np.arange(count)[:, None] >= np.array(chosen, dtype=int)).sum(axis=1)
            signs.append((-1.0) ** turned)
    angles = [0.0, np.pi] if problem.half_turns else np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    bevel = np.array([sign * np.exp(1j * angle) for angle in angles for sign in signs]) * _SURE
    z = np.tile(variables_of(problem).mean, (len(bevel), 1))
    for axis, part in enumerate((bevel.real, bevel.imag)[: problem.axes]):
        z[:, problem.bevel.start + axis : count * problem.coordinates : problem.coordinates] = part
    return z


def _guide_coordinates(problem: PlanProblem) -> tuple[list[int], Floats]:
    """Return the coordinates of lateral steps that are free, and their standard deviations."""
    free = [k for k in range(LATERAL, problem.bevel.start) if problem.sigma[k] > 0.0]
    # Across the frame the first samples are narrow; a way round a zone may be on any side.
    sizes = {k: problem.sigma[k - (k - LATERAL) % problem.axes] for k in free}
    columns = [p * problem.coordinates + k for p in range(problem.primitives) for k in free]
    return columns, np.array([sizes[k] for _ in range(problem.primitives) for k in free])


def _disc(count: int, radius: float, axes: int) -> Laterals:
    """Return points (n,) that cover a disc, or an interval of the real axis, the centre first."""
    if axes == 1:
        return np.linspace(-radius, radius, count) + 0j
    index = np.arange(count)
    size = radius * np.sqrt(index / max(count - 1, 1))
    points: Laterals = size * np.exp(1j * _GOLDEN * index)
    return points
