"""The tick's check of the tracker: the loop's monitor, with the path that is expected during a step."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from flexneedle.lab.rig.supervisor.messages import Expectation
from flexneedle.loop.monitor import rules
from flexneedle.loop.monitor.monitor import Monitor, TipAt
from flexneedle.types import OK, VISIBLE, Measurement, Point, Verdict, VerdictKind

_NEVER = (VerdictKind.NOT_A_NUMBER, VerdictKind.STALE)  # whatever is expected


@dataclass(frozen=True)
class Watch:
    """The monitor, what is expected from `begun` to `ended` (s) and at rest before and after, and the last verdict.

    Frozen: `after` returns the next one. since: when the newest readings came, at first when it began to watch.
    """

    monitor: Monitor
    stale_after: float
    since: float
    expected: Expectation | None = None
    begun: float = 0.0
    ended: float = 0.0
    newest: Measurement | None = None
    verdict: Verdict = OK

    def expecting(self, expected: Expectation, begun: float, ended: float) -> "Watch":
        """With another expectation, by which the newest reading is judged if it was far from the one before."""
        watch = replace(self, expected=expected, begun=begun, ended=ended)
        if self.verdict.kind is not VerdictKind.INNOVATION or self.newest is None:
            return watch
        place = [value for value in (self.newest.x, self.newest.y, self.newest.z) if value is not None]
        axes = min(len(place), 1 + self.monitor.axes)
        again = rules.innovation(tuple(place[:axes]), expected.begin[:axes], expected.most_off)
        return replace(watch, verdict=again)

    def waiting(self, now: float, seconds: float) -> "Watch":
        """With the end of what is expected now later by `seconds`."""
        return replace(self, ended=self.ended + seconds) if now < self.ended and seconds > 0.0 else self

    def at_rest(self, now: float) -> "Watch":
        """With the needle stopped where it is expected now."""
        if self.expected is None:
            return self
        here = self._tip_at(now)
        return replace(self, expected=replace(self.expected, begin=here, end=here))

    def after(self, measurements: Sequence[Measurement], now: float, status: str) -> "Watch":
        """After the readings of a tick, oldest first. status: of the tracker."""
        if self.expected is None:
            return self._before(measurements, now)
        monitor, verdict = self.monitor, OK
        for one in measurements:
            monitor, verdict = monitor.check(one, self._tip_at, now, self.stale_after, self.expected.most_off)
            if monitor.last_good_before_dropout(one, verdict) is not None:
                verdict = OK
        if measurements:
            monitor, field = monitor.check_field()
            verdict = field if not field.ok else verdict
            return replace(self, monitor=monitor, verdict=verdict, newest=measurements[-1], since=now)
        return replace(self, verdict=self._without(now, status))

    def _before(self, measurements: Sequence[Measurement], now: float) -> "Watch":
        """Before the first step nothing is expected: the readings fill the monitor's windows.

        Only a newest reading that is not a number, repeated or stale is rejected, so that a step does not begin on it.
        """
        monitor, verdict = self.monitor, OK
        for one in measurements:
            here = _always((one.x or 0.0, one.y or 0.0, one.z or 0.0))
            monitor, verdict = monitor.check(one, here, now, self.stale_after, math.inf)
        if measurements:
            monitor, _ = monitor.check_field()
            verdict = verdict if verdict.kind in _NEVER else OK
            return replace(self, monitor=monitor, verdict=verdict, newest=measurements[-1], since=now)
        return self

    def _without(self, now: float, status: str) -> Verdict:
        """The verdict of a tick without a new reading: the one before, until the last one came too long ago."""
        if not self.verdict.ok or now - self.since <= self.stale_after:
            return self.verdict
        reason = "" if status == VISIBLE else f" ({status})"
        return Verdict(VerdictKind.MISSING, f"no reading for {now - self.since:.2f} s{reason}")

    def _tip_at(self, time: float) -> Point:
        if self.expected is None:
            raise ValueError("nothing is expected")
        share = (
            1.0 if time >= self.ended else max(0.0, time - self.begun) / max(self.ended - self.begun, 1e-9)
        )
        x, y, z = (
            begin + share * (end - begin)
            for begin, end in zip(self.expected.begin, self.expected.end, strict=True)
        )
        return x, y, z


def _always(place: Point) -> TipAt:
    """A tip that is expected at one place at any time."""
    return lambda _: place
