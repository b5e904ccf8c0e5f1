"""Single indicator values of a sensor in an environment in constant memory: counts in narrow bins."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["BIN", "Histogram", "Singles"]

BIN = 1e-4
"""Width of a bin: the last digit of the indicator in NDI's replies in text."""
_HIGHEST = 9.9
_BINS = round(_HIGHEST / BIN) + 2  # one more for all that is beyond

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Histogram:
    """How many samples lie within half a bin of each multiple of `BIN`; the last bin holds all beyond 9.9."""

    counts: Counts

    @property
    def count(self) -> int:
        """How many samples there are."""
        return int(self.counts.sum())

    def quantile(self, share: float) -> float:
        """Return the quantile with linear interpolation, to half a bin; NaN without samples, or beyond 9.9."""
        if not self.count:
            return float("nan")
        place = share * (self.count - 1)
        ranks = np.floor(place) + 1.0, np.ceil(place) + 1.0
        low, high = np.searchsorted(np.cumsum(self.counts), ranks)
        if high == _BINS - 1:
            return float("nan")
        return float((low + (place - np.floor(place)) * (high - low)) * BIN)

    def above(self, limit: float) -> float:
        """Return the share of samples in bins above `limit`; NaN without samples, or where the limit is beyond 9.9."""
        first = int(np.floor(limit / BIN + 0.5)) + 1
        if not self.count or first >= _BINS:
            return float("nan")
        return float(self.counts[first:].sum() / self.count)


class Singles:
    """Histograms and ranges of the indicators of several sensors and environments: one for each number from 0."""

    def __init__(self) -> None:
        self._counts: Counts = np.zeros(0, dtype=np.int64)
        self._low, self._high = np.zeros(0), np.zeros(0)

    def add(self, number: Counts, values: Floats, numbers: int) -> None:
        """Count values (r,), none of them negative, under `number` (r,), all below `numbers`."""
        added = numbers - len(self._low)
        if added > 0:
            self._counts = np.concatenate([self._counts, np.zeros(added * _BINS, dtype=np.int64)])
            self._low = np.concatenate([self._low, np.full(added, np.inf)])
            self._high = np.concatenate([self._high, np.full(added, -np.inf)])
        bins = np.minimum(values * (1.0 / BIN) + 0.5, _BINS - 1).astype(np.int64)
        np.add.at(self._counts, bins + number * _BINS, 1)
        np.minimum.at(self._low, number, values)
        np.maximum.at(self._high, number, values)

    def of(self, number: int) -> tuple[Histogram, tuple[float, float]]:
        """Return the histogram, and the least and the largest value (∞ and −∞ without any)."""
        if number >= len(self._low):
            return Histogram(np.zeros(_BINS, dtype=np.int64)), (np.inf, -np.inf)
        counts = self._counts[number * _BINS : (number + 1) * _BINS]
        return Histogram(counts), (float(self._low[number]), float(self._high[number]))
