"""The indicator 𝓘 of field distortion: its summary (paper, Table II), and the error over it."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.accuracy import P95, errors
from flexneedle.em.evaluation.intervals import Interval, bootstrap, deviation, mean, quantile_interval
from flexneedle.em.table.grid import Grid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Singles:
    """Single samples of the indicator: exact but for p95, which is that of bins 0.0001 wide."""

    n_samples: int
    mean: float
    max: float
    min: float
    p95: float


@dataclass(frozen=True)
class Summary:
    """The mean indicator at each grid point, over grid points (sd with n − 1), and over `singles` samples."""

    n_points: int
    mean: float
    sd: float
    max: float
    min: float
    p95: float
    intervals: dict[str, Interval]
    samples: Singles


@dataclass(frozen=True)
class Constant:
    """err = mean ± sd (mm, n − 1), as in the paper's `ideal`."""

    n_points: int
    mean_mm: float
    sd_mm: float
    intervals: dict[str, Interval]


@dataclass(frozen=True)
class Line:
    """err = slope · 𝓘 + intercept (mm), as in the paper's `noisy`: least squares; scatter_mm: about it (n − 2).

    NaN if there are fewer than three points or the indicator is the same at all.
    """

    n_points: int
    slope_mm: float
    intercept_mm: float
    scatter_mm: float
    intervals: dict[str, Interval]


def means(grid: Grid) -> tuple[Floats, Floats]:
    """Return mean indicator and error (mm) (n,) of the grid points that have both."""
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
        samples=_singles(grid),
    )


def _singles(grid: Grid) -> Singles:
    known, levels = grid.points[grid.points.indicators > 0], grid.levels
    average = float(np.average(known.indicator, weights=known.indicators))
    return Singles(levels.count, average, levels.most, levels.least, levels.quantile(P95))


def constant(error: Floats) -> Constant:
    """Return the constant fit to errors (n,), n at least 1."""
    spread = float(error.std(ddof=1)) if len(error) > 1 else nan
    found = {"mean_mm": bootstrap(mean, error), "sd_mm": bootstrap(deviation, error)}
    return Constant(len(error), float(error.mean()), spread, found)


def line(indicator: Floats, error: Floats) -> Line:
    """Return the least-squares line through errors (n,) over the indicator (n,), with pairs drawn again."""
    slope, intercept = float(_slope(indicator, error)), float(_intercept(indicator, error))
    rest, free = error - slope * indicator - intercept, len(error) - 2
    known = np.isfinite(slope)
    found = {
        "slope_mm": bootstrap(_slope, indicator, error) if known else None,
        "intercept_mm": bootstrap(_intercept, indicator, error) if known else None,
    }
    scatter = float(np.sqrt(rest @ rest / free)) if free > 0 else nan
    return Line(len(error), slope, intercept, scatter, found)


def _slope(x: Floats, y: Floats, axis: int = -1) -> Floats:
    """Return the slope (…) of the line through y over x (…, n), NaN where all x are the same."""
    off = x - x.mean(axis=axis, keepdims=True)
    spread = np.where(np.ptp(x, axis=axis) > 0.0, (off**2).sum(axis=axis), nan)
    slope: Floats = (off * (y - y.mean(axis=axis, keepdims=True))).sum(axis=axis) / spread
    return slope


def _intercept(x: Floats, y: Floats, axis: int = -1) -> Floats:
    intercept: Floats = y.mean(axis=axis) - _slope(x, y, axis) * x.mean(axis=axis)
    return intercept
