"""Single indicator values of a sensor in an environment in constant memory: counts in narrow bins."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.moments import grown

BIN = 1e-4
"""Width of a bin: the last digit of the indicator in NDI's replies in text."""
_HIGHEST = 9.9
_BINS = round(_HIGHEST / BIN) + 2  # one more for all that is beyond

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
_NONE: Counts = np.zeros(0, dtype=np.int64)
_NO_RANGE = (np.inf, -np.inf)


@dataclass(frozen=True, eq=False)
class Histogram:
    """How many samples lie within half a bin of each multiple of `BIN`, from 0 to the last that has some.

    All beyond 9.9 are in a bin of their own, number `_BINS` − 1.
    """

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
    """Histograms and ranges of the indicators of several sensors and environments, each of which has a number.

    One without samples takes no room, and no histogram is longer than its largest value needs.
    """

    def __init__(self) -> None:
        self._counts: dict[int, Counts] = {}
        self._ranges: dict[int, tuple[float, float]] = {}

    def add(self, number: Counts, values: Floats) -> None:
        """Count values (r,), none of them negative, under `number` (r,), from 0 and below 65536."""
        order = np.argsort(number.astype(np.uint16), kind="stable")  # in linear time, with 16 bits
        ordered = number[order]
        starts = np.flatnonzero(np.diff(ordered, prepend=-1))
        for one, rows in zip(ordered[starts].tolist(), np.split(order, starts)[1:], strict=True):
            self._add(one, values[rows])

    def _add(self, number: int, values: Floats) -> None:
        bins = np.minimum(values * (1.0 / BIN) + 0.5, _BINS - 1).astype(np.int64)
        counts = grown(self._counts.get(number, _NONE), int(bins.max()) + 1)
        np.add.at(counts, bins, 1)
        low, high = self._ranges.get(number, _NO_RANGE)
        self._counts[number] = counts
        self._ranges[number] = min(low, float(values.min())), max(high, float(values.max()))

    def of(self, number: int) -> tuple[Histogram, tuple[float, float]]:
        """Return the histogram, and the least and the largest value (∞ and −∞ without any)."""
        return Histogram(self._counts.get(number, _NONE)), self._ranges.get(number, _NO_RANGE)
