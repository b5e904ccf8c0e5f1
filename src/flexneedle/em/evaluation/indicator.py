"""The indicator 𝓘 of field distortion: its summary (paper, Table II), and what it says about the error."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.accuracy import P95, errors
from flexneedle.em.evaluation.grid import Grid
from flexneedle.em.evaluation.intervals import Interval, intervals, quantile_interval

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


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
    known = grid.seen & (grid.points.indicator.count > 0)
    return grid.points.indicator.mean[known, 0], errors(grid.points[known])


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
        intervals={**_intervals(values), "p95": quantile_interval(values, P95)},
        samples=_singles(grid),
    )


def _intervals(values: Floats) -> dict[str, Interval]:
    return intervals(
        {
            "mean": lambda chosen: values[chosen].mean(axis=1),
            "sd": lambda chosen: values[chosen].std(axis=1, ddof=1),
        },
        len(values),
    )


def _singles(grid: Grid) -> Singles:
    sums = grid.points.indicator
    known = sums.count > 0
    mean = float(sums.mean[known, 0] @ sums.count[known] / sums.count.sum())
    low, high = grid.indicator_range
    return Singles(int(sums.count.sum()), mean, high, low, grid.indicators.quantile(P95))


def constant(error: Floats) -> Constant:
    """Return the constant fit to errors (n,), n at least 1."""
    found = intervals(
        {
            "mean_mm": lambda chosen: error[chosen].mean(axis=1),
            "sd_mm": lambda chosen: error[chosen].std(axis=1, ddof=1),
        },
        len(error),
    )
    return Constant(
        len(error), float(error.mean()), float(error.std(ddof=1)) if len(error) > 1 else nan, found
    )


def line(indicator: Floats, error: Floats) -> Line:
    """Return the least-squares line through errors (n,) over the indicator (n,), with pairs drawn again."""
    slope, intercept = (float(value[0]) for value in _fit(indicator[None], error[None]))
    rest = error - slope * indicator - intercept
    free = len(error) - 2
    found = intervals(
        {
            "slope_mm": lambda chosen: _fit(indicator[chosen], error[chosen])[0],
            "intercept_mm": lambda chosen: _fit(indicator[chosen], error[chosen])[1],
        },
        len(error) if np.isfinite(slope) else 0,
    )
    scatter = float(np.sqrt(rest @ rest / free)) if free > 0 else nan
    return Line(len(error), slope, intercept, scatter, found)


def _fit(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return slope and intercept (b,) of each row of x and y (b, n)."""
    middle, height = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    spread = ((x - middle) ** 2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = ((x - middle) * (y - height)).sum(axis=1) / np.where(np.ptp(x, axis=1) > 0.0, spread, nan)
    return slope, height[:, 0] - slope * middle[:, 0]
