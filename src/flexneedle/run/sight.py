"""What the closed loop makes of the tracker's readings in a period: judged, believed or not."""

from dataclasses import dataclass

from flexneedle.control.estimate import Estimate
from flexneedle.ports import Sample, TipTracker
from flexneedle.scenario import Scenario
from flexneedle.trace import Judged
from flexneedle.tracking import OK, Watch

__all__ = ["Sight", "see"]

_NO_SAMPLE = Sample(0.0, None, None)


@dataclass(frozen=True)
class Sight:
    """The belief after the readings of a period, all of them with their verdicts, and the verdict of the period.

    sample: the reading that the verdict is about, an empty one without any; limit: how long (s) the needle may be
    held for such a verdict.
    """

    estimate: Estimate
    watch: Watch
    readings: tuple[Judged, ...] = ()
    sample: Sample = _NO_SAMPLE
    verdict: str = OK
    limit: float = 0.0


def see(
    scenario: Scenario, predicted: Estimate, watch: Watch, begun: float, now: float, tracker: TipTracker
) -> Sight:
    """Read the tracker, judge its readings and the field, correct the prediction by what may be believed.

    begun, now: of the move that `predicted` ends with (s). In a distorted field no reading is believed.
    """
    control = scenario.control
    samples = tracker.read()
    if not samples:
        return Sight(predicted.unseen(), watch, verdict="missing: no reading", limit=control.hold_limit_s)
    # All but the newest were on their way while the needle moved.
    ages = [control.stale_after_s + now - begun] * (len(samples) - 1) + [control.stale_after_s]
    readings = []
    for sample, age in zip(samples, ages, strict=True):
        watch, verdict = watch.take(
            sample, predicted.tip_at(sample.time), now, age, control.innovation_limit_mm
        )
        readings.append(Judged(sample, verdict))
    newest, told = readings[-1], tuple(readings)
    watch, field = watch.look()
    if field != OK:
        limit = scenario.monitor.abort_after_s
        return Sight(predicted.unseen(), watch, told, newest.sample, field, limit)
    good = [reading.sample for reading in readings if reading.verdict == OK]
    corrected, limit = predicted.observe(good), control.hold_limit_s
    if newest.verdict == OK:
        return Sight(corrected, watch, told, newest.sample, OK, limit)
    if (before := watch.only_missed(newest.sample)) is not None:
        return Sight(corrected if good else corrected.unseen(), watch, told, before, OK, limit)
    return Sight(corrected.unseen(), watch, told, newest.sample, newest.verdict, limit)
