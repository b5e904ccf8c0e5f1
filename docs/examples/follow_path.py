"""Follow the planned path of the guide, corrected for the tip's deviation."""

import numpy as np

from flexneedle import ROLL, Control, Controller, Decision, Section, X, Y, travel_left


class Settings(Section):
    """Section `control.follow_path`."""

    gain: float = 0.8
    """Correction of the guide per deviation of the tip (mm/mm)."""


def decide(task, rolls, estimate, rng):
    """Advance by a full step; move guide and bevel as planned, and correct the guide."""
    setup, plan = task.scenario.setup, task.plan
    advance = min(setup.max_advance_mm, travel_left(task.scenario, plan, estimate.state))
    x, depth = estimate.tip[X], plan.tips[:, X]
    off = estimate.tip[Y] - np.interp(x, depth, plan.tips[:, Y])
    wanted = np.interp(x + advance, depth, plan.guide[:, 0]) - task.settings.gain * off
    reach = np.clip(wanted, -setup.max_guide_travel_mm, setup.max_guide_travel_mm)
    step = np.clip(reach - estimate.state.guide[0], -setup.max_guide_step_mm, setup.max_guide_step_mm)
    due = np.sum(depth[:-1][plan.controls[:, ROLL] != 0.0] <= x)
    command = Control(db_x=advance, dg_y=step, flip=due > rolls)
    return Decision(command, f"tip {off:+.3f} mm off the path"), rolls + command.rolls


CONTROLLER = Controller(
    "follow-path",
    "the plan, corrected",
    begin=lambda task: 0,
    decide=decide,
    settings=Settings,
    needs_guide=True,  # refused without one, and for plans that do not move it
)
