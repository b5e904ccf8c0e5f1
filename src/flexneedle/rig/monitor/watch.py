"""The watch over the tracker: what it remembers of past readings, and whether it lets the needle move."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from flexneedle.rig.monitor import rules
from flexneedle.rig.tracking.table import TIP
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import OK, Frame, Measurement, Verdict, VerdictKind


def field_verdict(frames: Sequence[Frame], settings: MonitorSettings, distorted: bool = False) -> Verdict:
    """Judge the field by the sensors of frames, oldest first: by all but the tip, and enough of them references.

    The frames of the last window count, and a sensor that told an indicator in half of them: a median over a few
    readings would be no better than these. distorted: whether it was so far; it has to fall below the lower limit then.
    """
    window = settings.indicator_window_s
    recent = _within(frames, window)
    known = _indicators(recent)
    limit = settings.indicator_limit * (settings.resume_fraction if distorted else 1.0)
    return rules.first_bad(
        (
            rules.unseen_references(known, settings.references, window, recent[-1].readings),
            rules.too_short(_looked_at(recent), window / 2, settings.references),
            rules.distortion(known, limit, window, distorted),
        )
    )


def is_distorted(verdict: Verdict, before: bool) -> bool:
    """Whether the field is to be held for distorted after a verdict: once it was, until it is known to be good."""
    return verdict.kind is VerdictKind.FIELD_DISTORTED or (before and not verdict.ok)


def _looked_at(frames: Sequence[Frame]) -> float:
    """For how long (s) the tracker was looked at: a gap between frames counts as one period of frames."""
    steps = [later.time - earlier.time for earlier, later in pairwise(frames)]
    return len(steps) * median(steps) if steps else 0.0


def _within(frames: Sequence[Frame], window: float) -> list[Frame]:
    since = frames[-1].time - window + 1e-9
    return [frame for frame in frames if frame.time > since]


def _indicators(frames: Sequence[Frame]) -> dict[str, list[float]]:
    """Indicators by sensor, of those but the tip that told one in half of the frames."""
    told: dict[str, list[float]] = {}
    for frame in frames:
        for name, reading in frame.readings.items():
            if name != TIP and rules.tells_indicator(reading):
                told.setdefault(name, []).append(reading.indicator or 0.0)
    return {name: values for name, values in told.items() if 2 * len(values) >= len(frames)}


TipAt = Callable[[float], tuple[float, float]]
"""Predicted position of the tip (mm) at a time (s)."""


@dataclass(frozen=True)
class _Repeats:
    """Successive readings with the same position: their number, the time of the newest (s), and the predicted travel of
    the tip since the first (mm)."""

    position: rules.Place
    time: float
    count: int = 1
    travel: float = 0.0

    def then(self, time: float, tip_at: TipAt) -> "_Repeats":
        """One more reading. Both ends of its travel are of one estimate: a correction of that is no motion."""
        travel = self.travel + math.dist(tip_at(self.time), tip_at(time))
        return _Repeats(self.position, time, self.count + 1, travel)


@dataclass(frozen=True)
class Watch:
    """What the monitor remembers. Frozen: `take` and `look` return the next one.

    recent: readings within the window; repeats: the newest ones with the same position;
    good: the last one without fault; field: the last verdict on the field; distorted: whether it was since it was last
    known good.
    """

    settings: MonitorSettings
    recent: tuple[Measurement, ...] = ()
    repeats: _Repeats | None = None
    good: Measurement | None = None
    field: Verdict = OK
    distorted: bool = False

    def take(
        self, sample: Measurement, tip_at: TipAt, now: float, oldest: float, furthest: float
    ) -> "tuple[Watch, Verdict]":
        """Take in a reading; return what is wrong with it, or OK. One of another time is not remembered.

        tip_at: of the present estimate; now (s); oldest: age (s), furthest: distance (mm) from the
        prediction beyond which no reading is believed.
        """
        before = self.recent[-1].frame if self.recent else None
        verdict = rules.first_bad(
            (
                rules.not_a_number(sample),
                rules.repeated(sample.frame, before),
                rules.stale(sample.time, now, oldest),
            )
        )
        if not verdict.ok:
            return self, verdict
        since = sample.time - self.settings.indicator_window_s + 1e-9
        kept = tuple(one for one in self.recent if one.time > since)
        watch = replace(self, recent=(*kept, sample), repeats=self._repeated(sample, tip_at))
        verdict = rules.first_bad(watch._faults(sample, tip_at(sample.time), furthest))
        return (replace(watch, good=sample) if verdict.ok else watch), verdict

    def heard(self, now: float, oldest: float) -> bool:
        """Whether the tracker told anything, good or not, that is not older than `oldest` (s)."""
        return bool(self.recent) and now - self.recent[-1].time <= oldest + 1e-9

    def last_good(self, now: float, oldest: float) -> Measurement | None:
        """Return the last good reading, if it is not older than `oldest` (s) and of a tracker that tells frames."""
        good = self.good
        if not self.settings.enabled or good is None or good.frame is None or now - good.time > oldest + 1e-9:
            return None
        return good

    def only_missed(self, newest: Measurement, verdict: Verdict) -> Measurement | None:
        """Return the last good reading if the tip was lost in the newest frame, but not for long; None otherwise.

        verdict: on that frame; one that is stale itself, or dated nowhere, tells nothing of the tip. Only of a tracker
        that tells frames: it is known to be alive, and to look.
        """
        if newest.frame is None or verdict.kind is not VerdictKind.MISSING:
            return None
        return self.last_good(newest.time, self.settings.lost_after_s)

    def look(self) -> "tuple[Watch, Verdict]":
        """Judge the field by the reference sensors; return why the needle may not move, or OK.

        A tracker that tells nothing but the tip is not held against: there is nothing to judge.
        """
        frames = self._frames()
        if not self.settings.enabled or not frames:
            return self, OK
        verdict = field_verdict(frames, self.settings, self.distorted)
        return replace(self, field=verdict, distorted=is_distorted(verdict, self.distorted)), verdict

    def doubt(self) -> Verdict:
        """Return why what is measured now is not to be learnt from, although the field holds no needle yet, or OK.

        The median over a second needs half of one to tell that a plate came near; the readings of that time are bent.
        """
        frames, settings = self._frames(), self.settings
        if not settings.enabled or not frames:
            return OK
        window = settings.doubt_window_s
        return rules.doubtful(_indicators(_within(frames, window)), settings.indicator_limit, window)

    def _frames(self) -> list[Frame]:
        return [sample.frame for sample in self.recent if sample.frame is not None]

    def _faults(
        self, sample: Measurement, predicted: tuple[float, float], furthest: float
    ) -> Iterator[Verdict]:
        settings = self.settings
        yield rules.missing(sample)
        if sample.x is not None and sample.y is not None:
            yield rules.innovation((sample.x, sample.y), predicted, furthest)
        if settings.enabled:
            yield rules.out_of_plane(sample.z, settings.out_of_plane_limit_mm)
            yield rules.jump(sample, self.good, settings.speed_limit_mm_s, settings.jump_margin_mm)
            if self.repeats is not None:
                yield rules.frozen(self.repeats.count, self.repeats.travel, settings.frozen_travel_mm)

    def _repeated(self, newest: Measurement, tip_at: TipAt) -> _Repeats | None:
        """Return the readings with the newest one's position; a reading without a tip changes nothing."""
        position = self._place(newest)
        if position is None:
            return self.repeats
        if self.repeats is None or self.repeats.position != position:
            return _Repeats(position, newest.time)
        return self.repeats.then(newest.time, tip_at)

    def _place(self, sample: Measurement) -> rules.Place | None:
        """What the tracker itself said of the tip: a map to the stage or an offset makes no frozen sensor move."""
        told = None if sample.frame is None else sample.frame.readings.get(TIP)
        if told is not None:
            return told.position
        return None if sample.x is None or sample.y is None else (sample.x, sample.y)
