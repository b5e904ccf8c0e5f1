"""`bevel-only`: bang-bang steering by the bevel (paper eq. 14 and 15); neither guide nor base moves aside."""

import numpy as np

from flexneedle.control import bang_bang
from flexneedle.control.estimate import Estimate
from flexneedle.control.interface import Decision, Method, Task, travel_left
from flexneedle.control.observer import Beliefs
from flexneedle.scenario.methods import BevelRule

_SURE = 3.0  # standard deviations of a reading: no bevel turn for less


def turn(rule: BevelRule, task: Task, estimate: Estimate) -> tuple[bool, str]:
    """Whether to turn the bevel over by the bang-bang rule with the settings of `rule`, and why."""
    if estimate.tip[0] <= 0.0:
        return False, "in air"
    noise = _SURE * task.scenario.tracker.jitter_per_axis
    bevel, target = estimate.state.bevel, task.plan.target
    return bang_bang.wants_flip(estimate.tip, bevel, rule.curvature, target, rule.flip_dead_band, noise)


def decide(task: Task, memory: None, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, None]:
    """Advance as far as a step goes, with the bevel towards the target."""
    scenario = task.scenario
    advance = min(scenario.setup.max_advance_mm, travel_left(scenario, task.plan, estimate.state))
    flip, why = turn(scenario.control.bevel_only, task, estimate)
    return Decision((advance, 0.0, 0.0, 0.0, 1 if flip else -1), why), memory


METHOD = Method(
    "bevel-only",
    "bang-bang steering by the bevel, without guide motion",
    Beliefs(),
    begin=lambda _task: None,
    decide=decide,
)
