"""The indicator 𝓘 of field distortion: its summary (paper, Table II), and the error as a function of it."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import P95, compute_errors
from flexneedle.lab.tracker_evaluation.evaluation.intervals import (
    Interval,
    bootstrap,
    deviation,
    mean,
    quantile_interval,
)
from flexneedle.lab.tracker_evaluation.evaluation.moments import IndicatorSamples, MeasuredGrid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class IndicatorSummary:
    """Statistics of the mean indicator at grid points (sd with n − 1), and of single samples."""

    n_points: int
    mean: float
    sd: float
    max: float
    min: float
    p95: float
    intervals: dict[str, Interval]
    samples: IndicatorSamples


@dataclass(frozen=True)
class ConstantFit:
    """Constant fit err = mean ± sd (mm, n − 1), as for the paper's `ideal`."""

    n_points: int
    mean_mm: float
    sd_mm: float
    intervals: dict[str, Interval]


@dataclass(frozen=True)
class LineFit:
    """Least-squares line err = slope · 𝓘 + intercept (mm), as for the paper's `noisy`.

    scatter_mm: standard deviation of the residuals (n − 2), NaN for fewer than three points. Slope and intercept are
    NaN if the indicator is the same at all points.
    """

    n_points: int
    slope_mm: float
    intercept_mm: float
    scatter_mm: float
    intervals: dict[str, Interval]


@dataclass(frozen=True)
class IndicatorFits:
    """Error of a sensor as a function of its mean indicator in the environments `ideal` and `noisy`.

    threshold: 95th percentile of the indicator in `ideal`. None for results of a missing environment.
    """

    sensor: str
    ideal: ConstantFit | None
    noisy: LineFit | None
    threshold: float | None
    threshold_interval: Interval


def average_indicator(grid: MeasuredGrid) -> tuple[Floats, Floats]:
    """Return mean indicator and error (mm) (n,) of the grid points with an indicator."""
    known = grid.points[grid.points.indicators > 0]
    return known.indicator, compute_errors(known)


def summarize_indicator(grid: MeasuredGrid) -> IndicatorSummary | None:
    """Return the summary of the indicator, None if the sensor has none."""
    values, _ = average_indicator(grid)
    if grid.samples is None:
        return None
    return IndicatorSummary(
        n_points=len(values),
        mean=float(values.mean()),
        sd=float(values.std(ddof=1)) if len(values) > 1 else nan,
        max=float(values.max()),
        min=float(values.min()),
        p95=float(np.quantile(values, P95)),
        intervals={
            "mean": bootstrap(mean, values),
            "sd": bootstrap(deviation, values),
            "p95": quantile_interval(values, P95),
        },
        samples=grid.samples,
    )


def fit_indicator(
    sensor: str, ideal: MeasuredGrid | None, noisy: MeasuredGrid | None
) -> IndicatorFits | None:
    """Return the fits to the errors of a sensor in one or two environments, None if there is no indicator."""
    low, low_error = average_indicator(ideal) if ideal else (np.empty(0), np.empty(0))
    high, high_error = average_indicator(noisy) if noisy else (np.empty(0), np.empty(0))
    if not len(low) and not len(high):
        return None
    return IndicatorFits(
        sensor,
        fit_constant(low_error) if len(low) else None,
        fit_line(high, high_error) if len(high) else None,
        float(np.quantile(low, P95)) if len(low) else None,
        quantile_interval(low, P95),
    )


def fit_constant(error: Floats) -> ConstantFit:
    """Return the constant fit to errors (n,), n ≥ 1."""
    spread = float(error.std(ddof=1)) if len(error) > 1 else nan
    found = {"mean_mm": bootstrap(mean, error), "sd_mm": bootstrap(deviation, error)}
    return ConstantFit(len(error), float(error.mean()), spread, found)


def fit_line(indicator: Floats, error: Floats) -> LineFit:
    """Return the least-squares line through errors (n,) over the indicator (n,); pairs are resampled."""
    slope, intercept = float(_slope(indicator, error)), float(_intercept(indicator, error))
    residual, freedom = error - slope * indicator - intercept, len(error) - 2
    known = np.isfinite(slope)
    found = {
        "slope_mm": bootstrap(_slope, indicator, error) if known else None,
        "intercept_mm": bootstrap(_intercept, indicator, error) if known else None,
    }
    scatter = float(np.sqrt(residual @ residual / freedom)) if freedom > 0 else nan
    return LineFit(len(error), slope, intercept, scatter, found)


def _slope(x: Floats, y: Floats, axis: int = -1) -> Floats:
    """Return the slope (…) of the line through y over x (…, n), NaN if all x are equal."""
    centred = x - x.mean(axis=axis, keepdims=True)
    spread = np.where(np.ptp(x, axis=axis) > 0.0, (centred**2).sum(axis=axis), nan)
    slope: Floats = (centred * (y - y.mean(axis=axis, keepdims=True))).sum(axis=axis) / spread
    return slope


def _intercept(x: Floats, y: Floats, axis: int = -1) -> Floats:
    intercept: Floats = y.mean(axis=axis) - _slope(x, y, axis) * x.mean(axis=axis)
    return intercept
