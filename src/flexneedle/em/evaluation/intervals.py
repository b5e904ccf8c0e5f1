"""Bootstrap intervals over grid points: what other grid points of the same kind would have given.

Grid points are drawn again, with all their samples, since samples at one point share its error. The interval takes
the points for independent draws from the volume. Errors of a smooth field are alike at neighbours, so it is too
narrow where the field changes little from point to point; and it says nothing about another day or another room.
"""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

CONFIDENCE, RESAMPLES, SEED = 0.95, 2000, 0
LEAST_POINTS = 10
"""With fewer there is no interval: that of a few would be far too narrow."""
_CHUNK = 4_000_000  # indices held in memory at once

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Interval = tuple[float, float] | None
Statistic = Callable[[Indices], Floats]
"""From the points of b samples (b, n) to the value of the statistic in each (b,)."""


def intervals(statistics: Mapping[str, Statistic], points: int, seed: int = SEED) -> dict[str, Interval]:
    """Return the 95 % percentile interval of each statistic of `points` points, None if they are too few."""
    if points < LEAST_POINTS:
        return dict.fromkeys(statistics)
    drawn: dict[str, list[Floats]] = {name: [] for name in statistics}
    for chosen in _samples(points, seed):
        for name, statistic in statistics.items():
            drawn[name].append(statistic(chosen))
    return {name: ends(np.concatenate(values)) for name, values in drawn.items()}


def quantile_interval(values: Floats, share: float) -> Interval:
    """Return a 95 % interval of the quantile at `share` of what values (n,) were drawn from, None if they are too few.

    It ends at order statistics, and so holds for any distribution (Conover 1999, section 3.2): a bootstrap of a far
    quantile is too narrow. The upper end is infinite where even the largest value may lie below the quantile, which
    for 95 % is so with fewer than 72 points.
    """
    count = len(values)
    if count < LEAST_POINTS:
        return None
    tail = (1.0 - CONFIDENCE) / 2.0
    below = _binomial(count, share)  # k: chance that at most k of the values are below the quantile
    lower = int(np.searchsorted(below, tail, side="right"))
    upper = int(np.searchsorted(below, 1.0 - tail)) + 1
    ends = np.concatenate([[-np.inf], np.sort(values), [np.inf]])
    return float(ends[lower]), float(ends[upper])


def _binomial(count: int, share: float) -> Floats:
    """Return the cumulative binomial distribution (count + 1,), 0 < share < 1."""
    k = np.arange(count)
    steps = np.log((count - k) / (k + 1.0)) + np.log(share / (1.0 - share))
    logs = np.concatenate([[0.0], np.cumsum(steps)])
    chances = np.exp(logs - logs.max())
    return np.asarray(np.cumsum(chances / chances.sum()))


def _samples(points: int, seed: int) -> Iterator[Indices]:
    rng = np.random.default_rng(seed)
    most = max(1, _CHUNK // points)
    for start in range(0, RESAMPLES, most):
        yield rng.integers(0, points, (min(most, RESAMPLES - start), points))


def ends(values: Floats) -> Interval:
    """Return the 95 % percentile interval of what samples drawn again gave (b,); NaN among them are left out."""
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.nanquantile(values, (tail, 1.0 - tail)).tolist()
    return low, high
