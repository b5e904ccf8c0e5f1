"""95 % confidence intervals over grid points.

Grid points are resampled with all their samples, since samples at one point share its error. The intervals assume that
the points are independent draws from the volume. The errors of a smooth field are correlated at neighbouring points, so
an interval is too narrow if the field changes little from point to point. It covers no other day and no other room.
"""

from collections.abc import Callable
from math import isnan

import numpy as np
from numpy.typing import NDArray

CONFIDENCE, RESAMPLES, SEED = 0.95, 2000, 0
LEAST_POINTS = 10
"""Fewest points for an interval; with fewer it would be far too narrow."""
_CHUNK = 4_000_000  # numbers held in memory at once

Floats = NDArray[np.float64]
Interval = tuple[float, float] | None
Statistic = Callable[..., Floats]
"""Function of samples (…, n) and the keyword axis=-1 that returns the statistic (…)."""


def mean(values: Floats, axis: int = -1) -> Floats:
    """Return the means (…) of values (…, n)."""
    return np.asarray(values.mean(axis=axis))


def deviation(values: Floats, axis: int = -1) -> Floats:
    """Return the standard deviations (…) of values (…, n), with n − 1."""
    return np.asarray(values.std(axis=axis, ddof=1))


def bootstrap(statistic: Statistic, *samples: Floats, paired: bool = True) -> Interval:
    """Return the percentile interval of a statistic of samples (n,), None for fewer than ten points.

    paired: the same points are drawn from all samples; otherwise each sample is resampled independently.
    """
    from scipy import stats

    if min(map(len, samples)) < LEAST_POINTS:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = stats.bootstrap(
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
    low, high = np.nanquantile(resampled, (tail, 1.0 - tail)).tolist()
    return low, high


def quantile_interval(values: Floats, share: float) -> Interval:
    """Return the interval of the quantile at `share` from values (n,), None for fewer than ten.

    Its ends are order statistics, valid for any distribution (Conover 1999, section 3.2); a bootstrap of an extreme
    quantile is too narrow. The upper end is infinite if the quantile may exceed the largest value, which for 95 % is
    the case with fewer than 72 points.
    """
    from scipy import stats

    if len(values) < LEAST_POINTS:
        return None
    low, high = stats.quantile_test(values, p=share).confidence_interval(CONFIDENCE)
    return (-np.inf if isnan(low) else float(low)), (np.inf if isnan(high) else float(high))
