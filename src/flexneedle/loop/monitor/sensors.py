"""The monitor of the sensors along the needle: verdicts on readings, and on each sensor.

A reading far from its prediction is an outlier, and readings that repeat while the needle moves are frozen. A sensor
that contradicts the others is found by the fit (`flexneedle.loop.fusing`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from flexneedle.estimation.along import Comparison
from flexneedle.types import OK, VISIBLE, CheckedReading, Floats, Reading, Verdict, VerdictKind

_OUTLIER_SDS = 6.0
_REPEATS = 10
_WINDOW = 8  # periods
_SURPRISE = 2.0  # normalised square of the innovation


@dataclass(frozen=True)
class SensorMonitor:
    """State of the monitor of one sensor. Frozen: each method returns the next state.

    newest: the newest reading; repeats: readings with its rows; since: depth (mm) of the tip at the first of them;
    nis: normalised squares of the innovations of the last periods; excluded: why the sensor does not count any more;
    heard: time (s) of the last good reading, 0 before the first.
    """

    newest: Reading | None = None
    repeats: int = 1
    since: float = 0.0
    nis: tuple[float, ...] = ()
    excluded: Verdict = OK
    heard: float = 0.0

    def hear(self, times: Iterable[float]) -> "SensorMonitor":
        """Return the state with the times (s) of good readings."""
        return replace(self, heard=max([self.heard, *times]))

    def innovate(self, nis: float) -> "SensorMonitor":
        """Return the state with the innovation of a period; NaN is none."""
        return self if math.isnan(nis) else replace(self, nis=(*self.nis, nis)[-_WINDOW:])

    @property
    def surprised(self) -> bool:
        """True if the last innovations are improbably large: their median, since the needle itself may leap."""
        return len(self.nis) == _WINDOW and median(self.nis) > _SURPRISE

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
    readings: Sequence[Reading], compared: Comparison, now: float, max_age: float
) -> tuple[CheckedReading, ...]:
    """Check readings, each beside its prediction, at a time `now` (s); max_age (s)."""
    return tuple(
        CheckedReading(one, _check(one, sds[np.isfinite(values)], now, max_age))
        for one, values, sds in zip(readings, compared.value, compared.sds, strict=True)
    )


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
