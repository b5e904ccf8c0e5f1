"""What the controller expects of the end: how uncertain the miss is that its model predicts.

The estimate's parameters are normal, with the covariance P that the readings leave. Readings to come narrow them to P',
and the path is corrected meanwhile, until the tip is so near the target that a correction takes no effect. With c, the
derivative of the tip's lateral position at the target, the variance of the miss is

    c P' c + σ² + (κ l)² + min(m², c P c)

σ is what no parameter explains of a reading, κ l of a path of length l that is left. The last term is for a miss m that
is predicted although a path without one was searched for: where the needle is at the limit of what it can do, what
later readings show cannot be corrected either.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexneedle.estimation.identification import Identified
from flexneedle.estimation.prior import RUN_OUT
from flexneedle.types import Floats

UNCORRECTED = 5.0
"""Control steps before the target in which a correction takes no effect."""
_UNEXPLAINED = 1.0  # standard deviations of the mean of a control step's readings
_DRIFT = 0.0008  # mm per mm of path


@dataclass(frozen=True, eq=False)
class Outlook:
    """Derivatives (K, g) of the tip's lateral position ahead with respect to the parameters, over the depth grid (g,).

    A few of them are simulated anew each period, along the path in hand (`Identified.perturbed`).
    """

    grid: Floats
    curves: Floats

    @staticmethod
    def of(estimate: Identified) -> "Outlook":
        """Before the first path: as far ahead as the estimate itself needs them."""
        return Outlook(estimate.grid, estimate.curves)

    def renewed(self, estimate: Identified, controls: Floats, tips: Floats) -> "Outlook":
        """With the derivatives of the parameters that the estimate has just perturbed, along controls (m, 5).

        tips (m, 3): as these controls lead them, by the tracker.
        """
        curves = self.curves.copy()
        side = estimate.state.bevel * np.cumprod(-np.sign(controls[:, 4]))
        lateral = tips[:, 1] - estimate.run_out * side - estimate.residual  # of the needle's axis
        depth = np.maximum.accumulate(tips[:, 0])
        for one in estimate.perturbed:
            moved = one.simulator.rollout(one.state, controls[None], limits=False).tips[0]
            curves[one.parameter] = np.interp(self.grid, depth, (moved[:, 1] - lateral) / one.step)
        curves[RUN_OUT] = np.interp(self.grid, depth, side)
        return replace(self, curves=curves)

    def sd(self, estimate: Identified, target: float, miss: float) -> float:
        """Standard deviation (mm) of the miss at the depth `target` (mm), where `miss` is predicted (mm)."""
        step = estimate.nominal.scenario.setup.max_advance_mm
        end = np.array([np.interp(target, self.grid, curve) for curve in self.curves])
        to_come = (self.grid > estimate.state.tip[0]) & (self.grid <= target - UNCORRECTED * step)
        slopes = self.curves[:, to_come]
        then = estimate.precision + slopes @ slopes.T / estimate.reading_variance
        known = end @ np.linalg.solve(then, end) + _UNEXPLAINED**2 * estimate.reading_variance
        known += (_DRIFT * (target - float(estimate.state.tip[0]))) ** 2
        return float(np.sqrt(float(known) + min(miss**2, self.sd_now(estimate, target) ** 2)))

    def sd_now(self, estimate: Identified, target: float) -> float:
        """Standard deviation (mm) of the tip's lateral position at the depth `target` (mm), if nothing is corrected."""
        end = np.array([np.interp(target, self.grid, curve) for curve in self.curves])
        return float(np.sqrt(end @ np.linalg.solve(estimate.precision, end)))
