"""The reach: smallest miss of an insertion that any controller could achieve (docs/worlds.md)."""

import math

import numpy as np

from flexneedle.control.guide import guide_may_move
from flexneedle.planning.planner import plan
from flexneedle.rig.parts import plant_of
from flexneedle.rig.phantom.draw import Truth, draw
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PlantFactory
from flexneedle.scenario.model import Scenario

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


def reach(
    scenario: Scenario,
    seed: int,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    strategy: str = "manipulation",
) -> float:
    """Return the smallest miss (mm) of an ideal controller in the insertion of a seed, to about 0.5 mm.

    strategy: strategy of the plans, "manipulation" or "steering". If guide or base may move: the miss of the best plan
    of a search with up to 4000 rollouts on the model with the phantom's true parameters. Otherwise: distance from the
    target to the interval between the end points of the plant inserted with the bevel on either side; by continuity
    all points between them can be reached. NaN if the plant does not converge.
    """
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0]))
    base_moves = scenario.plan.base_sigma_mm > 0.0 or scenario.plan.base_turn_sigma > 0.0
    if guide_may_move(scenario.setup, strategy) or base_moves:
        return plan(truth.scenario.with_values(_SEARCH), threads=1).error_mm
    depth, lateral = scenario.target.position
    ends = [straight_end(truth, bevel, plant_of(phantom)[1], depth) for bevel in (-1, 1)]
    low, high = sorted(y for _, y in ends)
    short = max(depth - x for x, _ in ends)
    return math.hypot(short, max(0.0, low - lateral, lateral - high))


def straight_end(truth: Truth, bevel: int, phantom: str | PlantFactory, depth: float) -> tuple[float, float]:
    """Return the tip (x, y) in mm of a plant inserted to a depth, or to full stroke, without moving base or bevel.

    NaN if the plant does not converge.
    """
    setup = truth.scenario.setup
    specimen = Phantom(truth, bevel, phantom)
    before = after = specimen.condition()
    moved = 0.0
    while after.tip[0] < depth and moved < setup.stroke_mm:
        step = min(setup.max_advance_mm, setup.stroke_mm - moved)
        specimen.apply((step, 0.0, 0.0, 0.0, -1), step / setup.insertion_speed_mm_s)
        moved += step
        before, after = after, specimen.condition()
    if not after.converged:
        return math.nan, math.nan
    x = min(depth, float(after.tip[0]))
    return x, float(np.interp(x, (before.tip[0], after.tip[0]), (before.tip[1], after.tip[1])))
