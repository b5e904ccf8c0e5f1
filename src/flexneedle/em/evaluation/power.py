"""Whether the rig's own power distorts the field: the indicator with power off and on (paper, section IV-B)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.accuracy import P95
from flexneedle.em.evaluation.grid import Grid
from flexneedle.em.evaluation.indicator import means
from flexneedle.em.evaluation.intervals import LEAST_POINTS, RESAMPLES, SEED, Interval, ends, intervals
from flexneedle.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Level:
    """The indicator with power off or on: means at grid points, the largest single sample, and samples above."""

    n_points: int
    n_samples: int
    mean: float
    p95: float
    max: float
    samples_max: float
    samples_above: float


@dataclass(frozen=True)
class Power:
    """A sensor with power off and on. difference: mean on minus mean off; its interval is over grid points.

    paired: over the same points both times, so that only what changed counts. above: the mean with power on exceeds the
    threshold; points_above: at how many grid points it does.
    """

    sensor: str
    threshold: float
    off: Level
    on: Level
    difference: float
    difference_interval: Interval
    paired: bool
    above: bool
    points_above: int


def compare(off: Grid, on: Grid, threshold: float) -> Power:
    """Return the comparison of a sensor's grids. Raises InputError if either has no indicator."""
    for grid, name in ((off, "off"), (on, "on")):
        if not len(means(grid)[0]):
            raise InputError(f"sensor {grid.sensor!r} has no indicator with power {name}")
    before, after = (dict(zip(_names(grid), means(grid)[0].tolist(), strict=True)) for grid in (off, on))
    paired = before.keys() == after.keys()
    low, high = np.array(list(before.values())), np.array(list(after.values()))
    return Power(
        on.sensor,
        threshold,
        _level(off, threshold),
        _level(on, threshold),
        float(high.mean() - low.mean()),
        _paired(high - low) if paired else _apart(low, high),
        paired,
        bool(high.mean() > threshold),
        int((high > threshold).sum()),
    )


def _names(grid: Grid) -> list[str]:
    known = grid.seen & (grid.points.indicator.count > 0)
    return [name for name, is_known in zip(grid.names, known.tolist(), strict=True) if is_known]


def _level(grid: Grid, threshold: float) -> Level:
    values = means(grid)[0]
    return Level(
        n_points=len(values),
        n_samples=grid.indicators.count,
        mean=float(values.mean()),
        p95=float(np.quantile(values, P95)),
        max=float(values.max()),
        samples_max=grid.indicator_range[1],
        samples_above=grid.indicators.above(threshold),
    )


def _paired(difference: Floats) -> Interval:
    return intervals({"": lambda chosen: difference[chosen].mean(axis=1)}, len(difference))[""]


def _apart(low: Floats, high: Floats) -> Interval:
    """Of points that are not the same: each set is drawn again for itself."""
    rng = np.random.default_rng(SEED)
    if min(len(low), len(high)) < LEAST_POINTS:
        return None
    first, second = (
        np.array([values[rng.integers(0, len(values), len(values))].mean() for _ in range(RESAMPLES)])
        for values in (low, high)
    )
    return ends(second - first)
