"""Moments of the samples at each grid point, for each sensor and environment of a table."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.geometry.registration import Rigid

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of n groups of samples: by grid point, or by grid point and distance bin.

    bins (n,): distance bin, NaN if the distance is unknown or pooled. count, missing (n,): number of samples with and
    without a position. true, position (n, 3): true and mean measured position (mm); scatter (n, 3): sum of squares
    about the mean along each axis (mm²). distance (n,): mean distance to the field generator (mm). indicators,
    orientations (n,): number of samples with a position and an indicator or an orientation; indicator (n,): mean
    indicator; products (n, 4, 4): mean of q qᵀ with q = (w, x, y, z). NaN for groups without such samples.
    """

    bins: Floats
    count: Counts
    missing: Counts
    true: Floats
    position: Floats
    scatter: Floats
    distance: Floats
    indicators: Counts
    indicator: Floats
    orientations: Counts
    products: Floats

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "Moments":
        return Moments(*(value[chosen] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True, eq=False)
class Histogram:
    """Histogram of single samples of the indicator with bins of 0.0001.

    values (k,): centres of the non-empty bins, ascending; counts (k,): samples in each; minimum, maximum: exact
    extremes of the samples.
    """

    values: Floats
    counts: Counts
    minimum: float
    maximum: float

    @property
    def count(self) -> int:
        """Number of samples."""
        return int(self.counts.sum())

    def quantile(self, share: float) -> float:
        """Return the quantile with linear interpolation, exact to half a bin; NaN without samples."""
        if not self.count:
            return float("nan")
        rank = share * (self.count - 1)
        low, high = np.searchsorted(np.cumsum(self.counts), (np.floor(rank) + 1.0, np.ceil(rank) + 1.0))
        return float(np.interp(rank % 1.0, (0.0, 1.0), self.values[[low, high]]))

    def above(self, limit: float) -> float:
        """Return the share of samples more than half a bin above `limit`; NaN without samples."""
        above = self.values > limit + 0.5 * BIN_WIDTH
        return float(self.counts[above].sum() / self.count) if self.count else float("nan")


BIN_WIDTH = 1e-4
"""Bin width of the histogram: the last digit of the indicator in NDI's text replies."""


@dataclass(frozen=True, eq=False)
class Grid:
    """The measurements of one sensor in one environment on a grid.

    names: of the grid points; points: moments by grid point, in the order of names; cells: moments by grid point and
    distance bin; histogram: single samples of the indicator; rigid: transform applied to the positions, if any.
    """

    sensor: str
    environment: str
    names: tuple[str, ...]
    points: Moments
    cells: Moments
    histogram: Histogram
    rigid: Rigid | None = None

    @property
    def title(self) -> str:
        """Sensor and environment in one text."""
        return f"{self.sensor}, {self.environment}"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (n,) of the grid points that have a sample with a position."""
        known: NDArray[np.bool_] = self.points.count > 0
        return known

    def measured(self) -> Moments:
        """Return the grid points that have a sample with a position."""
        return self.points[self.known]

    def name_of(self, measured: Any) -> str:
        """Return the name of a grid point from its index among the measured ones."""
        return self.names[int(np.flatnonzero(self.known)[measured])]

    def registered(self, rigid: Rigid) -> "Grid":
        """Return the grid with all mean positions transformed; the scatter remains along the tracker's axes."""
        points, cells = (replace(p, position=rigid.apply(p.position)) for p in (self.points, self.cells))
        return replace(self, points=points, cells=cells, rigid=rigid)
