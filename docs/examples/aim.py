"""Move the guide so that the line of the tip passes through the target."""

import numpy as np

from flexneedle import Control, Controller, Decision, Section, travel_left


class Settings(Section):
    """Section `control.aim`."""

    gain: float = 0.2
    """Step of the guide per miss of the tip's line (mm/mm)."""


def decide(task, memory, estimate, rng):
    """Advance by a full step and move the guide in proportion to the miss."""
    setup, guide = task.scenario.setup, estimate.state.guide[0]
    x, y, _, slope, _ = estimate.tip
    depth, lateral, _ = task.plan.target
    miss = lateral - (y + slope * (depth - x))
    step = np.clip(task.settings.gain * miss, -setup.max_guide_step_mm, setup.max_guide_step_mm)
    step = np.clip(guide + step, -setup.max_guide_travel_mm, setup.max_guide_travel_mm) - guide
    advance = min(setup.max_advance_mm, travel_left(task.scenario, task.plan, estimate.state))
    return Decision(Control(db_x=advance, dg_y=step), f"line misses by {miss:+.3f} mm"), memory


CONTROLLER = Controller(
    "aim",
    "the guide in proportion to the miss of the tip's line",
    begin=lambda task: None,
    decide=decide,
    settings=Settings,
    needs_guide=True,
)
