"""A plant without mechanics: the tip cuts a circle, as in kinematic models of needle steering."""

import numpy as np

from flexneedle import Control


class Unicycle:
    """The tip as a unicycle (Webster et al. 2006, doi:10.1177/0278364906065388), displaced by the guide."""

    strain_energy, least_stretch, converged = 0.0, 1.0, True  # mJ; 1 is unloaded tissue

    def __init__(self, truth, roll):
        self.curvature = 1e-4 * truth.scenario.needle.bevel.offset_mm  # 1/mm
        self.roll = roll
        self.tip = np.array([truth.scenario.setup.start_tip_x, truth.base_y, 0.0, truth.base_turn, 0.0])

    def step(self, row):
        """Roll, then move."""
        move = Control.of(row)
        self.roll += move.roll
        x, y, _, slope, _ = self.tip
        cut = move.db_x if x > 0.0 else 0.0
        held = np.exp(-max(0.0, x) / 30.0)  # effect of the guide on the tip, by depth
        slope += move.db_theta + 0.01 * move.dg_y * held + self.curvature * np.cos(self.roll) * cut
        x, y = x + move.db_x * np.cos(slope), y + move.db_x * np.sin(slope)
        self.tip = np.array([x, y + move.db_y + 1.5 * move.dg_y * held, 0.0, slope, 0.0])
