"""Standard deviations of the tip, the shape and the parameters of a fitted insertion."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from flexneedle.estimation.axial import axial_variance
from flexneedle.estimation.fit import inform, lasting_covariance
from flexneedle.estimation.fitted import LASTING, FittedInsertion
from flexneedle.estimation.lateral import directions, variance_of
from flexneedle.estimation.prior import LEAST_SD
from flexneedle.types import DB_X, Floats, Laterals, X

_DOUBTED = 3.5  # standard deviations
_KNOWN = 0.5  # share of its prior variance that a parameter may keep when it is compared with the prior


@dataclass(frozen=True, eq=False)
class KnownInsertion(FittedInsertion):
    """A fitted insertion with the standard deviations of what it predicts."""

    axial_covariance: Floats = field(
        default_factory=lambda: np.zeros((3, 3))
    )  # of axial (mm), axial_scale and play (mm)

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip, which is in motion.

        At rest an unknown play would excuse lateral jumps.
        """
        slope = self._tip_slope
        if self.slots.bias.stop:
            slope[self.slots.bias] = directions(1.0, self.axes)
        axial = axial_variance(self.axial_covariance, self._axial_slope(1.0))
        field = (self.axes + 1) * self.field_sd**2
        return float(np.sqrt(variance_of(slope, self.covariance) + axial + field))

    @cached_property
    def present_covariance(self) -> Floats:
        """Posterior covariance (K, K) of the parameters, with sensors along the needle by the derivatives as of now.

        The derivatives of the fit are older by a step, and do not go with the present ones of the tip.
        """
        if not (self.along and self.moves):
            return self.covariance
        found: Floats = np.linalg.inv(inform(self)[1]).astype(np.float64)
        return found

    @property
    def _tip_slope(self) -> Laterals:
        """Derivatives (K,) of the tip's lateral position to the parameters."""
        slope: Laterals = self.slopes(self.state.tip[:1])[0]
        slope[self.slots.run_out] = directions(self.state.bevel, self.axes)
        return slope

    def _axial_slope(self, bias: float) -> list[float]:
        """Return the derivatives of the tip's x to the axial errors, of its reading with `bias` = 1."""
        return [1.0, float(self.state.travel[DB_X]), 1.0, bias][: len(self.axial_covariance)]

    @cached_property
    def tip_covariance(self) -> Floats:
        """Covariance (3, 3) of the tip's x, y, z (mm²), with the errors of the model that last."""
        slope = self._tip_slope
        parts = np.stack([slope.real, slope.imag])
        covariance = np.zeros((3, 3))
        covariance[0, 0] = axial_variance(self.axial_covariance, self._axial_slope(0.0))
        covariance[1:, 1:] = parts @ self.present_covariance @ parts.T + self._lasting
        return covariance

    @cached_property
    def _lasting(self) -> Floats:
        """Covariance (2, 2) of the tip's y and z (mm²) by the errors of the model that last."""
        slope = self._tip_slope
        model = self.sensors[0].unexplained(self.nominal.scenario, self.settings)
        left = model**2 * (1.0 - math.exp(-2.0 * self._age_of_residual / LASTING))
        gains = np.stack([slope.real, slope.imag]) @ self.present_covariance
        # Errors that cancel, since the needle was turned, are not subtracted: this is to first order only.
        sizes, ways = np.linalg.eigh(lasting_covariance(self, gains))
        lasting: Floats = (ways * np.maximum(sizes, 0.0)) @ ways.T + left * np.diag([1.0, self.axes - 1.0])
        return lasting

    @property
    def lasting_variance(self) -> float:
        """Variance (mm²) of the tip's lateral position, on an axis, by the errors of the model that last."""
        return float(np.trace(self._lasting)) / self.axes if self.along else 0.0

    @property
    def _age_of_residual(self) -> float:
        """Moves since the low-passed residual was known: what has changed since then is the model's error."""
        read = [k for k, done in enumerate(self.moves) if done.measurements]
        return float(len(self.moves) - read[-1]) if read else math.inf

    def shape_sd(self, nodes: Floats) -> Floats:
        """Return standard deviations (n, 2), mm, of y and z at nodes (n, 5), as of a tip that passes there."""
        slopes = self.slopes(nodes[:, 0])
        parts = np.stack([slopes.real, slopes.imag])
        sd: Floats = np.sqrt(np.einsum("ank,kl,anl->na", parts, self.covariance, parts))
        return sd

    @property
    def bevel_sd(self) -> float:
        """Standard deviation of the factor on the bevel offset, relative to it."""
        k = self.slots.bevel
        return float(np.sqrt(self.covariance[k, k]) / max(self.parameters[k], LEAST_SD))

    @cached_property
    def doubt(self) -> str:
        """A line if the readings contradict the scenario's moduli or bevel, else "".

        A posterior mean minus the prior's is a normal variable, whose variance is the prior's minus the posterior's.
        """
        ratio, name, factor = max(self._compare())
        if ratio < _DOUBTED:
            return ""
        return f"the readings contradict the scenario: {name} is {factor:.2g} times its value there"

    def _compare(self) -> Iterator[tuple[float, str, float]]:
        """Yield for each of `_compared` its deviation in standard deviations, 0 if little is known; name, factor."""
        for name, weights in self._compared():
            off = float(weights @ (self.parameters - self.prior.mean))
            before, after = (
                float(weights @ each @ weights) for each in (self.prior.covariance, self.covariance)
            )
            ratio = abs(off) / np.sqrt(before - after) if after < _KNOWN * before else 0.0
            yield ratio, name, 1.0 + off if weights[self.slots.bevel] else float(np.exp(off))

    def _compared(self) -> Iterator[tuple[str, Floats]]:
        """Yield the mean ln of each layer's modulus above the tip, and the bevel, as weights (K,) of the parameters."""
        tissue, slots = self.nominal.scenario.tissue, self.slots
        unit, tops = np.eye(self.parameters.size), (*self.nominal.scenario.layer_tops, np.inf)
        cells = slots.modulus + 2 * len(tissue) - 1
        for k, layer in enumerate(tissue):
            starts = self.prior.begins[cells:]
            inside = (starts >= tops[k]) & (starts < min(tops[k + 1], float(self.state.tip[X])))
            if inside.any():
                yield (
                    f"the modulus of {layer.name}",
                    unit[slots.modulus + k] + unit[cells:][inside].mean(axis=0),
                )
        yield "the bevel offset", unit[slots.bevel]

    @property
    def roll_sd(self) -> float:
        """Standard deviation (mm) of the tip's lateral motion if the bevel rolls now."""
        bend, run_out = self.slots.bend, self.slots.run_out
        slope = np.zeros(self.parameters.size, dtype=self.curves.dtype)
        slope[bend] = 2.0 * self.slopes(self.state.tip[:1])[0, bend]
        slope[run_out] = 2.0 * directions(1.0, self.axes)
        return float(np.sqrt(variance_of(slope, self.covariance)))

    @property
    def reading_variance(self) -> float:
        """Variance of the mean of the readings of a control step (mm²)."""
        scenario = self.nominal.scenario
        step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
        count = max(1.0, step / scenario.tracker.period)
        unexplained = self.sensors[0].unexplained(scenario, self.settings)
        return float(scenario.tracker.jitter_per_axis**2 / count + unexplained**2)
