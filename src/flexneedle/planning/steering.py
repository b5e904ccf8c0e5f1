"""Insertion plans with the bevel as the only input: its side at the start, and the depths of a few rolls.

The end of the tip is a continuous function of the depth of a roll. A roll at the skin is an insertion with the other
side, a roll at the target one without a roll; so by the intermediate value theorem one roll reaches every target
between the ends of the two insertions without a roll, and no sequence of rolls is needed to find it. More rolls can
only lower the cost.

With less than half a turn to either side the bevel cannot face each direction and its opposite, so angles are searched
as well. The ends of insertions with one angle are on an arc, and the reach of the bevel is its convex hull. One roll
still reaches all of it: each point of the hull is on a chord between two angles ±b in the range.
"""

from dataclasses import replace

import numpy as np

from flexneedle.costs.terms import past_target
from flexneedle.costs.weighted_sum import RolloutFunction
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.entry import entry_bounds, mount_needle, read_entry
from flexneedle.planning.horizon import Found, OnIteration, Variables, count_iterations, find_best
from flexneedle.planning.primitives import Solution, drop_small_rolls, make_solution
from flexneedle.planning.problem import InnerReach, PlanProblem
from flexneedle.simulator.control import controls
from flexneedle.types import ROLL, Floats, X

MOST_ROLLS = 4
_INNER = 0.5  # of the reach
_USUAL_SEARCHES = 5  # one roll and two, from either side, and the last
_WIDE, _NARROW = 0.3, 0.02  # first standard deviations, as shares of the target's depth and of the bounds
_ROUNDING = 1e-9  # of the reach


def search_rolls(
    rollout: RolloutFunction,
    problem: PlanProblem,
    search: Search,
    rng: np.random.Generator,
    progress: OnIteration = lambda _info: None,
    most: int = MOST_ROLLS,
) -> Solution:
    """Search the depths of 0 to `most` rolls with either side at the start, until one more does not lower the cost.

    Where the driver's range is less than a turn, the needle's angles before the first roll and after each one are
    searched as well. The best of all is searched once more with the travel that it needs to end at the target's depth:
    a bent needle ends short of it. `rollout` starts with bevel +1 in air; `search` applies to each number of rolls and
    side.
    """
    found: list[tuple[float, int, Found]] = []
    if problem.entry_coordinates:
        problem = replace(problem, inner=inner_reach(rollout, problem))
    charged = problem.terms
    size = radius(rollout, problem) if problem.narrow else 0.0
    for rolls in range(most + 1):
        before = min((one.cost for *_, one in found), default=np.inf)
        for side in (1.0, -1.0):
            same = rolls == 0 and problem.entry_coordinates == 0 and not problem.narrow
            count = search.elite if same else search.samples
            depths = np.sort(rng.uniform(size=(count, rolls)), axis=1)
            entries = _propose_entries(problem, count, rng)
            angles = _propose_angles(problem, size, side, rolls, entries)
            even = np.arange(1, rolls + 1) / (rolls + 1)
            variables = _variables(problem, side, rolls, np.concatenate([even, angles[0], entries[0]]), _WIDE)
            if problem.narrow:
                angles = _scatter(problem, angles, rng)
            first = np.concatenate([depths, angles, entries], axis=1)
            shown = _count_iterations(progress, search, [one for *_, one in found])
            one = find_best(variables, rollout, charged, search, rng, first=first, progress=shown)
            found.append((side, rolls, one))
        if rolls > 0 and min(one.cost for *_, one in found) == before:
            break
    side, rolls, one = min(found, key=lambda each: each[2].cost)
    short = max(0.0, problem.target[0] - float(one.trajectories.tips[0, -1, X]))
    longer = replace(problem, travel=min(problem.travel + short, float(problem.reach[0])))
    shown = _count_iterations(progress, search, [each for *_, each in found])
    mean = np.append(np.sort(one.z[:rolls]), one.z[rolls:])
    variables = _variables(longer, side, rolls, mean, _NARROW)
    return make_solution(longer, find_best(variables, rollout, charged, search, rng, progress=shown))


