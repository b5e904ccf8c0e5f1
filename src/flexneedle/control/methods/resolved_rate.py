"""`resolved-rate`: the guide moves by the damped inverse of the model's Jacobian.

Steering from the base with the Jacobian of a mechanical model of needle and tissue: DiMaio and Salcudean, Needle
insertion modeling and simulation (IEEE Trans. Robot. Autom. 2003) and Needle steering and motion planning in soft
tissues (IEEE Trans. Biomed. Eng. 2005); Glozman and Shoham, Image-guided robotic flexible needle steering (IEEE
Trans. Robot. 2007). Here the Jacobian is that of the tip's position a little ahead, by a small disturbance of the
guide, and the plan gives the nominal motion of the guide. The newest innovation is
taken as constant; otherwise the model, released from the measured tip, would return to its own equilibrium. The
advance needs no Jacobian: the tip's depth follows the base one to one.
"""

import math

import numpy as np

from flexneedle.control import bang_bang
from flexneedle.control.interface import Decision, Method, travel_left
from flexneedle.control.mpc import planned_base
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Positive
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import Floats, Plan

_DISTURBANCE_MM = 0.05  # of the guide: above rounding, small against the 10 mm over which the tissue stiffens


class ResolvedRate(bang_bang.BevelRule):
    """Section `control.resolved_rate`: the guide follows the damped inverse of the model's Jacobian."""

    curvature_per_m: NonNegative = 0.0834
    """κ, curvature of the two paths of the bang-bang rule."""
    flip_dead_band: Fraction = 0.625
    """Dead band of the rule: a miss below half of the two paths' separation times 1 + this does not roll the bevel."""
    gain: NonNegative = 1.38
    """Share of the tip's predicted deviation that a control step corrects."""
    damping: NonNegative = 0.0533
    """λ of the damped least squares, in the unit of the Jacobian: lateral motion of the tip per that of the guide."""
    lookahead_mm: Positive = 10.0
    """Distance ahead of the tip at which its deviation is predicted, at most to the target depth."""


def decide(task: Task, memory: None, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, None]:
    """Bevel by the rule; the planned guide step plus a correction of the tip to the planned path."""
    scenario, state = task.scenario, estimate.state
    settings, setup = task.settings, scenario.setup
    left = travel_left(scenario, task.plan, state)
    flip, why = bang_bang.decide(task, estimate, settings)
    if left <= 0.0:
        return Decision((0.0, 0.0, 0.0, 0.0, -1), "at the target depth"), memory
    disturbance = min(_DISTURBANCE_MM, 0.5 * setup.max_guide_step_mm, 0.5 * setup.max_guide_travel_mm)
    travel = min(left, max(setup.max_advance_mm, settings.lookahead_mm))
    controls = nominal(setup, task.plan, state, travel, disturbance, flip=flip)
    end, jacobian = sensitivity(estimate.simulator, state, controls, disturbance)
    off = planned_y(task.plan, float(end[0])) - float(end[1]) - estimate.innovation[1]
    wanted = float(controls[0, 3]) + settings.gain * damped_inverse(jacobian, settings.damping) * off
    step = max(-setup.max_guide_step_mm, min(setup.max_guide_step_mm, wanted))
    guide = max(-setup.max_guide_travel_mm, min(setup.max_guide_travel_mm, state.guide + step))
    db_x, db_y, db_theta = controls[0, :3].tolist()
    command = (db_x, db_y, db_theta, guide - state.guide, 1 if flip else -1)
    why = f"{why}; predicted deviation of the tip {-off:.3f} mm, {jacobian:.3f} mm per mm of the guide"
    return Decision(command, why), memory


def nominal(setup: Setup, plan: Plan, state: State, travel: float, margin: float, *, flip: bool) -> Floats:
    """Controls (n, 5) that insert by `travel` (mm) as planned, the guide `margin` (mm) inside its limits."""
    count = max(1, math.ceil(travel / setup.max_advance_mm - 1e-9))
    ends = np.minimum(setup.max_advance_mm * np.arange(1, count + 1), travel)
    depth = float(state.tip[0]) + np.append(0.0, ends)
    steps = np.diff(np.interp(depth, plan.tips[:, 0], plan.guide))
    limit, reach = setup.max_guide_step_mm - margin, setup.max_guide_travel_mm - margin
    guide = np.clip(state.guide + np.cumsum(np.clip(steps, -limit, limit)), -reach, reach)
    controls = np.zeros((count, 5))
    controls[:, 0] = np.diff(ends, prepend=0.0)
    controls[:, 1:3] = planned_base(setup, plan, state, depth[1:])
    controls[:, 3] = np.diff(guide, prepend=state.guide)
    controls[:, 4] = -1.0
    controls[0, 4] = 1.0 if flip else -1.0
    return controls


def sensitivity(
    simulator: Simulator, state: State, controls: Floats, disturbance: float
) -> tuple[Floats, float]:
    """Tip pose (3,) after `controls`, and its lateral motion for that of the guide in their first step."""
    three = np.stack([controls] * 3)
    three[1:, 0, 3] += disturbance, -disturbance
    end, more, less = simulator.rollout(state, three).tips[:, -1]
    return end, float(more[1] - less[1]) / (2.0 * disturbance)


def planned_y(plan: Plan, x: float) -> float:
    """Lateral position (mm) of the planned path at depth x, with the target as its end."""
    depth, lateral = plan.tips[:-1, 0], plan.tips[:-1, 1]
    return float(np.interp(x, np.append(depth, plan.target[0]), np.append(lateral, plan.target[1])))


def damped_inverse(jacobian: float, damping: float) -> float:
    """J/(J² + λ²), which minimises (J u − 1)² + λ² u²; 0 where both are 0."""
    return jacobian / (jacobian**2 + damping**2) if jacobian or damping else 0.0


METHOD = Method(
    "resolved-rate",
    "guide by the damped inverse of the model's Jacobian, bevel by the rule",
    StateCorrection(),
    begin=lambda _task: None,
    decide=decide,
    settings=ResolvedRate,
    needs_guide=True,
)
