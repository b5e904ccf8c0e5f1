"""Shape of the needle at the target if the rest of the plan is carried out from the estimated state."""

import numpy as np

from flexneedle.control.interface import travel_left
from flexneedle.control.mpc import steps_to_planned_base
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import controls
from flexneedle.types import DB_Y, DG_Y, ROLL, Floats, Shape, X


def predict_planned_shape(task: Task, estimate: Estimate) -> Shape | None:
    """Return the shape at the target, for controllers that predict none; None if its simulation does not converge.

    The guide moves, and the needle rolls, as planned at the same depths of the tip; the base moves to its planned pose.
    """
    rows = remaining_controls(task, estimate)
    predicted = estimate.simulator.rollout(
        estimate.state, rows[None], limits=False, rough=True, at_end=("shapes",)
    )
    if not predicted.converged.all():
        return None
    nodes = predicted.shapes[0, -1]
    return Shape(nodes, estimate.shape_sd(nodes))


def remaining_controls(task: Task, estimate: Estimate) -> Floats:
    """Return controls (m, 9), m ≥ 1, from the estimated tip to the target's depth as planned; at rest at its end."""
    plan, setup, state = task.plan, task.scenario.setup, estimate.state
    left, x = travel_left(task.scenario, plan, state), float(state.tip[X])
    count = max(1, int(np.ceil(left / setup.max_advance_mm - 1e-9)))
    depth = x + np.linspace(0.0, left, count + 1)
    rows = controls(count, db_x=np.diff(depth))
    if left <= 0.0:
        return rows
    for axis in range(setup.moved_guide_axes):
        rows[:, DG_Y + axis] = np.diff(np.interp(depth, plan.tips[:, X], plan.guide[:, axis]))
    rows[:, DB_Y:DG_Y] = steps_to_planned_base(setup, plan, state, depth[1:])
    rolls = plan.controls[:, ROLL]
    before = np.searchsorted(depth, plan.tips[:-1, X], side="right") - 1
    ahead = (rolls != 0.0) & (before >= 0) & (before < count)
    np.add.at(rows[:, ROLL], before[ahead], rolls[ahead])
    return rows
