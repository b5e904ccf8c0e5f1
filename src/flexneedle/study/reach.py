"""How near to its target an insertion could come, whatever the controller (docs/worlds.md)."""

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
"""At most 4000 rollouts, 14 times those of the longest decision of the default controller, for the miss alone."""


def reach(
    scenario: Scenario,
    seed: int,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    strategy: str = "manipulation",
) -> float:
    """Return the miss (mm) that an ideal controller is left with in the insertion of a seed, to about 0.5 mm.

    strategy: of the plans, "manipulation" or "steering". Where guide or base may move: of the best that a search with
    up to 4000 rollouts finds on the model with the phantom's true parameters. Where neither may: the distance from the
    target to the interval between the ends of the plant inserted with its bevel always on one side and on the other; by
    continuity all between them can be hit. NaN if the plant does not converge.
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
    """Return the tip (x, y) in mm of a plant inserted to a depth, base and bevel as they are, or at full stroke.

    NaN if the plant does not converge.
    """
    setup = truth.scenario.setup
    tank = Phantom(truth, bevel, phantom)
    before = after = tank.condition()
    moved = 0.0
    while after.tip[0] < depth and moved < setup.stroke_mm:
        step = min(setup.max_advance_mm, setup.stroke_mm - moved)
        tank.apply((step, 0.0, 0.0, 0.0, -1), step / setup.insertion_speed_mm_s)
        moved += step
        before, after = after, tank.condition()
    if not after.converged:
        return math.nan, math.nan
    x = min(depth, float(after.tip[0]))
    return x, float(np.interp(x, (before.tip[0], after.tip[0]), (before.tip[1], after.tip[1])))
