"""What the closed loop makes of the tracker's readings in a period: judged, used or not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from flexneedle.estimation.estimate import Estimate
from flexneedle.rig.monitor.watch import Watch
from flexneedle.rig.ports import TipTracker
from flexneedle.scenario.model import Scenario
from flexneedle.types import OK, VISIBLE, CheckedMeasurement, Measurement, Verdict, VerdictKind

_SURE = 3.0  # standard deviations by which a prediction may be off besides the limit
_NO_SAMPLE = Measurement(0.0, None, None)


@dataclass(frozen=True)
class Observation:
    """The estimate after the readings of a period, all of them with their verdicts, and the verdict of the period.

    sample: the reading that the verdict is about, an empty one without any; field: whether the verdict is about the
    field, not about a reading.
    """

    estimate: Estimate
    watch: Watch
    readings: tuple[CheckedMeasurement, ...] = ()
    sample: Measurement = _NO_SAMPLE
    verdict: Verdict = OK
    field: bool = False

    def saw_after(self, time: float) -> bool:
        """Whether a good reading was taken after `time` (s)."""
        return any(one.verdict.ok and one.sample.time > time - 1e-6 for one in self.readings)

    def limit(self, scenario: Scenario) -> float:
        """For how long (s) the needle may be held for such a verdict."""
        return scenario.monitor.abort_after_s if self.field else scenario.control.hold_limit_s


def look_around(
    scenario: Scenario, estimate: Estimate, watch: Watch, now: float, tracker: TipTracker
) -> Observation:
    """Judge the readings before the needle moves: a good one, or it stays. The estimate is not corrected by them."""
    samples = tracker.read()
    stale_after = scenario.control.stale_after_s
    if not samples:
        return _without_news(estimate, watch, now, stale_after, tracker.status)
    # The tracker may have been at work for long; but nothing moves on its last reading if that is old.
    ages = [math.inf] * (len(samples) - 1) + [stale_after]
    watch, readings = _judged(scenario, estimate, watch, samples, ages, now)
    watch, field = watch.look()
    newest = readings[-1]
    verdict = newest.verdict if field.ok else field
    if verdict == newest.verdict and watch.only_missed(newest.sample, newest.verdict) is not None:
        verdict = OK
    judged = _refused(readings, field) if not field.ok else readings
    return Observation(estimate, watch, judged, newest.sample, verdict, not field.ok)


def see(
    scenario: Scenario, predicted: Estimate, watch: Watch, begun: float, now: float, tracker: TipTracker
) -> Observation:
    """Read the tracker, judge its readings and the field, correct the prediction by the good ones.

    begun, now: of the move that `predicted` ends with (s). In a field that is distorted, or in doubt, no reading is
    used.
    """
    stale_after = scenario.control.stale_after_s
    samples = tracker.read()
    if not samples:
        return _without_news(predicted, watch, now, stale_after, tracker.status)
    # All but the newest were in transit while the needle moved.
    ages = [stale_after + now - begun] * (len(samples) - 1) + [stale_after]
    watch, readings = _judged(scenario, predicted, watch, samples, ages, now)
    newest = readings[-1]
    watch, field = watch.look()
    if not field.ok:
        return Observation(
            predicted.without_reading(), watch, _refused(readings, field), newest.sample, field, field=True
        )
    if not (doubt := watch.doubt()).ok:
        readings = _refused(readings, doubt)
    good = [reading.sample for reading in readings if reading.verdict.ok]
    corrected = predicted.observe(good)
    estimate = corrected if good else corrected.without_reading()
    if newest.verdict.ok:
        return Observation(estimate, watch, readings, newest.sample)
    if (before := watch.only_missed(newest.sample, newest.verdict)) is not None:
        return Observation(estimate, watch, readings, before)
    return Observation(corrected.without_reading(), watch, readings, newest.sample, newest.verdict)


def _without_news(
    predicted: Estimate, watch: Watch, now: float, stale_after: float, status: str
) -> Observation:
    """A period between two frames: until the last one is stale the field is as it was, and a good reading counts.

    status: of the tracker, which may know why it is silent.
    """
    if not watch.field.ok and watch.heard(now, stale_after):
        return Observation(predicted.without_reading(), watch, verdict=watch.field, field=True)
    if (before := watch.last_good(now, stale_after)) is not None:
        return Observation(predicted.without_reading(), watch, sample=before)
    why = "" if status == VISIBLE else f" ({status})"
    return Observation(
        predicted.without_reading(), watch, verdict=Verdict(VerdictKind.MISSING, f"no reading{why}")
    )


def _refused(readings: Sequence[CheckedMeasurement], field: Verdict) -> tuple[CheckedMeasurement, ...]:
    """The readings of a period in a field that is not good: none counts, also where nothing else is wrong with it."""
    return tuple(replace(one, verdict=field) if one.verdict.ok else one for one in readings)


def _judged(
    scenario: Scenario,
    predicted: Estimate,
    watch: Watch,
    samples: Sequence[Measurement],
    ages: Sequence[float],
    now: float,
) -> tuple[Watch, tuple[CheckedMeasurement, ...]]:
    """Take in samples, each not to be older than its age (s)."""
    readings = []
    limit = scenario.control.innovation_limit_mm + _SURE * predicted.tip_sd
    for sample, age in zip(samples, ages, strict=True):
        watch, verdict = watch.take(sample, predicted.tip_at, now, age, limit)
        readings.append(CheckedMeasurement(sample, verdict))
    return watch, tuple(readings)
