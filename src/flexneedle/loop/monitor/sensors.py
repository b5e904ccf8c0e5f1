"""The monitor of the sensors along the needle: verdicts on readings, and on each sensor.

A reading far from its prediction is an outlier, and readings that repeat while the needle moves are frozen. Outliers
one after another are no chance, and are used: a sensor that contradicts the others is found by the fit
(`flexneedle.loop.fusing`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.estimation.along import Comparison
from flexneedle.types import OK, VISIBLE, CheckedReading, Floats, Reading, Verdict, VerdictKind

_OUTLIER_SDS = 6.0
_MOST_OUTLIERS = 6  # one after another; later ones are no chance
_REPEATS = 10


@dataclass(frozen=True)
class SensorMonitor:
    """State of the monitor of one sensor. Frozen: each method returns the next state.

    newest: the newest reading; repeats: readings with its rows; since: depth (mm) of the tip at the first of them;
    outliers: number of the last readings, one after another, far from their predictions; excluded: why the sensor does
    not count any more; heard: time (s) of the last reading that is good, or that has no needle where none is; measured:
    true after the first good one.
    """

    newest: Reading | None = None
    repeats: int = 1
    since: float = 0.0
    outliers: int = 0
    excluded: Verdict = OK
    heard: float = -math.inf
    measured: bool = False

    def hear(self, good: Sequence[float], empty: Sequence[float] = ()) -> "SensorMonitor":
        """Return the state with the times (s) of good readings, and of those that have no needle where none is."""
        heard, measured = max([self.heard, *good, *empty]), self.measured or bool(good)
        return replace(self, heard=heard, measured=measured)

    def add(self, readings: Sequence[Reading], depth: float) -> "SensorMonitor":
        """Return the state with readings, with the tip at a depth (mm)."""
        state = self
        for one in readings:
            if state.newest is not None and one.rows and one.rows == state.newest.rows:
                state = replace(state, newest=one, repeats=state.repeats + 1)
            elif one.rows:
                state = replace(state, newest=one, repeats=1, since=depth)
        return state

    def check_frozen(self, depth: float, travel_limit: float, resolution: float) -> Verdict:
        """Refuse readings that repeat while the tip travels, unless the sensor's values have steps."""
        travel = abs(depth - self.since)
        if resolution > 0.0 or self.repeats < _REPEATS or travel <= travel_limit:
            return OK
        reason = f"{self.repeats} identical readings while the tip travelled {travel:.1f} mm"
        return Verdict(VerdictKind.FROZEN, reason)


def check_readings(
    monitor: SensorMonitor, readings: Sequence[Reading], compared: Comparison, now: float, max_age: float
) -> tuple[SensorMonitor, tuple[CheckedReading, ...]]:
    """Check readings, each beside its prediction, at a time `now` (s); max_age (s)."""
    checked = []
    for one, values, sds in zip(readings, compared.value, compared.sds, strict=True):
        verdict = _check(one, sds[np.isfinite(values)], now, max_age)
        if verdict.ok:
            monitor = replace(monitor, outliers=0)
        elif verdict.kind is VerdictKind.OUTLIER:
            monitor = replace(monitor, outliers=monitor.outliers + 1)
            verdict = OK if monitor.outliers > _MOST_OUTLIERS else verdict
        checked.append(CheckedReading(one, verdict))
    return monitor, tuple(checked)


def _check(one: Reading, sds: Floats, now: float, max_age: float) -> Verdict:
    """Check a reading with values (n,) in standard deviations from their predictions."""
    if not math.isfinite(one.time):
        return Verdict(VerdictKind.NOT_A_NUMBER, f"time {one.time}")
    if one.status != VISIBLE or not sds.size:
        return Verdict(VerdictKind.MISSING, one.status if one.status != VISIBLE else "no value")
    if abs(now - one.time) > max_age:
        return Verdict(VerdictKind.STALE, f"{now - one.time:.3f} s old, limit {max_age:.3f} s")
    if (most := float(np.abs(sds).max())) > _OUTLIER_SDS:
        return Verdict(VerdictKind.OUTLIER, f"{most:.1f} standard deviations, limit {_OUTLIER_SDS:.1f}")
    return OK
