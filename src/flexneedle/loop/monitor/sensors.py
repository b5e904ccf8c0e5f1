"""The monitor of the sensors along the needle: verdicts on readings, and on each sensor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.estimation.along import Comparison
from flexneedle.types import OK, VISIBLE, CheckedReading, Reading, Verdict, VerdictKind

_OUTLIER_SDS = 5.0
_REPEATS = 10


@dataclass(frozen=True)
class SensorMonitor:
    """State of the monitor of one sensor. Frozen: `check` returns the next state.

    newest: the newest reading; repeats: readings with its rows; since: depth (mm) of the tip at the first of them.
    """

    newest: Reading | None = None
    repeats: int = 1
    since: float = 0.0
    excluded: Verdict = OK

    def repeat(self, reading: Reading, depth: float) -> "SensorMonitor":
        """Return the state with a reading, with the tip at a depth (mm)."""
        if self.newest is not None and reading.rows and reading.rows == self.newest.rows:
            return replace(self, newest=reading, repeats=self.repeats + 1)
        return replace(self, newest=reading, repeats=1, since=depth)


def check_readings(
    readings: Sequence[Reading], compared: Comparison, now: float, max_age: float
) -> tuple[CheckedReading, ...]:
    """Check readings, each beside its prediction, at a time `now` (s); max_age (s)."""
    found = []
    for one, values, sds in zip(readings, compared.value, compared.sds, strict=True):
        found.append(CheckedReading(one, _check(one, np.isfinite(values).any(), sds, now, max_age)))
    return tuple(found)


def _check(one: Reading, measured: bool, sds: np.ndarray, now: float, max_age: float) -> Verdict:
    if not math.isfinite(one.time):
        return Verdict(VerdictKind.NOT_A_NUMBER, f"time {one.time}")
    if one.status != VISIBLE or not measured:
        return Verdict(VerdictKind.MISSING, one.status if one.status != VISIBLE else "no value")
    if abs(now - one.time) > max_age:
        return Verdict(VerdictKind.STALE, f"{now - one.time:.3f} s old, limit {max_age:.3f} s")
    if (most := float(np.nanmax(np.abs(sds)))) > _OUTLIER_SDS:
        return Verdict(VerdictKind.OUTLIER, f"{most:.1f} standard deviations, limit {_OUTLIER_SDS:g}")
    return OK


def check_frozen(state: SensorMonitor, depth: float, travel_limit: float, resolution: float) -> Verdict:
    """Refuse a sensor whose readings repeat while the tip travels, unless its values have steps."""
    travel = abs(depth - state.since)
    if resolution > 0.0 or state.repeats < _REPEATS or travel <= travel_limit:
        return OK
    return Verdict(
        VerdictKind.FROZEN, f"{state.repeats} identical readings while the tip travelled {travel:.1f} mm"
    )
