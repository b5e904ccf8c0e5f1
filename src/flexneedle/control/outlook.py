"""Uncertainty of the miss at the target that a controller's model predicts.

The estimate's parameters are normal, with the posterior covariance P. Readings to come reduce it to P', and the path is
corrected by them, until the tip is so near the target that a correction takes no effect. With c, the derivative of the
tip's lateral position at the target with respect to the parameters, the variance of the miss is

    f² (c P' c + σ² + (κ l)²) + min(m², c P c)

σ is the model error of a reading, κ l the model error of the remaining path of length l. The last term is for a miss m
that is predicted although the search minimises it: at the limits of the needle, errors that later readings reveal
cannot be corrected either.

Tissue is rarely as far from the prior as this allows for, and the fit takes the errors of its model for noise of the
readings. So the normal distribution is too wide about a tip that the guide corrects, and too narrow along the needle.
The factors f, and f_s on the deviations of the shape, make intervals for 95 % contain about 95 % of the ends of
insertions in training worlds. With the bevel alone, f is 1.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.estimation.identification import Identified
from flexneedle.estimation.lateral import bevel_directions, directions
from flexneedle.types import Floats, Laterals, X, Y, laterals

UNCORRECTED = 5.0
"""Control steps before the target in which a correction takes no effect."""
_UNEXPLAINED = 1.0  # standard deviations of the mean of a control step's readings
_DRIFT = 0.0008  # mm per mm of path
_MISS_FACTOR = 0.7  # f
_SHAPE_FACTOR = 1.4  # f_s


@dataclass(frozen=True, eq=False)
class Outlook:
    """Derivatives of the tip's lateral position ahead, and of the needle's shape, with respect to the parameters.

    A few of them are simulated again each period, along the current path (`Identified.perturbed`).
    """

    grid: Floats  # depths (g,), mm
    curves: Laterals  # derivatives (K, g) of the lateral position over the depths
    bent: Laterals  # derivatives (K, n) of the shape at the target

    @staticmethod
    def of(estimate: Identified) -> "Outlook":
        """Return the derivatives before the first path: from the estimate, a few steps ahead; zeros for the shape."""
        nodes = estimate.nominal.scenario.needle.nodes
        curves = estimate.curves[0]
        return Outlook(estimate.grid, curves, np.zeros((len(curves), nodes), curves.dtype))

    def renew(self, estimate: Identified, predicted: Trajectories) -> "Outlook":
        """Return the derivatives, new for the parameters that the estimate has just perturbed.

        predicted: of `predict_ends`, along whose first controls the derivatives are.
        """
        curves, bent = self.curves.copy(), self.bent.copy()
        bevel = bevel_directions(estimate.state.bevel, predicted.controls[0], estimate.axes)
        across, shapes = (laterals(p, Y, estimate.axes) for p in (predicted.tips, predicted.shapes[:, -1]))
        depth = np.maximum.accumulate(predicted.tips[0, :, X])
        first = len(across) - len(estimate.perturbed)
        for k, one in enumerate(estimate.perturbed, first):
            bent[one.parameter] = (shapes[k] - shapes[0]) / one.step
            curves[one.parameter] = np.interp(self.grid, depth, (across[k] - across[0]) / one.step)
        for k, direction in zip(
            range(*estimate.slots.run_out.indices(len(curves))), directions(1.0, estimate.axes), strict=True
        ):
            curves[k] = np.interp(self.grid, depth, bevel * direction)
        return replace(self, curves=curves, bent=bent)

    def at(self, depth: float) -> Laterals:
        """Return the derivatives (K,) of the lateral position at a depth (mm)."""
        place = np.clip((depth - self.grid[0]) / (self.grid[1] - self.grid[0]), 0.0, self.grid.size - 1.001)
        left = int(place)
        part: Laterals = self.curves[:, left] + (place - left) * (
            self.curves[:, left + 1] - self.curves[:, left]
        )
        return part

    def sd(self, estimate: Identified, target: float, miss: complex, *, guided: bool) -> float:
        """Return the standard deviation (mm), on an axis, of the miss at the depth `target` (mm).

        miss: the predicted miss (mm); guided: whether the guide may move.
        """
        factor = _MISS_FACTOR if guided else 1.0
        stays = min(abs(miss) ** 2 / estimate.axes, self.sd_now(estimate, target) ** 2)
        return float(np.sqrt((factor * self.sd_to_come(estimate, target)) ** 2 + stays))

    def sd_to_come(self, estimate: Identified, target: float) -> float:
        """Return the standard deviation (mm), on an axis, of the miss after all corrections, by the linear model."""
        step = estimate.nominal.scenario.setup.max_advance_mm
        known = float(self.sd_after(estimate, target, np.array([target - UNCORRECTED * step]))[0]) ** 2
        known += _UNEXPLAINED**2 * estimate.reading_variance + estimate.lasting_variance
        known += (_DRIFT * (target - float(estimate.state.tip[X]))) ** 2
        return float(np.sqrt(known))

    def sd_after(self, estimate: Identified, target: float, depths: Floats) -> Floats:
        """Return standard deviations (d,), mm, on an axis, of the end if uncorrected, after readings down to depths.

        Of the tracker: what sensors along the needle will measure does not count. Its constant error stays unknown. The
        error of its field is noise whose mean over as many steps as it lasts has its full size.
        """
        end, to_come, read = self.at(target), self.grid > estimate.state.tip[X], self.curves
        if estimate.slots.bias.stop:
            read = read.copy()
            read[estimate.slots.bias] = directions(1.0, estimate.axes)[:, None]
        slopes = np.where((to_come & (self.grid <= depths[:, None]))[:, None], read, 0.0)
        scenario = estimate.nominal.scenario
        steps = max(1.0, scenario.tracker.field_length_mm / scenario.setup.max_advance_mm)
        variance = estimate.reading_variance + steps * estimate.field_sd**2 if estimate.tracked else np.inf
        then = estimate.precision + (slopes @ slopes.conj().swapaxes(1, 2)).real / variance
        sd: Floats = np.sqrt((np.linalg.solve(then, end[:, None])[..., 0] @ end.conj()).real / estimate.axes)
        return sd

    def shape_sd(self, estimate: Identified, target: float, lever: Laterals, miss_sd: float) -> Floats:
        """Return the standard deviations (n, 2) of y and z of the nodes at the target (mm).

        Corrections of the path to come undo the miss at the depth `target` (mm) but for `miss_sd` (mm); by this they
        move the nodes by `lever` (n,), relative to the tip.
        """
        end = self.at(target)
        left = self.bent - np.outer(end, lever)
        parts = np.stack([left.real, left.imag])
        variance = _SHAPE_FACTOR**2 * np.einsum("akn,kl,aln->na", parts, estimate.covariance, parts)
        sd: Floats = np.sqrt(variance + np.abs(lever[:, None]) ** 2 * miss_sd**2)
        return sd

    def sd_now(self, estimate: Identified, target: float) -> float:
        """Return the standard deviation (mm), on an axis, of the tip's lateral position at a depth if uncorrected."""
        end = self.at(target)
        return float(np.sqrt((end.conj() @ np.linalg.solve(estimate.precision, end)).real / estimate.axes))


def predict_ends(estimate: Identified, controls: Floats) -> Trajectories:
    """Return trajectories, with shapes at the end, of controls (N, m, 9), and of the perturbed needles with the first.

    All are simulated together.
    """
    count, perturbed = len(controls), estimate.perturbed
    return estimate.nominal.rollout(
        [estimate.state] * count + [one.state for one in perturbed],
        np.concatenate([controls, np.repeat(controls[:1], len(perturbed), axis=0)]),
        models=[estimate.simulator.model] * count + [one.model for one in perturbed],
        limits=False,
        rough=True,
        at_end=("shapes",),
    )
