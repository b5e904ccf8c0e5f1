"""Half a turn in air, which separates a constant error of the tracker from the run-out: only the run-out turns."""

import math

from flexneedle.control.interface import Decision
from flexneedle.estimation.identification import Identified
from flexneedle.estimation.task import Task
from flexneedle.types import DB_X, STILL, X

_THERE, DONE = 1, 3  # steps; back between them
_READINGS = 20  # at each end
_REACHED = math.radians(10.0)  # wider than what drivers allow
_SURE = 3.0  # standard deviations by which the tip is in air


def may_turn(task: Task, fitted: Identified) -> bool:
    """Return if half a turn would show an error of the tracker: where it is a parameter, before the needle advances."""
    axial = math.sqrt(fitted.tip_covariance[0, 0])
    in_air = float(fitted.tips[-1, X]) + _SURE * axial < 0.0 and float(fitted.state.travel[DB_X]) == 0.0
    return bool(fitted.slots.bias.stop) and task.scenario.tracker.enabled and in_air


def turn_in_air(task: Task, step: int, roll: float) -> tuple[Decision, int]:
    """Return the next decision of half a turn there and back, with a rest at either end, and the step after it.

    A turn that was not carried out is repeated. step: 0 at the start, `DONE` at the end; roll: the angle now (rad).
    """
    first, most, step = task.plan.roll, task.scenario.setup.max_rotation, step or _THERE
    there = math.copysign(min(math.pi, most + abs(first)), -first)
    left = first + (there if step == _THERE else 0.0) - roll
    why = "half a turn in air, for the error of the tracker"
    if abs(math.remainder(left, 2.0 * math.pi)) > _REACHED:
        return Decision(STILL._replace(roll=left), why), step
    return Decision(STILL, why, rest=_READINGS * task.scenario.tracker.period), step + 1
