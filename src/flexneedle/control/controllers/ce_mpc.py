"""`ce-mpc`: the paper's controller: bang-bang bevel, cross-entropy MPC of advance and guide (eq. 13 to 15).

The measured tip is an essential condition of the solve that assimilates it, and is released in the prediction. The rule
has the error threshold that the paper proposes against needless rolls; the cost of eq. 13 has small further terms for
the guide's departure from the plan and for tissue energy; a weight of 0 omits them.
"""

import numpy as np

from flexneedle.control import bang_bang, mpc
from flexneedle.control.interface import Controller, Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task


def decide(task: Task, memory: None, estimate: Estimate, rng: np.random.Generator) -> tuple[Decision, None]:
    """Bevel by the rule, then the best first step of a short horizon along the plan."""
    roll, why = bang_bang.decide_roll(task, estimate, task.settings)
    model, state, settings = estimate.simulator, estimate.state, task.settings
    return mpc.choose_step(model, task.plan, state, settings, roll=roll, rng=rng, why=why), memory


CONTROLLER = Controller(
    "ce-mpc",
    "the paper's: the measured tip is released in the prediction",
    StateCorrection(fits_start=False, estimates_load=False),
    decide=decide,
    settings=mpc.CeMpc,
    avoids_zones=True,
)
