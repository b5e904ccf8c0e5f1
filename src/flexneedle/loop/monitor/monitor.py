"""The monitor of the tracker: recent readings, and verdicts on new readings and on the field."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from flexneedle.loop.monitor import rules
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import OK, TIP, Frame, Measurement, Point, Verdict, VerdictKind

TipAt = Callable[[float], Point]
"""Predicted position of the tip (mm) at a time (s)."""


def field_verdict(frames: Sequence[Frame], settings: MonitorSettings, distorted: bool = False) -> Verdict:
    """Check the field by all sensors of `frames` (oldest first) except the tip.

    A minimum number of sensors must be references. Only the frames of the last window count, and only sensors with an
    indicator in at least half of these frames: a median over a few readings would be no better than a single reading.
    distorted: true after a distorted field, until the indicators fall below the lower limit.
    """
    window = settings.indicator_window_s
    recent = _within(frames, window)
    indicators = _indicators(recent)
    limit = settings.indicator_limit * (settings.resume_fraction if distorted else 1.0)
    return rules.first_bad(
        (
            rules.check_missing_references(indicators, settings.references, window, recent[-1].readings),
            rules.check_too_short(_covered_time(recent), window / 2, settings.references),
            rules.check_distortion(indicators, limit, window, distorted),
        )
    )


def is_distorted(verdict: Verdict, before: bool) -> bool:
    """Return whether the field is still distorted after a verdict: once distorted, until a verdict is OK."""
    return verdict.kind is VerdictKind.FIELD_DISTORTED or (before and not verdict.ok)


def _covered_time(frames: Sequence[Frame]) -> float:
    """Return the time (s) that frames cover; a gap counts as one frame period."""
    steps = [later.time - earlier.time for earlier, later in pairwise(frames)]
    return len(steps) * median(steps) if steps else 0.0


def _within(frames: Sequence[Frame], window: float) -> list[Frame]:
    since = frames[-1].time - window + 1e-9
    return [frame for frame in frames if frame.time > since]


def _indicators(frames: Sequence[Frame]) -> dict[str, list[float]]:
    """Return the indicators of each sensor that has one in at least half of the frames, except the tip."""
    found: dict[str, list[float]] = {}
    for frame in frames:
        for name, reading in frame.readings.items():
            if name != TIP and rules.has_indicator(reading):
                found.setdefault(name, []).append(reading.indicator or 0.0)
    return {name: values for name, values in found.items() if 2 * len(values) >= len(frames)}


@dataclass(frozen=True)
class _Repeats:
    """Successive readings with the same position.

    Their number, the time (s) of the newest, and the predicted travel of the tip (mm) since the first.
    """

    position: rules.Position
    time: float
    count: int = 1
    travel: float = 0.0

    def extend(self, time: float, tip_at: TipAt) -> "_Repeats":
        """Return the repeats with one more reading.

        Both ends of the travel are from one estimate: corrections do not count as travel.
        """
        travel = self.travel + math.dist(tip_at(self.time), tip_at(time))
        return _Repeats(self.position, time, self.count + 1, travel)


@dataclass(frozen=True)
class _Jump:
    """A jump that no later reading has revoked: the largest distance (mm) from the last good reading at its time (s).

    The needle is held after a jump. The limit therefore does not grow with time, or a sensor that has slipped would
    soon be accepted; it grows only with the travel that is still predicted. A later reading that is as close to the
    prediction, which no reading has corrected since, shows that the last good reading was wrong.
    """

    time: float
    limit: float

    def limit_at(self, time: float, tip_at: TipAt) -> float:
        """Return the largest distance (mm) of a later reading from the last good one."""
        return self.limit + math.dist(tip_at(self.time), tip_at(time))


@dataclass(frozen=True)
class Monitor:
    """State of the monitor. Frozen: `check` and `check_field` return the next state.

    axes: lateral axes of the needle; recent: readings within the window; repeats: the newest readings with the same
    position; good: the last good reading; rejected: true if a reading was rejected since then for more than a missing
    tip; jumped: the jump since then, if any; field: the last verdict on the field; distorted: true while the field is
    distorted.
    """

    settings: MonitorSettings
    axes: int = 1
    recent: tuple[Measurement, ...] = ()
    repeats: _Repeats | None = None
    good: Measurement | None = None
    rejected: bool = False
    jumped: _Jump | None = None
    field: Verdict = OK
    distorted: bool = False

    def check(
        self, measurement: Measurement, tip_at: TipAt, now: float, max_age: float, max_innovation: float
    ) -> "tuple[Monitor, Verdict]":
        """Return the state after a reading, and the verdict on it.

        Readings with an invalid time are not stored. tip_at: prediction of the present estimate; now (s); max_age (s);
        max_innovation: largest distance (mm) from the prediction.
        """
        previous = self.recent[-1].frame if self.recent else None
        verdict = rules.first_bad(
            (
                rules.check_not_a_number(measurement),
                rules.check_repeated(measurement.frame, previous),
                rules.check_stale(measurement.time, now, max_age),
            )
        )
        if not verdict.ok:
            return replace(self, rejected=True), verdict
        since = measurement.time - self.settings.indicator_window_s + 1e-9
        recent = (*[one for one in self.recent if one.time > since], measurement)
        repeats = self._count_repeats(measurement, tip_at)
        jump, jumped = self._check_jump(measurement, tip_at)
        predicted = tip_at(measurement.time)
        verdict = rules.first_bad(self._verdicts(measurement, predicted, max_innovation, jump, repeats))
        if verdict.ok:
            good = replace(
                self, recent=recent, repeats=repeats, good=measurement, rejected=False, jumped=None
            )
            return good, verdict
        rejected = self.rejected or verdict.kind is not VerdictKind.MISSING
        return replace(self, recent=recent, repeats=repeats, rejected=rejected, jumped=jumped), verdict

    def _check_jump(self, measurement: Measurement, tip_at: TipAt) -> tuple[Verdict, _Jump | None]:
        """Return the verdict on a reading that may have jumped, and the jump since the last good one, if any."""
        if self.good is None:
            return OK, self.jumped
        settings, time = self.settings, measurement.time
        limit = settings.speed_limit_mm_s * abs(time - self.good.time) + settings.jump_margin_mm
        if self.jumped is not None:
            limit = min(limit, self.jumped.limit_at(time, tip_at))
        verdict = rules.check_jump(measurement, self.good, limit)
        if self.jumped is not None and not verdict.ok:
            predicted = Measurement(time, *tip_at(time))
            verdict = verdict if not rules.check_jump(measurement, predicted, self.jumped.limit).ok else OK
        if verdict.ok or self.jumped is not None or not settings.enabled:
            return verdict, self.jumped
        return verdict, _Jump(time, limit)

    def check_field(self) -> "tuple[Monitor, Verdict]":
        """Return the state after a check of the field by the reference sensors, and the verdict.

        Without frames the verdict is OK: a tracker that reports only the tip gives nothing to check.
        """
        frames = self._frames()
        if not self.settings.enabled or not frames:
            return self, OK
        verdict = field_verdict(frames, self.settings, self.distorted)
        return replace(self, field=verdict, distorted=is_distorted(verdict, self.distorted)), verdict

    def field_in_doubt(self) -> Verdict:
        """Return FIELD_IN_DOUBT if the field may be distorted although it does not hold the needle yet, else OK.

        The median over a second reacts to a metal plate after half a second; readings until then are distorted, and
        must not correct the estimate.
        """
        frames, settings = self._frames(), self.settings
        if not settings.enabled or not frames:
            return OK
        window = settings.doubt_window_s
        return rules.check_in_doubt(_indicators(_within(frames, window)), settings.indicator_limit, window)

    def largest_indicator(self) -> float:
        """Return the largest median of the references' indicators over the shorter of the windows; 0 without any."""
        frames = self._frames()
        if not self.settings.enabled or not frames:
            return 0.0
        return rules.largest_median(_indicators(_within(frames, self.settings.doubt_window_s)))[1]

    def has_reading(self, now: float, max_age: float) -> bool:
        """Return whether the newest reading, good or bad, is at most `max_age` (s) old."""
        return bool(self.recent) and now - self.recent[-1].time <= max_age + 1e-9

    def last_good(self, now: float, max_age: float) -> Measurement | None:
        """Return the last good reading if it has a frame and is at most `max_age` (s) old."""
        good = self.good
        if not self.settings.enabled or good is None or good.frame is None:
            return None
        return good if now - good.time <= max_age + 1e-9 else None

    def last_good_before_dropout(self, newest: Measurement, verdict: Verdict) -> Measurement | None:
        """Return the last good reading if only the tip is missing since then, for at most `lost_after_s`.

        verdict: on the newest frame; a stale one, or one with an invalid time, gives no information on the tip. None
        for a tracker without frames, since it may have stopped, and if a reading was rejected since the last good one.
        """
        if newest.frame is None or verdict.kind is not VerdictKind.MISSING or self.rejected:
            return None
        return self.last_good(newest.time, self.settings.lost_after_s)

    def _frames(self) -> list[Frame]:
        return [one.frame for one in self.recent if one.frame is not None]

    def _verdicts(
        self,
        measurement: Measurement,
        predicted: Point,
        max_innovation: float,
        jump: Verdict,
        repeats: _Repeats | None,
    ) -> Iterator[Verdict]:
        settings = self.settings
        measured = (measurement.x, measurement.y, measurement.z)[: 1 + self.axes]
        tip = tuple(value for value in measured if value is not None)
        yield rules.check_missing(measurement, self.axes)
        if len(tip) == len(measured):
            yield rules.check_innovation(tip, predicted[: 1 + self.axes], max_innovation)
        if settings.enabled:
            if self.axes == 1:
                yield rules.check_out_of_plane(measurement.z, settings.out_of_plane_limit_mm)
            yield jump
            if repeats is not None:
                yield rules.check_frozen(repeats.count, repeats.travel, settings.frozen_travel_mm)

    def _count_repeats(self, newest: Measurement, tip_at: TipAt) -> _Repeats | None:
        """Return the readings with the newest one's position; a reading without a tip changes nothing."""
        position = _reported_position(newest)
        if position is None:
            return self.repeats
        if self.repeats is None or self.repeats.position != position:
            return _Repeats(position, newest.time)
        return self.repeats.extend(newest.time, tip_at)


def _reported_position(measurement: Measurement) -> rules.Position | None:
    """Return the position of the tip as reported: a new map to the stage does not move a frozen sensor."""
    reading = None if measurement.frame is None else measurement.frame.readings.get(TIP)
    if reading is not None:
        return reading.position
    x, y, z = measurement.x, measurement.y, measurement.z
    if x is None or y is None:
        return None
    return (x, y) if z is None else (x, y, z)
