"""Separation of two environments by a threshold of the indicator."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import P95
from flexneedle.lab.tracker_evaluation.evaluation.indicator import ConstantFit, LineFit, constant, line, means
from flexneedle.lab.tracker_evaluation.evaluation.intervals import Interval, bootstrap, quantile_interval
from flexneedle.lab.tracker_evaluation.table.grid import Grid

_MOST_FOR_AREA = 2000

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Confusion:
    """Numbers of grid points above and not above a threshold in both environments."""

    ideal_below: int
    ideal_above: int
    noisy_below: int
    noisy_above: int

    @property
    def false_alarms(self) -> float:
        """Share of the points of `ideal` above the threshold."""
        return _share(self.ideal_above, self.ideal_below)

    @property
    def detected(self) -> float:
        """Share of the points of `noisy` above the threshold."""
        return _share(self.noisy_above, self.noisy_below)


@dataclass(frozen=True, eq=False)
class Separation:
    """Analysis of a sensor's mean indicator at grid points; None for what needs a missing environment.

    threshold: 95th percentile in `ideal`. samples_threshold: the same for single samples, which a monitor has;
    samples_above: share of single samples above `threshold` in `ideal` and `noisy`. auc: area under the ROC curve.
    false_alarms, detected (k,): the ROC curve, from (0, 0) to (1, 1).
    """

    sensor: str
    ideal: ConstantFit | None
    noisy: LineFit | None
    threshold: float | None
    threshold_interval: Interval
    samples_threshold: float | None
    samples_above: tuple[float | None, float | None]
    confusion: Confusion | None
    auc: float | None
    auc_interval: Interval
    false_alarms: Floats
    detected: Floats


def separation(sensor: str, ideal: Grid | None, noisy: Grid | None) -> Separation | None:
    """Return the analysis of a sensor's indicator in one or two environments, None without any indicator."""
    low, low_error = means(ideal) if ideal else (np.empty(0), np.empty(0))
    high, high_error = means(noisy) if noisy else (np.empty(0), np.empty(0))
    if not len(low) and not len(high):
        return None
    threshold = float(np.quantile(low, P95)) if len(low) else None
    both = bool(len(low) and len(high))
    false_alarms, detected = roc(low, high) if both else (np.empty(0), np.empty(0))
    return Separation(
        sensor,
        constant(low_error) if len(low) else None,
        line(high, high_error) if len(high) else None,
        threshold,
        quantile_interval(low, P95),
        ideal.histogram.quantile(P95) if ideal and len(low) else None,
        (_above(ideal, threshold), _above(noisy, threshold)),
        _confusion(low, high, threshold) if both and threshold is not None else None,
        float(area(low, high)) if both else None,
        _area_interval(low, high) if both else None,
        false_alarms,
        detected,
    )


def roc(low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the shares (k,) of `low` and of `high` above each threshold, from (0, 0) to (1, 1).

    Points on a straight line between their neighbours are omitted.
    """
    levels = np.concatenate([np.unique(np.concatenate([low, high]))[::-1], [-np.inf]])
    shares = (
        1.0 - np.searchsorted(np.sort(values), levels, side="right") / len(values) for values in (low, high)
    )
    false_alarms, detected = shares
    across, up = np.diff(false_alarms), np.diff(detected)
    corner = np.abs(across[1:] * up[:-1] - across[:-1] * up[1:]) > 1e-12
    kept = np.concatenate([[True], corner, [True]])
    return false_alarms[kept], detected[kept]


def area(low: Floats, high: Floats, axis: int = -1) -> Floats:
    """Return the area (…) under the ROC of values (…, n) and (…, m): the share of pairs with `high` above `low`, ties
    counted half (Mann and Whitney 1947).
    """
    from scipy import stats

    pairs = low.shape[axis] * high.shape[axis]
    won: Floats = stats.mannwhitneyu(high, low, axis=axis, method="asymptotic").statistic / pairs
    return won


def _confusion(low: Floats, high: Floats, threshold: float) -> Confusion:
    first, second = int((low > threshold).sum()), int((high > threshold).sum())
    return Confusion(len(low) - first, first, len(high) - second, second)


def _area_interval(low: Floats, high: Floats) -> Interval:
    """Return the interval of the area; None for perfect separation, and for few or very many points.

    With perfect separation each resample is perfect, too.
    """
    if max(len(low), len(high)) > _MOST_FOR_AREA or area(low, high) in (0.0, 1.0):
        return None
    return bootstrap(area, low, high, paired=False)


def _above(grid: Grid | None, threshold: float | None) -> float | None:
    if grid is None or threshold is None or not grid.histogram.count:
        return None
    return grid.histogram.above(threshold)


def _share(one: int, other: int) -> float:
    return one / (one + other) if one + other else nan
