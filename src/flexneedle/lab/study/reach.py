"""The reach: smallest miss of an insertion that any controller could achieve (docs/worlds.md)."""

import math
from collections.abc import Sequence

import numpy as np

from flexneedle.control.limits import guide_axes
from flexneedle.costs.terms import PLAN
from flexneedle.phantom.draw import Truth, draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import DEFAULT_PLANT, PlantFactory, find_plant
from flexneedle.planning.planner import plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Control, Point, X, Y, Z

_ONLY_THE_MISS = {f"plan.{key}": value for key, value in PLAN.only("miss").items()}
_SEARCHES = ((48, 10), (160, 25))
"""Samples and iterations: the second search, 14 times the longest decision of the default controller, is made if the
first one misses. After each of them the planner makes others of this size if its plan misses by more than 0.1 mm."""
_NEAR_MM = 0.05  # a miss that is as good as none
_DIRECTIONS = 6
"""Constant directions of the bevel, all around; on an arc one more, with both of its ends."""


def compute_reach(
    scenario: Scenario,
    seed: int,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    strategy: str = "manipulation",
) -> float:
    """Return the smallest miss (mm) of an ideal controller in the insertion of a seed, to about 0.5 mm.

    strategy: strategy of the plans, "manipulation" or "steering". If the guide moves on all lateral axes, or the base
    may move: the miss of the best plan, weighing the miss alone, on the model with the phantom's true parameters; the
    search ends with a miss of 0.05 mm. If neither moves: distance from the target to the convex hull of the end points
    of the plant inserted with the bevel in constant directions; by rolls between them all points in it can be reached.
    If the guide of a needle in space moves along y only: both, the miss of the best plan to a target on the needle's
    axis in z, and the distance along z from that hull. NaN if the plant does not converge.
    """
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0]))
    setup, depth = scenario.setup, scenario.target.depth_mm
    base_moves = scenario.plan.base_sigma_mm > 0.0 or scenario.plan.base_turn_sigma > 0.0
    axes = setup.axes if base_moves else guide_axes(setup, strategy)
    if axes == setup.axes:
        return _find_best_miss(truth)
    ends = [insert_straight(truth, roll, find_plant(phantom)[1], depth) for roll in _list_rolls(setup)]
    if any(math.isnan(x) for x, *_ in ends):
        return math.nan
    _, *lateral = scenario.target.position
    all_around = not setup.half_turns and setup.max_rotation >= math.pi
    places, radius = find_reachable([complex(y, z) for _, y, z in ends], all_around=all_around)
    if axes == 1:
        return math.hypot(_find_best_miss(truth, on_axis=True), distance_beside(lateral[1], places, radius))
    short = max(depth - x for x, *_ in ends)
    return math.hypot(short, max(0.0, distance_to_hull(complex(*lateral), places) - radius))


def _find_best_miss(truth: Truth, *, on_axis: bool = False) -> float:
    """Return the miss (mm) of the best plan on the true model; on_axis: with the target's z on the needle's axis."""
    scenario, target = truth.scenario, truth.scenario.target
    z = scenario.entry.lateral(target.depth_mm).imag if on_axis else target.lateral_z_mm
    aimed, missed = scenario.with_values(_ONLY_THE_MISS | {"target.lateral_z_mm": z}), math.inf
    for samples, iterations in _SEARCHES:
        length = {"plan.samples": samples, "plan.iterations": iterations, "plan.max_iterations": iterations}
        missed = min(missed, plan(aimed.with_values(length), threads=1).error_mm)
        if missed <= _NEAR_MM:
            break
    return missed


def _list_rolls(setup: Setup) -> list[float]:
    """Return constant angles (rad) of the needle: two half turns, all around, or along its range."""
    if setup.half_turns:
        return [math.pi, 0.0]
    if setup.max_rotation >= math.pi:
        return [2.0 * math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS)]
    return [setup.max_rotation * (2.0 * k / _DIRECTIONS - 1.0) for k in range(_DIRECTIONS + 1)]


def find_reachable(ends: Sequence[complex], *, all_around: bool) -> tuple[list[complex], float]:
    """Return the reachable set: points y + iz and a distance (mm) from their convex hull.

    The ends themselves, or, where their directions are all around, their mean, and their mean distance from it.
    """
    if not all_around:
        return list(ends), 0.0
    middle = sum(ends) / len(ends)
    return [middle], sum(abs(end - middle) for end in ends) / len(ends)


def distance_to_hull(target: complex, ends: Sequence[complex]) -> float:
    """Return the distance (mm) of a target y + iz from the convex hull of the ends."""
    sides = [(a, b - a) for a in ends for b in ends if a != b]
    ways = [
        side * turn / abs(side) for _, side in sides for turn in (1.0, 1.0j)
    ]  # both signs, by both orders
    if sides and all(_project(target, way) <= max(_project(end, way) for end in ends) for way in ways):
        return 0.0
    nearest = [
        a + side * min(1.0, max(0.0, _project(target - a, side) / abs(side) ** 2)) for a, side in sides
    ]
    return min(abs(target - place) for place in (*nearest, *ends))


def _project(place: complex, way: complex) -> float:
    return (place * way.conjugate()).real


def distance_beside(z: float, places: Sequence[complex], radius: float) -> float:
    """Return how far (mm) a target's z is from the range of z of points with a radius about each."""
    low, high = min(place.imag for place in places) - radius, max(place.imag for place in places) + radius
    return max(0.0, low - z, z - high)


def insert_straight(truth: Truth, roll: float, phantom: str | PlantFactory, depth: float) -> Point:
    """Return the tip x, y, z in mm of a plant inserted to a depth, or to full stroke, without moving base or bevel.

    NaN if the plant does not converge.
    """
    setup = truth.scenario.setup
    specimen = Phantom(truth, roll, phantom)
    before = after = specimen.condition()
    moved = 0.0
    while after.tip[X] < depth and moved < setup.stroke_mm:
        step = min(setup.max_advance_mm, setup.stroke_mm - moved)
        specimen.apply(Control(db_x=step), step / setup.insertion_speed_mm_s)
        moved += step
        before, after = after, specimen.condition()
    if not after.converged:
        return math.nan, math.nan, math.nan
    x = min(depth, float(after.tip[X]))
    y, z = (float(np.interp(x, (before.tip[X], after.tip[X]), (before.tip[k], after.tip[k]))) for k in (Y, Z))
    return x, y, z
