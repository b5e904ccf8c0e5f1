"""The indicator 𝓘 of field distortion: its summary (paper, Table II), and the error as a function of it."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import P95, errors
from flexneedle.lab.tracker_evaluation.evaluation.intervals import (
    Interval,
    bootstrap,
    deviation,
    mean,
    quantile_interval,
)
from flexneedle.lab.tracker_evaluation.table.grid import Grid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SingleSamples:
    """Statistics of single samples of the indicator; p95 is taken from a histogram with bins of 0.0001."""

    n_samples: int
    mean: float
    max: float
    min: float
    p95: float


@dataclass(frozen=True)
class Summary:
    """Statistics of the mean indicator at grid points (sd with n − 1); samples: those of single samples."""

    n_points: int
    mean: float
    sd: float
    max: float
    min: float
    p95: float
    intervals: dict[str, Interval]
    samples: SingleSamples


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


def means(grid: Grid) -> tuple[Floats, Floats]:
    """Return mean indicator and error (mm) (n,) of the grid points with an indicator."""
    known = grid.points[grid.points.indicators > 0]
    return known.indicator, errors(known)


def summary(grid: Grid) -> Summary | None:
    """Return the summary of the indicator, None if the sensor has none."""
    values, _ = means(grid)
    if not len(values):
        return None
    return Summary(
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
        samples=_single_samples(grid),
    )


def _single_samples(grid: Grid) -> SingleSamples:
    known, histogram = grid.points[grid.points.indicators > 0], grid.histogram
    average = float(np.average(known.indicator, weights=known.indicators))
    return SingleSamples(
        histogram.count, average, histogram.maximum, histogram.minimum, histogram.quantile(P95)
    )


def constant(error: Floats) -> ConstantFit:
    """Return the constant fit to errors (n,), n ≥ 1."""
    spread = float(error.std(ddof=1)) if len(error) > 1 else nan
    found = {"mean_mm": bootstrap(mean, error), "sd_mm": bootstrap(deviation, error)}
    return ConstantFit(len(error), float(error.mean()), spread, found)


def line(indicator: Floats, error: Floats) -> LineFit:
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
