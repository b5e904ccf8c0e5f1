"""Single indicator values of a sensor in an environment in constant memory: counts in narrow bins."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["BIN", "Histogram"]

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

    @classmethod
    def empty(cls) -> "Histogram":
        """Return a histogram without samples."""
        return cls(np.zeros(_BINS, dtype=np.int64))

    def add(self, values: Floats) -> None:
        """Count values (r,), none of them negative."""
        bins = np.minimum(values * (1.0 / BIN) + 0.5, _BINS - 1).astype(np.int64)
        np.add.at(self.counts, bins, 1)

    @property
    def count(self) -> int:
        """How many samples there are."""
        return int(self.counts.sum())

    def quantile(self, share: float) -> float:
        """Return the least value, to half a bin, that `share` of the samples don't exceed; NaN without samples."""
        if not self.count:
            return float("nan")
        rank = max(1, int(np.ceil(share * self.count - 1e-9)))
        return float(np.searchsorted(np.cumsum(self.counts), rank) * BIN)

    def above(self, limit: float) -> float:
        """Return the share of samples in bins above `limit`; NaN without samples."""
        first = int(np.floor(limit / BIN + 0.5)) + 1
        return float(self.counts[first:].sum() / self.count) if self.count else float("nan")
