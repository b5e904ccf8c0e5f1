"""`bevel-only`: bang-bang steering by the bevel (paper eq. 14 and 15), without lateral motion of guide or base."""

import numpy as np

from flexneedle.control import bang_bang
from flexneedle.control.interface import Controller, Decision, travel_left
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.types import Control


class BevelOnly(bang_bang.BevelRule):
    """Section `control.bevel_only`: bang-bang rule of the bevel, the only input that steers."""


def decide(task: Task, memory: None, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, None]:
    """Advance by the largest step, with the bevel towards the target."""
    scenario = task.scenario
    advance = min(scenario.setup.max_advance_mm, travel_left(scenario, task.plan, estimate.state))
    roll, why = bang_bang.decide_roll(task, estimate, task.settings)
    return Decision(Control(db_x=advance, roll=roll), why), memory


CONTROLLER = Controller(
    "bevel-only",
    "bang-bang steering by the bevel, without guide motion",
    StateCorrection(),
    decide=decide,
    settings=BevelOnly,
)
