"""Statistics of many insertions, with percentile bootstrap intervals.

Insertions with the same seed have the same virtual phantom, so seeds are resampled with all their insertions (a
cluster bootstrap: Davison and Hinkley 1997, section 3.8). If every insertion has its own seed, that is the ordinary
bootstrap. Quantiles are by linear interpolation between the order statistics: the value at rank (n − 1) q, counted
from 0 (Hyndman and Fan 1996, definition 7; NumPy's default).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
Statistic = Callable[[Counts], Floats]
"""Maps the multiplicity of each row in b samples, (b, n), to the statistic of each sample, (b,)."""

LEAST_CLUSTERS = 10
RESAMPLES, CONFIDENCE, SEED = 2000, 0.95, 0
_CHUNK = 2_000_000  # multiplicities in memory at once


@dataclass(frozen=True)
class IntervalEstimate:
    """A value with the ends of its confidence interval; NaN if unknown."""

    value: float
    low: float = nan
    high: float = nan


def mean(values: Floats) -> Statistic:
    """Return the mean of values (n,), ignoring NaN."""
    known, filled = _split_known(values)

    def statistic(counts: Counts) -> Floats:
        return _divide((counts * filled).sum(axis=1), (counts * known).sum(axis=1))

    return statistic


def sd(values: Floats) -> Statistic:
    """Return the standard deviation of values (n,) with n − 1 in the denominator, ignoring NaN."""
    known, filled = _split_known(values)

    def statistic(counts: Counts) -> Floats:
        n = (counts * known).sum(axis=1)
        centre = _divide((counts * filled).sum(axis=1), n)
        square = (counts * known * (filled - centre[:, None]) ** 2).sum(axis=1)
        return np.sqrt(_divide(square, n - 1))

    return statistic


def quantile(values: Floats, share: float) -> Statistic:
    """Return the quantile at `share` (0 to 1) of values (n,), ignoring NaN."""
    order = np.argsort(values, kind="stable")[: np.count_nonzero(~np.isnan(values))]
    ordered = np.append(values[order], nan)  # NaN: the sample has no known value

    def statistic(counts: Counts) -> Floats:
        up_to = np.cumsum(counts[:, order], axis=1)
        n = counts[:, order].sum(axis=1)
        rank = np.maximum(n - 1, 0) * share
        below = np.floor(rank)
        low, high = (ordered[(up_to <= r[:, None]).sum(axis=1)] for r in (below, np.ceil(rank)))
        return np.asarray(low + (rank - below) * (high - low))

    return statistic


def geometric_mean(values: Floats) -> Statistic:
    """Return the geometric mean of values (n,), ignoring NaN and values that are not positive."""
    average = mean(np.log(np.where(values > 0.0, values, nan)))
    return lambda counts: np.exp(average(counts))


def ratio(over: Floats, under: Floats) -> Statistic:
    """Return the ratio of the means of two columns (n,) over the rows with both known."""
    both = np.isnan(over) | np.isnan(under)
    one, other = (mean(np.where(both, nan, values)) for values in (over, under))
    return lambda counts: _divide(one(counts), other(counts))


def estimate_all(
    statistics: Mapping[str, Statistic],
    clusters: NDArray[np.int64],
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> dict[str, IntervalEstimate]:
    """Return each statistic of n rows with its percentile bootstrap interval.

    clusters (n,): rows with the same number, 0 to c − 1, are drawn together. All statistics use the same samples.
    With fewer than `LEAST_CLUSTERS` there is no interval (NaN): a percentile bootstrap of a few is far too narrow.
    """
    once = np.ones((1, len(clusters)), dtype=np.int64)
    values = {name: float(statistic(once)[0]) for name, statistic in statistics.items()}
    if len(np.unique(clusters)) < LEAST_CLUSTERS:
        return {name: IntervalEstimate(value) for name, value in values.items()}
    drawn: dict[str, list[Floats]] = {name: [] for name in statistics}
    for counts in _draw_samples(clusters, resamples, np.random.default_rng(seed)):
        for name, statistic in statistics.items():
            drawn[name].append(statistic(counts))
    return {
        name: IntervalEstimate(values[name], *_find_ends(np.concatenate(found)))
        for name, found in drawn.items()
    }


def bound_share_beyond(count: int, confidence: float = CONFIDENCE) -> float:
    """Return an upper bound on the share of all insertions beyond the largest of `count` independent ones.

    It holds with this confidence: 1 − (1 − confidence)^(1/count) (Wilks 1941). NaN for a count of 0.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / count) if count else nan


def _draw_samples(clusters: Counts, resamples: int, rng: np.random.Generator) -> Iterator[Counts]:
    """Yield the multiplicity of each row in each sample, (b, n), for `resamples` samples in total."""
    number = int(clusters.max()) + 1
    most = max(1, _CHUNK // max(number, len(clusters)))
    for start in range(0, resamples, most):
        size = min(most, resamples - start)
        chosen = rng.integers(0, number, (size, number)) + number * np.arange(size)[:, None]
        yield np.bincount(chosen.ravel(), minlength=size * number).reshape(size, number)[:, clusters]


def _find_ends(values: Floats) -> tuple[float, float]:
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return nan, nan
    tail = (1.0 - CONFIDENCE) / 2
    low, high = np.quantile(values, (tail, 1.0 - tail)).tolist()
    return low, high


def _split_known(values: Floats) -> tuple[Counts, Floats]:
    known = ~np.isnan(values)
    return known.astype(np.int64), np.where(known, values, 0.0)


def _divide(over: Floats, under: NDArray[np.float64] | Counts) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(under) > 0, over / under, nan)
