"""One period of the closed loop: the bevel by the bang-bang rule, advance and guide by cross-entropy MPC."""

from dataclasses import dataclass

import numpy as np

from flexneedle.control import bang_bang, mpc
from flexneedle.control.observer import Estimate
from flexneedle.ports import Command
from flexneedle.scenario import Scenario
from flexneedle.simulator import Simulator
from flexneedle.trace import PlanRecord

_SURE = 3.0  # standard deviations of a reading: no bevel turn for less


@dataclass(frozen=True)
class Decision:
    """A command, why, its predicted cost, and the standard deviation left in the guide step (mm)."""

    command: Command
    why: str
    cost: float
    spread: float


def decide(simulator: Simulator, plan: PlanRecord, estimate: Estimate, rng: np.random.Generator) -> Decision:
    """Choose the next command towards the plan's target. In air the bevel has no effect and stays."""
    control = simulator.scenario.control
    flip, why = False, "in air"
    if estimate.tip[0] > 0.0:
        flip, why = bang_bang.wants_flip(
            estimate.tip,
            estimate.state.bevel,
            control.curvature,
            plan.target,
            control.flip_dead_band,
            _SURE * simulator.scenario.tracker.jitter_per_axis,
        )
    choice = mpc.choose(simulator, plan, estimate.state, flip=flip, rng=rng)
    return Decision((*choice.steps, 1 if flip else -1), why, choice.cost, choice.spread)


def arrived(scenario: Scenario, plan: PlanRecord, estimate: Estimate) -> bool:
    """Whether the believed tip is at the target depth, within the tolerance, or past it, or the stroke is used up."""
    return mpc.travel_left(scenario, plan, estimate.state) <= scenario.control.depth_tolerance_mm
