"""Moments of repeated measurements, group by group, from rows in any order and of any number.

Each group keeps its number of samples, the first sample as a pivot, and sums of deviations from it: no row is kept, and
nothing cancels, however far from the origin the tracker stands.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
Indices = NDArray[np.int64]
Number = TypeVar("Number", np.int64, np.float64)


class Moments:
    """Of `width` columns in groups that may become more: `count` (g,), `mean` and `scatter` (g, width).

    pivot (g, width): the first sample of each. scattered: whether the scatter is kept; without, it is NaN.
    """

    def __init__(self, width: int, scattered: bool = True) -> None:
        self.width, self._scattered = width, scattered
        self.count: Counts = np.zeros(0, dtype=np.int64)
        self.pivot, self._first, self._second = (np.zeros((0, width)) for _ in range(3))

    def add(self, group: Indices, columns: Sequence[Floats] | Floats, groups: int) -> None:
        """Take in rows: the group (r,) of each, below `groups`, and `width` columns (r,) of finite numbers."""
        self._grow(groups)
        self._set_pivots(group, columns)
        self.count += np.bincount(group, minlength=groups)
        for k, column in enumerate(columns):
            off = column - self.pivot[:, k].take(group)
            if not off.any():
                continue  # as with true positions, which are the same in all rows of a group
            self._first[:, k] += np.bincount(group, off, groups)
            if not self._scattered:
                continue
            off *= off
            self._second[:, k] += np.bincount(group, off, groups)

    @property
    def mean(self) -> Floats:
        """Means (g, width); NaN where a group has no sample."""
        return self.pivot + self._first / self._known()

    @property
    def scatter(self) -> Floats:
        """Sums of squares about the mean (g, width); NaN where a group has no sample."""
        if not self._scattered:
            return np.full_like(self.pivot, np.nan)
        scatter: Floats = np.maximum(self._second - self._first**2 / self._known(), 0.0)
        return scatter

    def _known(self) -> Floats:
        known: Floats = np.where(self.count > 0, self.count, np.nan)[:, None]
        return known

    def _grow(self, groups: int) -> None:
        self.count = grown(self.count, groups)
        self.pivot, self._first, self._second = (
            grown(array, groups) for array in (self.pivot, self._first, self._second)
        )

    def _set_pivots(self, group: Indices, columns: Sequence[Floats] | Floats) -> None:
        """Make the first sample of each group that had none its pivot."""
        if self.count.all():
            return
        fresh = np.flatnonzero(self.count[group] == 0)
        new, first = np.unique(group[fresh], return_index=True)
        for k, column in enumerate(columns):
            self.pivot[new, k] = column[fresh[first]]


def grown(array: NDArray[Number], groups: int) -> NDArray[Number]:
    """Return `array` (g, …), continued with zeros to `groups` entries if it has fewer."""
    added = groups - len(array)
    if added <= 0:
        return array
    return np.concatenate([array, np.zeros((added, *array.shape[1:]), dtype=array.dtype)])


def add_counts(count: Counts, group: Indices, groups: int) -> Counts:
    """Return counts (groups,) with a row for each entry of `group` (r,) added."""
    return grown(count, groups) + np.bincount(group, minlength=groups)
