"""The reach: smallest miss of an insertion that any controller could achieve (docs/worlds.md)."""

import math
from collections.abc import Sequence

import numpy as np

from flexneedle.control.guide import guide_may_move
from flexneedle.planning.planner import plan
from flexneedle.rig.parts import plant_of
from flexneedle.rig.phantom.draw import Truth, draw
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PlantFactory
from flexneedle.scenario.model import Scenario
from flexneedle.types import Control, Point, X, Y, Z

_SEARCH = {
    "plan.samples": 160,
    "plan.iterations": 25,
    "plan.max_iterations": 25,
    "plan.energy_weight_per_mj": 0.0,
    "plan.deflection_weight": 0.0,
    "plan.guide_weight": 0.0,
    "plan.flip_weight": 0.0,
}
"""Search for the smallest miss: up to 4000 rollouts, 14 times the longest decision of the default controller."""
_DIRECTIONS = tuple(2.0 * math.pi * k / 6 for k in range(6))


def reach(
    scenario: Scenario,
    seed: int,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    strategy: str = "manipulation",
) -> float:
    """Return the smallest miss (mm) of an ideal controller in the insertion of a seed, to about 0.5 mm.

    strategy: strategy of the plans, "manipulation" or "steering". If guide or base may move: the miss of the best plan
    of a search with up to 4000 rollouts on the model with the phantom's true parameters. Otherwise: with half turns,
    distance from the target to the interval between the end points of the plant inserted with the bevel on either side;
    by continuity all points between them can be reached. With rolls to any angle, distance to the disc around the mean
    of the end points of constant directions, with their mean distance from it as its radius. NaN if the plant does not
    converge.
    """
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0]))
    base_moves = scenario.plan.base_sigma_mm > 0.0 or scenario.plan.base_turn_sigma > 0.0
    if guide_may_move(scenario.setup, strategy) or base_moves:
        return plan(truth.scenario.with_values(_SEARCH), threads=1).error_mm
    depth, *lateral = scenario.target.position
    rolls = (math.pi, 0.0) if scenario.setup.half_turns else _DIRECTIONS
    ends = [straight_end(truth, roll, plant_of(phantom)[1], depth) for roll in rolls]
    if any(math.isnan(x) for x, *_ in ends):
        return math.nan
    short, places = max(depth - x for x, *_ in ends), [complex(y, z) for _, y, z in ends]
    beyond = to_interval if scenario.setup.half_turns else to_disc
    return math.hypot(short, *beyond(complex(*lateral), places))


def to_interval(target: complex, ends: Sequence[complex]) -> tuple[float, float]:
    """Return how far a target is from the interval between two ends y + iz (mm): along it, and across it."""
    first, last = sorted(ends, key=lambda end: end.real)
    along = (last - first) / abs(last - first) if last != first else 1.0
    low, place, high = ((at * along.conjugate()).real for at in (first, target, last))
    return max(0.0, low - place, place - high), ((target - first) * along.conjugate()).imag


def to_disc(target: complex, ends: Sequence[complex]) -> tuple[float]:
    """Return the distance (mm) of a target y + iz from the disc around the mean of the ends."""
    middle = sum(ends) / len(ends)
    radius = sum(abs(end - middle) for end in ends) / len(ends)
    return (max(0.0, abs(target - middle) - radius),)


def straight_end(truth: Truth, roll: float, phantom: str | PlantFactory, depth: float) -> Point:
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
