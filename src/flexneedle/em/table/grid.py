"""A table by grid points: for each sensor and environment, the moments of the samples at each grid point."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.rig.tracking.registration import Rigid

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Places:
    """Samples by place, n of them: a grid point, or a grid point at a distance from the field generator.

    bins (n,): bin of the distance, NaN where it is unknown or all are pooled. count (n,): samples with a position,
    missing (n,): without. true, position (n, 3): true and mean measured position, scatter (n, 3): sum of squares about
    the mean, along each axis (mm, mm²). distance (n,): mean distance (mm). indicators, turns (n,): samples
    with a position that have an indicator, an orientation; indicator (n,): its mean; products (n, 4, 4): mean of q qᵀ,
    q = (w, x, y, z). NaN where there is no sample.
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
    turns: Counts
    products: Floats

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "Places":
        return Places(*(value[chosen] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True, eq=False)
class Levels:
    """Single samples of the indicator, counted at multiples of 0.0001.

    values (k,): those that occur, ascending; counts (k,): samples within half a step of each; least, most: of all
    samples, exact.
    """

    values: Floats
    counts: Counts
    least: float
    most: float

    @property
    def count(self) -> int:
        """How many samples there are."""
        return int(self.counts.sum())

    def quantile(self, share: float) -> float:
        """Return the quantile with linear interpolation, to half a step; NaN without samples."""
        if not self.count:
            return float("nan")
        place = share * (self.count - 1)
        low, high = np.searchsorted(np.cumsum(self.counts), (np.floor(place) + 1.0, np.ceil(place) + 1.0))
        return float(np.interp(place % 1.0, (0.0, 1.0), self.values[[low, high]]))

    def above(self, limit: float) -> float:
        """Return the share of samples more than half a step above `limit`; NaN without samples."""
        above = self.values > limit + 0.5 * LEVEL
        return float(self.counts[above].sum() / self.count) if self.count else float("nan")


LEVEL = 1e-4
"""Step of the levels: the last digit of the indicator in NDI's replies in text."""


@dataclass(frozen=True, eq=False)
class Grid:
    """One sensor in one environment: names of the grid points, `points` in their order, `cells` by distance as well.

    rigid: what was applied to the tracker's positions, if anything.
    """

    sensor: str
    environment: str
    names: tuple[str, ...]
    points: Places
    cells: Places
    levels: Levels
    rigid: Rigid | None = None

    @property
    def title(self) -> str:
        """Sensor and environment."""
        return f"{self.sensor}, {self.environment}"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which grid points (n,) have a sample with a position."""
        known: NDArray[np.bool_] = self.points.count > 0
        return known

    def measured(self) -> Places:
        """Return the grid points that have a sample with a position."""
        return self.points[self.known]

    def name_of(self, measured: Any) -> str:
        """Return the name of a grid point by its number among the measured ones."""
        return self.names[int(np.flatnonzero(self.known)[measured])]

    def registered(self, rigid: Rigid) -> "Grid":
        """Return the grid with all mean positions mapped; scatter stays as it is, along the tracker's axes."""
        points, cells = (replace(p, position=rigid.apply(p.position)) for p in (self.points, self.cells))
        return replace(self, points=points, cells=cells, rigid=rigid)
