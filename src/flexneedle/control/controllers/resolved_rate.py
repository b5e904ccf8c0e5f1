"""`resolved-rate`: the guide moves by the damped inverse of the model's Jacobian.

Steering from the base with the Jacobian of a mechanical model of needle and tissue: DiMaio and Salcudean, Needle
insertion modeling and simulation (IEEE Trans. Robot. Autom. 2003) and Needle steering and motion planning in soft
tissues (IEEE Trans. Biomed. Eng. 2005); Glozman and Shoham, Image-guided robotic flexible needle steering (IEEE Trans.
Robot. 2007). Here the Jacobian is taken for the tip's position a little ahead, by a small disturbance of the guide, and
the plan gives the nominal motion of the guide. The newest innovation is taken as constant; otherwise the model,
released from the measured tip, would return to its own equilibrium. The advance needs no Jacobian: the tip's depth
follows the base one to one.
"""

import math

import numpy as np

from flexneedle.control import bang_bang
from flexneedle.control.interface import Controller, Decision, travel_left
from flexneedle.control.limits import guide_reach
from flexneedle.control.mpc import planned_offset, steps_to_planned_base
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Positive
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_Y, DG_Y, ROLL, STILL, Control, Floats, X, Y, Z

_DISTURBANCE_MM = 0.05  # of the guide: above rounding, small against the 10 mm over which the tissue stiffens


class ResolvedRate(bang_bang.BevelRule):
    """Section `control.resolved_rate`: the guide follows the damped inverse of the model's Jacobian."""

    curvature_per_m: NonNegative = 0.0834
    """κ, curvature of the rule's two paths."""
    flip_dead_band: Fraction = 0.625
    """As `control.bevel_only.flip_dead_band`."""
    gain: NonNegative = 1.38
    """Share of the tip's predicted deviation that a step corrects."""
    damping: NonNegative = 0.0533
    """λ of the damped least squares, in the unit of the Jacobian."""
    lookahead_mm: Positive = 10.0
    """Distance ahead of the tip at which its deviation is predicted."""


def decide(task: Task, memory: None, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, None]:
    """Bevel by the rule; the planned guide step plus a correction of the tip to the planned path."""
    scenario, state = task.scenario, estimate.state
    settings, setup = task.settings, scenario.setup
    left = travel_left(scenario, task.plan, state)
    roll, why = bang_bang.decide_roll(task, estimate, settings)
    if left <= 0.0:
        return Decision(STILL, "at the target depth"), memory
    disturbance = min(_DISTURBANCE_MM, 0.5 * setup.max_guide_step_mm, 0.5 * setup.max_guide_travel_mm)
    travel = min(left, max(setup.max_advance_mm, settings.lookahead_mm))
    rows = nominal_controls(scenario, task.plan, state, travel, disturbance, roll)
    end, jacobian = guide_jacobian(estimate.simulator, state, rows, disturbance, setup.moved_guide_axes)
    off = planned_offset(task.plan, float(end[X])) - end[Y : Z + 1] - estimate.innovation[1:]
    moved = slice(DG_Y, DG_Y + setup.moved_guide_axes)
    wanted = rows[0, moved] + settings.gain * solve_damped(jacobian, off, settings.damping)
    step = np.clip(wanted, -setup.max_guide_step_mm, setup.max_guide_step_mm)
    place = np.array(state.guide[: len(step)])
    least, greatest = np.transpose([guide_reach(scenario, axis) for axis in range(len(step))])
    rows[0, moved] = np.clip(place + step, least, greatest) - place
    away, follows = ", ".join(f"{-value:.3f}" for value in off[: setup.axes]), float(jacobian[0, 0])
    why = f"{why}; predicted deviation of the tip {away} mm, {follows:.3f} mm per mm of the guide"
    return Decision(Control.of(rows[0].tolist()), why), memory


def nominal_controls(
    scenario: Scenario, plan: Plan, state: State, travel: float, margin: float, roll: float
) -> Floats:
    """Return controls (n, 9) that insert by `travel` (mm) as planned, the guide `margin` (mm) inside its limits.

    roll: roll in the first step (rad).
    """
    setup = scenario.setup
    count = max(1, math.ceil(travel / setup.max_advance_mm - 1e-9))
    ends = np.minimum(setup.max_advance_mm * np.arange(1, count + 1), travel)
    depth = float(state.tip[X]) + np.append(0.0, ends)
    limit = setup.max_guide_step_mm - margin
    rows = controls(count, db_x=np.diff(ends, prepend=0.0))
    for axis in range(setup.moved_guide_axes):
        steps, place = np.diff(np.interp(depth, plan.tips[:, X], plan.guide[:, axis])), state.guide[axis]
        least, greatest = guide_reach(scenario, axis)
        wanted = place + np.cumsum(np.clip(steps, -limit, limit))
        guide = np.clip(wanted, least + margin, greatest - margin)
        rows[:, DG_Y + axis] = np.diff(guide, prepend=place)
    rows[:, DB_Y:DG_Y] = steps_to_planned_base(setup, plan, state, depth[1:])
    rows[0, ROLL] = roll
    return rows


def guide_jacobian(
    simulator: Simulator, state: State, rows: Floats, disturbance: float, axes: int = 1
) -> tuple[Floats, Floats]:
    """Return the tip pose (5,) after controls `rows` (n, 9), and its Jacobian (2, axes) for the guide's first step.

    The Jacobian is the lateral motion y, z of the tip for the motion of the guide on each axis.
    """
    tried = np.stack([rows] * (1 + 2 * axes))
    for axis in range(axes):
        tried[1 + 2 * axis : 3 + 2 * axis, 0, DG_Y + axis] += disturbance, -disturbance
    end, *moved = simulator.rollout(state, tried).tips[:, -1]
    across = np.array(moved)[:, Y : Z + 1]
    return end, (across[::2] - across[1::2]).T / (2.0 * disturbance)


def solve_damped(jacobian: Floats, off: Floats, damping: float) -> Floats:
    """Return the u that minimises ‖J u − off‖² + λ² ‖u‖²."""
    axes = jacobian.shape[1]
    matrix, right = np.vstack([jacobian, damping * np.eye(axes)]), np.append(off, np.zeros(axes))
    return np.asarray(np.linalg.lstsq(matrix, right)[0], dtype=float)


CONTROLLER = Controller(
    "resolved-rate",
    "guide by the damped inverse of the model's Jacobian, bevel by the rule",
    StateCorrection(),
    decide=decide,
    settings=ResolvedRate,
    needs_guide=True,
)
