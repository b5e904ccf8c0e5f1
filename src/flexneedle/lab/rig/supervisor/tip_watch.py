"""Watch over the tip: the tracker's readings, checked by the loop's monitor against the expected path of a step."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from flexneedle.lab.rig.supervisor.protocol import Expectation, SupervisorTask
from flexneedle.loop.monitor import rules
from flexneedle.loop.monitor.monitor import Monitor, TipAt
from flexneedle.phantom.tracking.stage import tip_on_stage
from flexneedle.ports import Tracker
from flexneedle.types import OK, VISIBLE, Measurement, Point, Verdict, VerdictKind

_NEVER = (VerdictKind.NOT_A_NUMBER, VerdictKind.STALE)  # never good, whatever is expected
_LOST = (VerdictKind.MISSING, VerdictKind.STALE)  # nothing against what is expected
_DISTORTED = (VerdictKind.FIELD_DISTORTED,)  # readings count with an error that the closed loop knows


@dataclass(frozen=True)
class TipWatch:
    """State of the check: the monitor, the expectation from `begun` to `ended` (s), and the last verdicts.

    Before and after these times the tip is expected at rest. since: time of the newest readings, at first the begin
    of the watch; verdict: on the readings; field: verdict on the field, since the first step. Each change returns a new
    state.
    """

    monitor: Monitor
    stale_after: float
    since: float
    expected: Expectation | None = None
    begun: float = 0.0
    ended: float = 0.0
    newest: Measurement | None = None
    verdict: Verdict = OK
    field: Verdict = OK

    def with_expectation(self, expected: Expectation, begun: float, ended: float) -> "TipWatch":
        """Return the watch with another expectation; after an innovation it judges the newest reading again."""
        watch = replace(self, expected=expected, begun=begun, ended=ended)
        if self.verdict.kind is not VerdictKind.INNOVATION or self.newest is None:
            return watch
        place = [value for value in (self.newest.x, self.newest.y, self.newest.z) if value is not None]
        axes = min(len(place), 1 + self.monitor.axes)
        again = rules.check_innovation(tuple(place[:axes]), expected.begin[:axes], expected.most_off)
        return replace(watch, verdict=again)

    @property
    def permission(self) -> Verdict:
        """The verdict on field or readings that holds the needle, else OK.

        With a sensor along the needle that measures it, a lost tracker does not, nor a distorted field if the scenario
        has the error of readings by the indicators.
        """
        known = _DISTORTED if self.monitor.settings.indicator_error_mm > 0.0 else ()
        excused = (*_LOST, *known) if self.expected is not None and self.expected.sensed else ()
        return rules.first_bad(one for one in (self.field, self.verdict) if one.kind not in excused)

    def with_later_end(self, now: float, seconds: float) -> "TipWatch":
        """Extend the expected motion by `seconds`."""
        return replace(self, ended=self.ended + seconds) if now < self.ended and seconds > 0.0 else self

    def with_rest(self, now: float) -> "TipWatch":
        """Return the watch with the needle stopped at its expected position."""
        if self.expected is None:
            return self
        here = self._tip_at(now)
        return replace(self, expected=replace(self.expected, begin=here, end=here))

    def with_readings(self, measurements: Sequence[Measurement], now: float, status: str) -> "TipWatch":
        """Return the watch after the readings of a tick, oldest first. status: of the tracker."""
        if self.expected is None:
            return self._with_first_readings(measurements, now)
        monitor, verdict = self.monitor, OK
        for one in measurements:
            monitor, verdict = monitor.check(one, self._tip_at, now, self.stale_after, self.expected.most_off)
            if monitor.last_good_before_dropout(one, verdict) is not None:
                verdict = OK
        if measurements:
            monitor, field = monitor.check_field()
            newest = measurements[-1]
            return replace(self, monitor=monitor, verdict=verdict, field=field, newest=newest, since=now)
        return replace(self, verdict=self._verdict_without_readings(now, status))

    def _with_first_readings(self, measurements: Sequence[Measurement], now: float) -> "TipWatch":
        """Return the watch after readings before the first step: they fill the monitor's windows.

        Nothing is expected yet, and only a newest reading that is not a number, repeated or stale is rejected, so
        that no step begins on it.
        """
        monitor, verdict = self.monitor, OK
        for one in measurements:
            here = _fixed_tip((one.x or 0.0, one.y or 0.0, one.z or 0.0))
            monitor, verdict = monitor.check(one, here, now, self.stale_after, math.inf)
        if measurements:
            monitor, _ = monitor.check_field()
            verdict = verdict if verdict.kind in _NEVER else OK
            return replace(self, monitor=monitor, verdict=verdict, newest=measurements[-1], since=now)
        return self

    def _verdict_without_readings(self, now: float, status: str) -> Verdict:
        """Return the verdict of a tick without a new reading: unchanged until the last reading is too old."""
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


def _fixed_tip(place: Point) -> TipAt:
    """Return a tip that is expected at one position at any time."""
    return lambda _: place


class TrackedTip:
    """Tracker of a task, its measurements since the last report, and their watch. now: s on the run's clock."""

    def __init__(self, task: SupervisorTask, tracker: Tracker, now: float) -> None:
        self._task, self._tracker = task, tracker
        self._watch = TipWatch(Monitor(task.monitor, task.lateral_axes), task.stale_after, now)
        self._measurements: tuple[Measurement, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Of the last readings, or of their absence; see `TipWatch.permission`."""
        return self._watch.permission

    @property
    def status(self) -> str:
        """Of the tracker."""
        return self._tracker.status

    def read(self, now: float) -> None:
        """Read the tracker, and check its readings. Raises DriverError."""
        task = self._task
        found = tuple(tip_on_stage(frame, task.to_stage, task.tip_offset) for frame in self._tracker.read())
        self._measurements += found
        self._watch = self._watch.with_readings(found, now, self.status)

    def take(self) -> tuple[Measurement, ...]:
        """Return the measurements since the last call, oldest first."""
        found, self._measurements = self._measurements, ()
        return found

    def expect(self, expected: Expectation, begun: float, ended: float) -> None:
        """Expect a travel from `begun` to `ended` (s)."""
        self._watch = self._watch.with_expectation(expected, begun, ended)

    def expect_start(self, expected: Expectation, now: float) -> None:
        """Expect the tip at the start of a travel, and check the newest reading again."""
        there = replace(expected, end=expected.begin)
        self._watch = self._watch.with_expectation(there, now, now).with_readings((), now, self.status)

    def wait(self, now: float, seconds: float) -> None:
        """Delay the end of the travel under way by `seconds`."""
        self._watch = self._watch.with_later_end(now, seconds)

    def stop(self, now: float) -> None:
        """Expect the tip to rest from now on."""
        self._watch = self._watch.with_rest(now)
