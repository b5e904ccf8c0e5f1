"""`bevel-only`: bang-bang steering by the bevel (paper eq. 14 and 15); neither guide nor base moves aside."""

import numpy as np

from flexneedle.control import bang_bang
from flexneedle.control.interface import Decision, Method, travel_left
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task


class BevelOnly(bang_bang.BevelRule):
    """Section `control.bevel_only`: the bevel alone steers."""


def decide(task: Task, memory: None, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, None]:
    """Advance as far as a step goes, with the bevel towards the target."""
    scenario = task.scenario
    advance = min(scenario.setup.max_advance_mm, travel_left(scenario, task.plan, estimate.state))
    flip, why = bang_bang.decide(task, estimate, task.settings)
    return Decision((advance, 0.0, 0.0, 0.0, 1 if flip else -1), why), memory


METHOD = Method(
    "bevel-only",
    "bang-bang steering by the bevel, without guide motion",
    StateCorrection(),
    begin=lambda _task: None,
    decide=decide,
    settings=BevelOnly,
)
