"""What a table comes to: for each sensor and environment, the moments of the samples at each grid point."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.histogram import Histogram
from flexneedle.rig.tracking.registration import Rigid

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sums:
    """Samples of w quantities at each place: count (n,), mean (n, w), sum of squares about it (n, w).

    Where there is no sample, mean and scatter are NaN.
    """

    count: Counts
    mean: Floats
    scatter: Floats

    def __getitem__(self, chosen: NDArray[np.bool_] | Counts) -> "Sums":
        return Sums(self.count[chosen], self.mean[chosen], self.scatter[chosen])

    def merged(self, group: Counts, groups: int) -> "Sums":
        """Return the sums of groups: `group` (n,) of each place (Chan, Golub and LeVeque 1983)."""
        count = np.bincount(group, self.count, groups).astype(np.int64)
        with np.errstate(invalid="ignore"):
            # Means are pooled as deviations from one of their own, which loses no digits far from the origin.
            pivot = _first_known(self.mean, self.count, group, groups)
            off = np.where(self.count[:, None] > 0, self.mean - pivot[group], 0.0)
            share = _summed(self.count[:, None] * off, group, groups) / count[:, None]
            between = self.count[:, None] * (off - share[group]) ** 2
            scatter = _summed(np.nan_to_num(self.scatter) + np.nan_to_num(between), group, groups)
        return Sums(count, pivot + share, np.where(count[:, None] > 0, scatter, np.nan))


@dataclass(frozen=True, eq=False)
class Places:
    """Samples by place, n of them: a grid point, or a grid point at a distance from the field generator.

    point (n,): number of the grid point; bins (n,): bin of the distance, −1 where that is unknown; missing (n,):
    samples without a position. true, position: x, y, z (mm), of the samples that have one; distance (mm), indicator
    and orientation: of those that have it, too. orientation: the 10 products of w, x, y, z (upper triangle).
    """

    point: Counts
    bins: Counts
    missing: Counts
    true: Sums
    position: Sums
    distance: Sums
    indicator: Sums
    orientation: Sums

    def __getitem__(self, chosen: NDArray[np.bool_] | Counts) -> "Places":
        return Places(*(value[chosen] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True, eq=False)
class Grid:
    """One sensor in one environment: names of the grid points, `points` in their order, `cells` by distance as well.

    indicators: single values of the indicator. rigid: what was applied to the tracker's positions, if anything.
    """

    sensor: str
    environment: str
    names: tuple[str, ...]
    points: Places
    cells: Places
    indicators: Histogram
    indicator_range: tuple[float, float]
    rigid: Rigid | None = None

    def registered(self, rigid: Rigid) -> "Grid":
        """Return the grid with all mean positions mapped; scatter stays as it is, along the tracker's axes."""
        return replace(
            self, points=_mapped(self.points, rigid), cells=_mapped(self.cells, rigid), rigid=rigid
        )

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which grid points (n,) have a sample with a position."""
        seen: NDArray[np.bool_] = self.points.position.count > 0
        return seen


def merged(cells: Places, order: Counts) -> Places:
    """Return the cells pooled by grid point, in the order of their numbers (n,)."""
    rank = np.zeros(int(order.max()) + 1, dtype=np.int64)
    rank[order] = np.arange(len(order))
    group, groups = rank[cells.point], len(order)
    sums = (cells.true, cells.position, cells.distance, cells.indicator, cells.orientation)
    missing = np.bincount(group, cells.missing, groups).astype(np.int64)
    pooled = (entry.merged(group, groups) for entry in sums)
    return Places(order, np.full(groups, -1), missing, *pooled)


def _mapped(places: Places, rigid: Rigid) -> Places:
    position = places.position
    return replace(places, position=replace(position, mean=rigid.apply(position.mean)))


def _first_known(values: Floats, count: Counts, group: Counts, groups: int) -> Floats:
    pivot = np.full((groups, values.shape[1]), np.nan)
    known = np.flatnonzero(count)[::-1]
    pivot[group[known]] = values[known]
    return pivot


def _summed(values: NDArray[Any], group: Counts, groups: int) -> Floats:
    return np.stack([np.bincount(group, column, groups) for column in values.T], axis=1)
