"""95 % intervals over grid points: what other grid points of the same kind would have given.

Grid points are drawn again, with all their samples, since samples at one point share its error. The interval takes
the points for independent draws from the volume. Errors of a smooth field are alike at neighbours, so it is too
narrow where the field changes little from point to point; and it covers neither another day nor another room.
"""

from collections.abc import Callable
from math import isnan

import numpy as np
from numpy.typing import NDArray

CONFIDENCE, RESAMPLES, SEED = 0.95, 2000, 0
LEAST_POINTS = 10
"""With fewer there is no interval: that of a few would be far too narrow."""
_CHUNK = 4_000_000  # numbers held in memory at once

Floats = NDArray[np.float64]
Interval = tuple[float, float] | None
Statistic = Callable[..., Floats]
"""From samples (…, n) and the keyword axis=-1 to the value of the statistic of each (…)."""


def mean(values: Floats, axis: int = -1) -> Floats:
    """Return the means (…) of values (…, n)."""
    return np.asarray(values.mean(axis=axis))


def deviation(values: Floats, axis: int = -1) -> Floats:
    """Return the standard deviations (…) of values (…, n), with n − 1."""
    return np.asarray(values.std(axis=axis, ddof=1))


def bootstrap(statistic: Statistic, *samples: Floats, paired: bool = True) -> Interval:
    """Return the percentile interval of a statistic of samples (n,), None for fewer than ten points.

    paired: the same points are drawn of each sample; otherwise each is drawn for itself.
    """
    from scipy import stats

    if min(map(len, samples)) < LEAST_POINTS:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = stats.bootstrap(
            samples,
            statistic,
            n_resamples=RESAMPLES,
            batch=max(1, _CHUNK // max(map(len, samples))),
            vectorized=True,
            paired=paired,
            confidence_level=CONFIDENCE,
            method="percentile",
            rng=np.random.default_rng(SEED),
        ).bootstrap_distribution
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.nanquantile(drawn, (tail, 1.0 - tail)).tolist()
    return low, high


def quantile_interval(values: Floats, share: float) -> Interval:
    """Return an interval of the quantile at `share` of what values (n,) were drawn from, None if they are too few.

    It ends at order statistics, and so holds for any distribution (Conover 1999, section 3.2): a bootstrap of a far
    quantile is too narrow. The upper end is infinite where even the largest value may be below the quantile, which
    for 95 % is so with fewer than 72 points.
    """
    from scipy import stats

    if len(values) < LEAST_POINTS:
        return None
    low, high = stats.quantile_test(values, p=share).confidence_interval(CONFIDENCE)
    return (-np.inf if isnan(low) else float(low)), (np.inf if isnan(high) else float(high))
