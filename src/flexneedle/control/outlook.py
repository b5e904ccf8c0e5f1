"""Uncertainty of the miss at the target that a controller's model predicts.

The estimate's parameters are normal, with the posterior covariance P. Readings to come reduce it to P',
and the path is corrected by them, until the tip is so near the target that a correction takes no effect. With c, the
derivative of the tip's lateral position at the target with respect to the parameters, the variance of the miss is

    c P' c + σ² + (κ l)² + min(m², c P c)

σ is the model error of a reading, κ l that of the remaining path of length l. The last term is for a miss m that
is predicted although the search minimises it: at the limits of the needle, errors that later
readings reveal cannot be corrected either.
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

    A few of them are simulated again each period, along the current path (`Identified.perturbed`).
    """

    grid: Floats
    curves: Floats

    @staticmethod
    def of(estimate: Identified) -> "Outlook":
        """The derivatives before the first path: those of the estimate itself, a few steps ahead."""
        return Outlook(estimate.grid, estimate.curves)

    def renewed(self, estimate: Identified, controls: Floats, tips: Floats) -> "Outlook":
        """Derivatives renewed for the parameters that the estimate has just perturbed, along controls (m, 5).

        tips (m, 3): measured tips predicted for these controls.
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
        """Standard deviation (mm) of the miss at the depth `target` (mm), if `miss` (mm) is predicted."""
        step = estimate.nominal.scenario.setup.max_advance_mm
        end = np.array([np.interp(target, self.grid, curve) for curve in self.curves])
        to_come = (self.grid > estimate.state.tip[0]) & (self.grid <= target - UNCORRECTED * step)
        slopes = self.curves[:, to_come]
        then = estimate.precision + slopes @ slopes.T / estimate.reading_variance
        known = end @ np.linalg.solve(then, end) + _UNEXPLAINED**2 * estimate.reading_variance
        known += (_DRIFT * (target - float(estimate.state.tip[0]))) ** 2
        return float(np.sqrt(float(known) + min(miss**2, self.sd_now(estimate, target) ** 2)))

    def sd_now(self, estimate: Identified, target: float) -> float:
        """Standard deviation (mm) of the tip's lateral position at the depth `target` (mm) without corrections."""
        end = np.array([np.interp(target, self.grid, curve) for curve in self.curves])
        return float(np.sqrt(end @ np.linalg.solve(estimate.precision, end)))
