"""Measurement in the closed loop: read the tracker, check the readings and the field, correct the estimate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from flexneedle.estimation.estimate import Estimate, can_fuse
from flexneedle.estimation.fitted import TRACKER
from flexneedle.loop.fusing import (
    NO_WATCH,
    Watch,
    check_silent,
    check_uncertain,
    exclude_faulty,
    is_sensed,
    read_sensors,
    set_field,
)
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.rig import Rig
from flexneedle.ports import TipTracker
from flexneedle.scenario.model import Scenario
from flexneedle.types import OK, VISIBLE, CheckedMeasurement, Measurement, SensorState, Verdict, VerdictKind

_PREDICTION_SDS = 3.0  # standard deviations of the prediction, added to the limit of the innovation
_NO_MEASUREMENT = Measurement(0.0, None, None)


@dataclass(frozen=True)
class Observation:
    """The estimate after a period, and the readings with their verdicts.

    measurement: the reading to which the verdict of the period refers, empty if there is none; field: true if the
    verdict is about the field rather than a reading; sensors: the sensors along the needle, and watch, their monitors.
    """

    estimate: Estimate
    monitor: Monitor
    readings: tuple[CheckedMeasurement, ...] = ()
    measurement: Measurement = _NO_MEASUREMENT
    verdict: Verdict = OK
    field: bool = False
    watch: Watch = NO_WATCH
    sensors: tuple[SensorState, ...] = ()

    def has_good_reading_after(self, time: float) -> bool:
        """Return whether a good reading was taken after `time` (s)."""
        tip = any(one.verdict.ok and one.measurement.time > time - 1e-6 for one in self.readings)
        return tip or any(taken > time - 1e-6 for taken in self._sensor_times)

    def sensed_at(self, scenario: Scenario, now: float) -> bool:
        """Return if a sensor along the needle measures it at a time (s), and corrects the estimate."""
        return can_fuse(self.estimate) and is_sensed(scenario, self.watch, now)

    @property
    def newest(self) -> float:
        """Time (s) of the newest good reading of any sensor, the period's measurement's without others."""
        return max([self.measurement.time, *self._sensor_times])

    @property
    def _sensor_times(self) -> list[float]:
        """Times (s) of the good readings of sensors along the needle, if they correct the estimate."""
        return [one.time for state in self.sensors for one in state.good] if can_fuse(self.estimate) else []

    def hold_limit(self, scenario: Scenario) -> float:
        """Return the longest hold (s) for the verdict of this period."""
        return scenario.monitor.abort_after_s if self.field else scenario.control.hold_limit_s


def observe_before_start(
    scenario: Scenario, estimate: Estimate, monitor: Monitor, now: float, tracker: TipTracker
) -> Observation:
    """Read the tracker and check readings and field before the first motion.

    The estimate is not corrected.
    """
    if not scenario.tracker.enabled:  # the first readings of the sensors come in the first period, at rest
        return Observation(estimate, monitor, verdict=Verdict(VerdictKind.MISSING, "there is no tracker"))
    measurements = tracker.read()
    stale_after = scenario.control.stale_after_s
    if not measurements:
        return _keep_last_reading(estimate, monitor, now, stale_after, tracker.status)
    # Older readings are accepted, since the tracker may have been running; the newest one must not be stale.
    max_ages = [math.inf] * (len(measurements) - 1) + [stale_after]
    monitor, readings = _check_readings(scenario, estimate, monitor, measurements, max_ages, now)
    monitor, field = monitor.check_field()
    newest = readings[-1]
    if not field.ok:
        rejected = _reject_readings(readings, field)
        return Observation(estimate, monitor, rejected, newest.measurement, field, field=True)
    if (last_good := monitor.last_good_before_dropout(newest.measurement, newest.verdict)) is not None:
        return Observation(estimate, monitor, readings, last_good)
    return Observation(estimate, monitor, readings, newest.measurement, newest.verdict)


def observe_all(
    scenario: Scenario, before: Observation, predicted: Estimate, begun: float, now: float, rig: Rig
) -> Observation:
    """Observe with all sensors: as `observe`, and by the sensors along the needle, if there are any.

    Then the needle is held if the tip is not known well enough, and not because the tracker alone does not measure it.
    For an estimate that does not fuse them, sensors along the needle are recorded only (`control.essential_points` uses
    them), and the needle is held as without them.
    """
    if not scenario.sensor:
        return observe(scenario, predicted, before.monitor, begun, now, rig.tracker)
    watch, sensors = read_sensors(scenario, predicted, before.watch, begun, now, rig.sensors)
    if not can_fuse(predicted):
        used = sensors if scenario.control.essential_points else ()
        found = observe(scenario, predicted, before.monitor, begun, now, rig.tracker, used)
        return replace(found, watch=watch, sensors=sensors)
    found = observe(scenario, predicted, before.monitor, begun, now, rig.tracker, sensors)
    heard = [one.measurement.time for one in found.readings if one.verdict.ok]
    watch = watch.change(TRACKER, watch.of(TRACKER).hear(heard))
    estimate, watch, sensors, verdict = exclude_faulty(found.estimate, watch, sensors, before.watch)
    if verdict.ok:
        verdict = check_silent(scenario, watch, now)
    if verdict.ok:
        tracker = found.verdict if scenario.tracker.enabled else Verdict(VerdictKind.MISSING, "there is none")
        verdict = check_uncertain(scenario, estimate, sensors, str(tracker))
    return replace(found, estimate=estimate, verdict=verdict, field=False, watch=watch, sensors=sensors)


def observe(
    scenario: Scenario,
    predicted: Estimate,
    monitor: Monitor,
    begun: float,
    now: float,
    tracker: TipTracker,
    sensors: Sequence[SensorState] = (),
) -> Observation:
    """Read the tracker, check readings and field, and correct the prediction by the good readings.

    begun, now: start and end (s) of the move after which `predicted` holds. While the field is distorted or in doubt no
    reading of the tracker is used. sensors: along the needle, with their readings.
    """
    stale_after = scenario.control.stale_after_s
    measurements, along = tracker.read(), {one.name: one.good for one in sensors}

    def correct(good: Sequence[Measurement]) -> Estimate:
        return predicted.observe(good, along) if along else predicted.observe(good)

    if not measurements:
        return _keep_last_reading(correct(()), monitor, now, stale_after, tracker.status)
    # All but the newest were in transit while the needle moved.
    max_ages = [stale_after + now - begun] * (len(measurements) - 1) + [stale_after]
    monitor, readings = _check_readings(scenario, predicted, monitor, measurements, max_ages, now)
    newest = readings[-1]
    monitor, field = monitor.check_field()
    fused = bool(sensors) and can_fuse(predicted) and scenario.monitor.indicator_error_mm > 0.0
    if fused:
        predicted = set_field(scenario, predicted, monitor, begun)
    if not (field.ok or (fused and field.kind is VerdictKind.FIELD_DISTORTED)):
        rejected = _reject_readings(readings, field)
        return Observation(
            correct(()).without_reading(), monitor, rejected, newest.measurement, field, field=True
        )
    if not (doubt := monitor.field_in_doubt()).ok and not fused:
        readings = _reject_readings(readings, doubt)
    good = [reading.measurement for reading in readings if reading.verdict.ok]
    corrected = correct(good)
    estimate = corrected if good else corrected.without_reading()
    if newest.verdict.ok:
        return Observation(estimate, monitor, readings, newest.measurement)
    if (last_good := monitor.last_good_before_dropout(newest.measurement, newest.verdict)) is not None:
        return Observation(estimate, monitor, readings, last_good)
    return Observation(corrected.without_reading(), monitor, readings, newest.measurement, newest.verdict)


def _keep_last_reading(
    predicted: Estimate, monitor: Monitor, now: float, stale_after: float, status: str
) -> Observation:
    """Observe a period without a new frame: the last verdicts hold until they are stale; status: of the tracker."""
    if not monitor.field.ok and monitor.has_reading(now, stale_after):
        return Observation(predicted.without_reading(), monitor, verdict=monitor.field, field=True)
    if (last_good := monitor.last_good(now, stale_after)) is not None:
        return Observation(predicted.without_reading(), monitor, measurement=last_good)
    reason = "" if status == VISIBLE else f" ({status})"
    return Observation(
        predicted.without_reading(), monitor, verdict=Verdict(VerdictKind.MISSING, f"no reading{reason}")
    )


def _reject_readings(
    readings: Sequence[CheckedMeasurement], field: Verdict
) -> tuple[CheckedMeasurement, ...]:
    """Return the readings of a period, all rejected: the good ones with the verdict on the field."""
    return tuple(replace(one, verdict=field) if one.verdict.ok else one for one in readings)


def _check_readings(
    scenario: Scenario,
    predicted: Estimate,
    monitor: Monitor,
    measurements: Sequence[Measurement],
    max_ages: Sequence[float],
    now: float,
) -> tuple[Monitor, tuple[CheckedMeasurement, ...]]:
    """Check measurements, oldest first, each with its largest age (s)."""
    readings = []
    limit = innovation_limit(scenario, predicted.tip_sd)
    for measurement, max_age in zip(measurements, max_ages, strict=True):
        monitor, verdict = monitor.check(measurement, predicted.tip_at, now, max_age, limit)
        readings.append(CheckedMeasurement(measurement, verdict))
    return monitor, tuple(readings)


def innovation_limit(scenario: Scenario, tip_sd: float) -> float:
    """Return the largest distance (mm) of a reading from a prediction of the tip with this standard deviation (mm)."""
    return scenario.control.innovation_limit_mm + _PREDICTION_SDS * tip_sd
