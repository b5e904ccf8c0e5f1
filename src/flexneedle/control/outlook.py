"""What the controller expects of the end: how uncertain the miss is that its model predicts.

The estimate's parameters are normal with the covariance that the readings leave. Readings to come will narrow them, and the
path will be corrected, until the tip is so near the target that no correction takes effect: the standard deviation of the
miss is that of the parameters then, through the derivative of the tip's lateral position at the target, and what no
parameter explains. Readings to come count by their place alone, as in any linear least squares.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.control.identification import RUN_OUT, Identified

__all__ = ["Outlook"]

Floats = NDArray[np.float64]
_ = 0


@dataclass(frozen=True, eq=False)
class Outlook:
    """Derivatives curves (K, g) of the tip's lateral position ahead with respect to the parameters, over depth grid (g,).

    A few of them are simulated anew each period, along the path in hand (`Identified.perturbed`).
    """

    grid: Floats
    curves: Floats

    @staticmethod
    def of(estimate: Identified) -> "Outlook":
        """Nothing known of what is ahead."""
        return Outlook(estimate.grid, estimate.curves)

    def renewed(self, estimate: Identified, controls: Floats, tips: Floats) -> "Outlook":
        """With the derivatives of the parameters that the estimate has just perturbed, along controls (m, 5) → tips (m, 3)."""
        curves = self.curves.copy()
        side = estimate.state.bevel * np.cumprod(-np.sign(controls[:, 4]))
        depth = np.maximum.accumulate(tips[:, 0])
        for one in estimate.perturbed:
            moved = one.simulator.rollout(one.state, controls[None], limits=False).tips[0]
            curves[one.parameter] = np.interp(self.grid, depth, (moved[:, 1] - tips[:, 1]) / one.step)
        curves[RUN_OUT] = np.interp(self.grid, depth, side)
        return replace(self, curves=curves)

    def sd(self, estimate: Identified, target: float, blind: float) -> float:
        """Standard deviation (mm) of the miss at the depth `target`, readings counting up to `blind` mm before it."""
        begin = float(estimate.state.tip[0])
        to_come = (self.grid > begin) & (self.grid <= target - blind)
        slopes = self.curves[:, to_come]
        precision = estimate.precision + slopes @ slopes.T / estimate.reading_variance
        end = np.array([np.interp(target, self.grid, curve) for curve in self.curves])
        return float(np.sqrt(end @ np.linalg.solve(precision, end)))