def inner_reach(rollout: RolloutFunction, problem: PlanProblem) -> InnerReach:
    """Return the inner half of the bevel's reach, or of the largest disc in it where the range is less than a turn."""
    if problem.narrow:
        size, least = radius(rollout, problem), np.cos(problem.rotation)
        return InnerReach(0.5 * size * (1.0 + least), _INNER * 0.5 * size * (1.0 - least))
    least, greatest = _ends(rollout, problem)
    return InnerReach(half=_INNER * 0.5 * (greatest - least))


def _variables(problem: PlanProblem, side: float, rolls: int, mean: Floats, sigma: float) -> Variables:
    """Return the variables of a search about `mean`.

    They are the depths of the rolls, as shares of the target's; the needle's angles (rad) before and after them where
    the range is less than a turn; and the coordinates of the entry.
    """
    bounds, last = entry_bounds(problem), mean.size - problem.entry_coordinates
    most = np.concatenate([np.ones(rolls), np.full(last - rolls, problem.rotation), bounds])
    least = -most
    least[:rolls] = 0.0

    def controls_of(z: Floats) -> Floats:
        depths, angles, entry = np.split(z, [rolls, last], axis=1)
        rows = (
            controls_with_angles(problem, depths, angles)
            if problem.narrow
            else controls_with_flips(problem, depths, side)
        )
        return mount_needle(problem, rows, entry)

    return Variables(least, most, mean, sigma * most, controls_of)


def _propose_entries(problem: PlanProblem, count: int, rng: np.random.Generator) -> Floats:
    """Return coordinates (count, e) of the entry, the present one first."""
    bounds = entry_bounds(problem)
    entries = rng.uniform(-1.0, 1.0, (count, bounds.size)) * bounds
    entries[:1] = 0.0
    return entries


def _propose_angles(problem: PlanProblem, size: float, side: float, rolls: int, entries: Floats) -> Floats:
    """Return angles (count, rolls + 1) between which an insertion reaches the target, alternately.

    They are ±b on the chord through the target, or through the point in the reach that is nearest to it; none where the
    range is not less than a turn. size: of the bevel's reach (mm); entries: coordinates (count, e) of the entry.
    """
    if not problem.narrow:
        return np.empty((len(entries), 0))
    point, slope = read_entry(problem, entries)
    off = (problem.across - point - slope * problem.target[0]) / max(size, np.finfo(float).tiny)
    place = (off / np.maximum(np.abs(off), 1.0)).real
    half = np.arccos(np.maximum(place, np.cos(problem.rotation)))
    angles: Floats = np.minimum(half, problem.rotation)[:, None] * side * (-1.0) ** np.arange(rolls + 1)
    return angles


def _scatter(problem: PlanProblem, angles: Floats, rng: np.random.Generator) -> Floats:
    """Return angles (count, k) with deviations that grow from none in the first sample to `_WIDE` of the range."""
    scale = _WIDE * problem.rotation * np.linspace(0.0, 1.0, len(angles))[:, None]
    return angles + scale * rng.standard_normal(angles.shape)


def controls_with_flips(problem: PlanProblem, z: Floats, side: float) -> Floats:
    """Return controls (N, m, 9) of an insertion with flips at shares z (N, k) of the target's depth, in any order.

    side: of the problem's direction, to which the bevel points at the start.
    """
    start, rolls = float(np.angle(side * problem.direction)), np.full(z.shape, np.pi)
    if np.isfinite(problem.rotation):  # to and fro between two angles in the range
        there = float(np.angle(-side * problem.direction))
        rolls = np.tile((there - start) * (-1.0) ** np.arange(z.shape[1]), (len(z), 1))
    return _insert_with_rolls(problem, z, np.full(len(z), start), rolls)


