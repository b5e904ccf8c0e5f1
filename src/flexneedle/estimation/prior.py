"""Prior of the parameters that `adaptive-mpc` identifies: normal, from scenario and settings, with the law's bounds.

Parameters in order: base y (mm), base turn (rad), natural bend of the needle (mm), run-out (mm), factor on the bevel
offset, clearance in the guide (mm), ln of the factor on each layer's modulus, shift (mm) of each boundary between
layers, ln of a further factor on the modulus in cells along the depth, correlated over a length.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from flexneedle.errors import ScenarioError
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Positive, Section
from flexneedle.types import Floats


class Slots(NamedTuple):
    """Places of the parameters.

    On each axis: base, slope, bend, run-out, and the tilt of a measured direction (the latter three relative to the
    bevel's direction). Then the bevel factor, the clearance, and the first of the moduli. After the last of these,
    errors of the tracker and of other sensors.
    """

    base: slice
    slope: slice
    bend: slice
    run_out: slice
    tilt: slice
    bevel: int
    clearance: int
    modulus: int
    end: int | None = None  # of the parameters of needle and tissue, None: there are no others
    bias: slice = slice(0, 0)  # constant error of the tracker across the needle

    @staticmethod
    def of(scenario: Scenario) -> "Slots":
        """Return the places for the axes of a scenario."""
        axes, kinds = scenario.setup.axes, 4 if scenario.tracker.direction_jitter is None else 5
        base, slope, bend, run_out, tilt = (
            slice(min(k, kinds) * axes, min(k + 1, kinds) * axes) for k in range(5)
        )
        bevel = kinds * axes
        return Slots(base, slope, bend, run_out, tilt, bevel, bevel + 1, bevel + 2)

    def is_offset(self, parameter: int) -> bool:
        """Return whether a parameter is an error of a measurement, without effect on the needle."""
        return self.run_out.start <= parameter < self.tilt.stop or (
            self.end is not None and parameter >= self.end
        )


LEAST_SD = 1e-6
"""Standard deviation of a known parameter (given as 0)."""
_LATERAL_STEPS = (0.05, 3e-4, 0.05, 0.05, 1e-3)  # for differences, on each axis: mm, rad, mm, mm, rad
_STEPS = (0.05, 0.02)  # of bevel factor and clearance: 1, mm
_LOG_STEP = 0.05
# Share of the standard deviation, towards the skin: below the target a boundary has no effect.
_SHIFT_STEP = 2.0 / 3.0
_LEAST_SHIFT = 0.2  # mm
_WIDEST = 4.0  # standard deviations by which a parameter may deviate from its prior
_MOST_CELLS = 200


class Priors(Section):
    """Settings of the observer, keys in the section of its controller."""

    bend_sd_mm: NonNegative = 0.5
    """Prior standard deviation of the natural bend (lateral offset of the tip)."""
    run_out_sd_mm: NonNegative = 0.1
    """Prior standard deviation of the measured tip's distance from the needle's axis."""
    tilt_sd_mrad: NonNegative = 10.0
    """Prior standard deviation, per axis, of the angle between measured direction and needle."""
    clearance_mm: NonNegative = 0.05
    """Prior mean of the guide clearance, to either side, where `setup.guide_clearance_mm` is not set."""
    clearance_sd_mm: NonNegative = 0.02
    """Prior standard deviation of the guide clearance."""
    modulus_log_sd: NonNegative = 0.3
    """Prior standard deviation of the logarithm of each layer's modulus factor."""
    bevel_sd: NonNegative = 0.3
    """Prior standard deviation of the factor on the bevel offset."""
    boundary_sd_mm: NonNegative = 1.5
    """Prior standard deviation of the depth of each layer boundary."""
    variation_sd: NonNegative = 0.2
    """Prior standard deviation of the logarithm of the modulus along the depth."""
    variation_length_mm: Positive = 10.0
    """Correlation length of this variation."""
    cell_mm: Positive = 2.5
    """Length of the cells of constant modulus."""
    model_sd: NonNegative = 0.01
    """Model error: standard deviation of the mean reading of a move, relative to the bevel offset."""
    least_model_sd_mm: Positive = 0.0126
    """Lower bound of this standard deviation."""
    model_slope_sd_mrad: Positive = 1.0
    """Model error: standard deviation of the mean direction of a move."""
    residual_gain: Fraction = 0.4
    """Gain per move of the low-pass filter on the residuals of the fit."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal prior of the parameters."""

    mean: Floats  # means (K,)
    precision: Floats  # inverse covariance (K, K)
    bounds: Floats  # lower and upper bounds (2, K)
    steps: Floats  # steps for differences (K,)
    begins: Floats  # depth of the tip (mm) from which each parameter affects it (K,)

    @staticmethod
    def of(scenario: Scenario, settings: Priors, depth: float) -> "Prior":
        """Return the prior of a scenario."""
        control, slots, axes = scenario.control, Slots.of(scenario), scenario.setup.axes
        layers, cells = len(scenario.tissue), _count_cells(depth, settings)
        lateral = (
            control.start_offset_sd_mm,
            control.start_angle_sd,
            settings.bend_sd_mm,
            settings.run_out_sd_mm,
            1e-3 * settings.tilt_sd_mrad,
        )[: slots.bevel // axes]
        single = (
            np.repeat(lateral, axes).tolist()
            + [settings.bevel_sd, settings.clearance_sd_mm if scenario.setup.has_guide else 0.0]
            + [settings.modulus_log_sd] * layers
            + [settings.boundary_sd_mm] * (layers - 1)
        )
        sd = np.maximum([*single, *[settings.variation_sd] * cells], LEAST_SD)
        mean = np.where(np.arange(sd.size) == slots.bevel, 1.0, 0.0)
        if scenario.setup.has_guide:
            known = scenario.setup.guide_clearance_mm
            mean[slots.clearance] = settings.clearance_mm if known is None else known
        precision = np.diag(sd**-2.0)
        precision[-cells:, -cells:] = inverse_correlation(
            cells, settings.cell_mm / settings.variation_length_mm
        )
        precision[-cells:, -cells:] /= sd[-1] ** 2
        bounds = mean + np.outer((-_WIDEST, _WIDEST), sd)
        bounds[0, slots.clearance] = 0.0
        bounds[:, slots.bevel] = 0.0, _largest_bevel(scenario)
        shift = -max(_SHIFT_STEP * settings.boundary_sd_mm, _LEAST_SHIFT)
        logs, shifts = [_LOG_STEP] * layers, [shift] * (layers - 1)
        steps = np.array(
            [*np.repeat(_LATERAL_STEPS[: len(lateral)], axes), *_STEPS, *logs, *shifts, *[_LOG_STEP] * cells]
        )
        tops = np.array(scenario.layer_tops) - _WIDEST * settings.boundary_sd_mm
        tops[0] = 0.0
        starts = settings.cell_mm * np.arange(cells)
        begins = np.concatenate([[-np.inf] * slots.bevel, [0.0, -np.inf], tops, tops[1:], starts])
        return Prior(mean, precision, bounds, steps, begins)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (K, K)."""
        found: Floats = np.linalg.inv(self.precision).astype(np.float64)
        return found

    def extend(self, sds: Sequence[float]) -> "Prior":
        """Return the prior with further independent parameters: errors of measurements, of mean 0."""
        sd = np.maximum(sds, LEAST_SD)
        own, size = self.mean.size, self.mean.size + sd.size
        precision = np.zeros((size, size))
        precision[:own, :own], precision[own:, own:] = self.precision, np.diag(sd**-2.0)
        return Prior(
            np.append(self.mean, np.zeros(sd.size)),
            precision,
            np.concatenate([self.bounds, np.outer((-_WIDEST, _WIDEST), sd)], axis=1),
            np.append(self.steps, np.ones(sd.size)),
            np.append(self.begins, np.full(sd.size, -np.inf)),
        )

    def cost(self, parameters: Floats) -> float:
        """Return the negative logarithm of the density, up to a constant."""
        off = parameters - self.mean
        return float(0.5 * off @ self.precision @ off)


def inverse_correlation(size: int, distance: float) -> Floats:
    """Return the inverse of the correlation exp(−distance |i − j|) of a Markov chain, which is tridiagonal."""
    share = np.exp(-distance)
    inner = np.full(size, 1.0 + share**2)
    inner[[0, -1]] = 1.0
    beside = np.full(size - 1, -share)
    inverse: Floats = (np.diag(inner) + np.diag(beside, 1) + np.diag(beside, -1)) / (1.0 - share**2)
    return inverse


def _count_cells(depth: float, settings: Priors) -> int:
    """Return the number of cells from the skin to the target's depth (mm); the last one has no lower end."""
    return max(2, int(np.ceil(depth / settings.cell_mm)))


def check_cells(scenario: Scenario, settings: Priors) -> None:
    """Raise ScenarioError for cells so short that a fit would never end."""
    thinnest = scenario.setup.max_depth / _MOST_CELLS
    if settings.cell_mm < thinnest:
        rule = f"must be at least {thinnest:g}, the depth of the full stroke / {_MOST_CELLS}"
        raise ScenarioError(to_line(Problem("control.adaptive_mpc.cell_mm", settings.cell_mm, rule)))


def _largest_bevel(scenario: Scenario) -> float:
    """Return the largest factor on the bevel offset with which the law stays above its floor stretch."""
    most, offset = min(layer.most_bevel_mm for layer in scenario.tissue), scenario.needle.bevel.offset_mm
    return most / offset if offset > 0.0 else 1.0