def controls_with_angles(problem: PlanProblem, z: Floats, angles: Floats) -> Floats:
    """Return controls (N, m, 9) of an insertion at angles (N, k + 1), rad, that rolls from each to the next.

    z (N, k): depths of the rolls as shares of the target's, in any order.
    """
    kept = drop_small_rolls(angles)
    return _insert_with_rolls(problem, z, kept[:, 0], np.diff(kept, axis=1))


def _insert_with_rolls(problem: PlanProblem, z: Floats, start: Floats, rolls: Floats) -> Floats:
    """Return controls (N, m, 9) that begin with the angles `start` (N,) and roll by `rolls` (N, k), rad, in this order.

    z (N, k): depths of the rolls as shares of the target's, in any order. The steps are even except where a roll
    divides one: so no roll changes the other steps, whose length has an effect near the skin, and the end of the tip is
    continuous in z.
    """
    n, z = len(z), np.sort(z, axis=1)
    even = np.linspace(0.0, problem.travel, int(np.ceil(problem.travel / problem.step[0] - 1e-9)) + 1)
    starts = np.concatenate([np.tile(even[:-1], (n, 1)), problem.air + z * problem.target[0]], axis=1)
    order = np.argsort(starts, axis=1, kind="stable")
    edges = np.take_along_axis(starts, order, axis=1)
    rows = controls(n, edges.shape[1], db_x=np.diff(edges, axis=1, append=problem.travel))
    made = np.concatenate([np.zeros((n, even.size - 1)), rolls], axis=1)
    rows[:, :, ROLL] = np.take_along_axis(made, order, axis=1)
    rows[:, 0, ROLL] = start
    return rows


def reach(rollout: RolloutFunction, problem: PlanProblem) -> tuple[float, float]:
    """Return the least and greatest distance (mm) from the needle's axis that the bevel alone reaches.

    The distances are at the target's depth, in the problem's direction. Where the range is less than a turn: on the
    line from the axis to the target, the part in the hull of the arc of ends; the least is infinite and the greatest
    −infinite if the line passes by the hull.
    """
    if not problem.narrow:
        axis = (problem.axis * problem.direction.conjugate()).real
        least, greatest = _ends(rollout, problem)
        return least - axis, greatest - axis
    size, cosine = radius(rollout, problem), problem.direction.real
    chord = size * (float(np.cos(problem.rotation)) - _ROUNDING)
    if cosine == 0.0:
        return (-size, size) if chord <= 0.0 else (np.inf, -np.inf)
    least = max(-size, chord / cosine) if cosine > 0.0 else -size
    greatest = size if cosine > 0.0 else min(size, chord / cosine)
    return (least, greatest) if least <= greatest else (np.inf, -np.inf)


def radius(rollout: RolloutFunction, problem: PlanProblem) -> float:
    """Return the distance (mm) from the needle's axis at the target's depth where an insertion without rolls ends.

    Tissue has no preferred direction, so it is the same for each angle of the bevel.
    """
    ahead = (problem.target[0], problem.axis.real, problem.axis.imag)
    found = rollout(controls_with_angles(problem, np.empty((1, 0)), np.zeros((1, 1))))
    end = past_target(found.tips, ahead)
    return float(abs(end[0]))


def _ends(rollout: RolloutFunction, problem: PlanProblem) -> tuple[float, float]:
    """Return the least and greatest position (mm), in the problem's direction, of ends of insertions without rolls."""
    ahead = (problem.target[0], 0.0, 0.0)
    ends = [
        past_target(rollout(controls_with_flips(problem, np.empty((1, 0)), side)).tips, ahead)[0]
        for side in (-1.0, 1.0)
    ]
    along = [float((end * problem.direction.conjugate()).real) for end in ends]
    return min(along), max(along)


def _count_iterations(progress: OnIteration, search: Search, found: list[Found]) -> OnIteration:
    """Return `progress` with iterations and best cost counted through all searches."""
    before = sum(one.search_state.iterations for one in found)
    usual = _USUAL_SEARCHES * (search.usual or search.iterations)
    return count_iterations(progress, before, usual, min((one.cost for one in found), default=np.inf))
