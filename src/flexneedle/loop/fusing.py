"""Sensors along the needle in the closed loop: read, checked, excluded where they contradict the others.

A sensor that contradicts the others is excluded, and the insertion is fitted again without its last readings. If it is
the tracker, or it is not clear which one is wrong, the needle is held.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flexneedle.estimation.along import without_prediction
from flexneedle.estimation.estimate import Estimate, can_fuse
from flexneedle.estimation.fitted import TRACKER
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.monitor.sensors import SensorMonitor, check_readings
from flexneedle.ports import NeedleSensor
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import OK, SensorState, Verdict, VerdictKind, X

_STEPS = 12  # of the largest advance: readings of which are left out
_CONFLICT = 6.0  # cost by which sensors contradict each other; healthy ones reach 5 in training worlds
_SURE = 2.0  # times that cost: one of them is wrong
_CLEAR, _CLEARER = 2.5, 1.6  # ratios of the misfits without another sensor and without the faulty one
_LEAST_MISFIT = 0.05  # cost per value of a fit that is good in any case
_OUTLYING = 0.5  # share of outliers in a period, which are no chance


@dataclass(frozen=True)
class Watch:
    """The monitors of the tracker and of the sensors along the needle, by name."""

    monitors: Mapping[str, SensorMonitor] = field(default_factory=dict)

    def of(self, name: str) -> SensorMonitor:
        """Return the monitor of a sensor."""
        return self.monitors.get(name, _NEW)

    def change(self, name: str, monitor: SensorMonitor) -> "Watch":
        """Return the watch with another state of a monitor."""
        return Watch({**self.monitors, name: monitor})


_NEW = SensorMonitor()
NO_WATCH = Watch()
"""Before the first reading."""


def read_sensors(
    scenario: Scenario,
    predicted: Estimate,
    watch: Watch,
    begun: float,
    now: float,
    ports: Mapping[str, NeedleSensor],
) -> tuple[Watch, tuple[SensorState, ...]]:
    """Read the sensors along the needle, and check their readings beside the prediction."""
    states = []
    for sensor in scenario.sensor:
        name = sensor.title
        found = _read_sensor(sensor, ports[name].read(), watch.of(name), scenario, predicted, begun, now)
        watch = watch.change(name, found[0])
        states.append(found[1])
    return watch, tuple(states)


def _read_sensor(
    sensor: Sensor,
    readings: Sequence[Any],
    monitor: SensorMonitor,
    scenario: Scenario,
    predicted: Any,
    begun: float,
    now: float,
) -> tuple[SensorMonitor, SensorState]:
    if not readings:
        return monitor, SensorState(sensor.title, verdict=monitor.excluded)
    depth = float(predicted.state.tip[X])
    monitor = monitor.add(readings, depth)
    compared = (
        predicted.compare(sensor.title, readings) if can_fuse(predicted) else without_prediction(readings)
    )
    max_age = scenario.control.stale_after_s + now - begun + sensor.delay_s + 3.0 * sensor.delay_sd_s
    checked = check_readings(readings, compared, now, max_age)
    good = np.array([one.verdict.ok for one in checked])
    outlying = np.array([one.verdict.kind is VerdictKind.OUTLIER for one in checked])
    # Where most are outliers, they are no chance: the sensor is faulty, or the prediction is wrong.
    judged = good | outlying if outlying.sum() > _OUTLYING * (good | outlying).sum() else good
    nis = compared.nis(judged) if judged.any() else math.nan
    monitor = monitor.innovate(nis).hear(one.reading.time for one in checked if one.verdict.ok)
    if monitor.excluded.ok:
        frozen = monitor.check_frozen(depth, scenario.monitor.frozen_travel_mm, sensor.resolution)
        monitor = replace(monitor, excluded=frozen)
    return monitor, SensorState(sensor.title, checked, monitor.excluded, nis)


def exclude_faulty(
    scenario: Scenario, estimate: Any, watch: Watch, states: Sequence[SensorState], before: Watch
) -> tuple[Any, Watch, tuple[SensorState, ...], Verdict]:
    """Return estimate, watch and states after an exclusion, and a verdict: not OK if the needle must be held.

    before: the watch of the period before, to see which sensors have been found frozen since.
    """
    since = _time_of_depth(estimate, scenario)
    for one in states:
        if not one.verdict.ok and before.of(one.name).excluded.ok:  # frozen
            return estimate.without(one.name, since), watch, tuple(states), OK
    active = [name for name in (TRACKER, *(one.name for one in states)) if watch.of(name).excluded.ok]
    conflicts = {name: estimate.conflict(name) for name in active}
    surprised = any(watch.of(name).surprised for name in active)
    faulty, verdict = judge_conflict(
        conflicts, {name: estimate.misfit(name) for name in active}, surprised=surprised
    )
    if not faulty:
        return estimate, watch, tuple(states), verdict
    watch = watch.change(faulty, replace(watch.of(faulty), excluded=verdict))
    if faulty == TRACKER:
        return estimate, watch, tuple(states), verdict
    after = tuple(replace(one, verdict=verdict) if one.name == faulty else one for one in states)
    return estimate.without(faulty, since), watch, after, OK


def judge_conflict(
    conflicts: Mapping[str, float], misfits: Mapping[str, float], *, surprised: bool = False
) -> tuple[str, Verdict]:
    """Return the sensor that is wrong, "" for none or if it is not clear which, and a verdict.

    Sensors that contradict each other cost the fit to all more than fits to each alone. What is left without the faulty
    one agrees with the model, and what is left without another does not. While this is not clear the insertion
    continues, but not up to twice the limit of the cost.

    conflicts, misfits: of the sensors by name, as of an `Identified`; surprised: True if readings are far from their
    predictions, since a sensor may contradict itself, too.
    """
    most = max(conflicts.values(), default=0.0)
    if most <= _CONFLICT and not surprised:
        return "", OK
    first, *others = sorted(misfits, key=lambda name: misfits[name])
    ratio = min((misfits[name] for name in others), default=math.inf) / max(misfits[first], _LEAST_MISFIT)
    sure = most > _SURE * _CONFLICT
    if ratio > (_CLEARER if sure else _CLEAR) or (first == TRACKER and most > _CONFLICT):
        reason = f"the fit to all costs {most:.0f} more than to each alone, limit {_CONFLICT:.0f}"
        if most <= _CONFLICT:
            reason = f"without it the fit is {ratio:.1f} times better than without another"
        return first, Verdict(
            VerdictKind.CONTRADICTED, f"{TRACKER}: {reason}" if first == TRACKER else reason
        )
    if not sure:
        return "", OK
    reason = f"{', '.join(misfits)} contradict each other, and it is not clear which is wrong"
    return "", Verdict(VerdictKind.CONTRADICTED, reason)


def _time_of_depth(estimate: Any, scenario: Scenario) -> float:
    """Return the time (s) at which the tip was some steps less deep than now."""
    depth = float(estimate.tips[-1, X]) - _STEPS * scenario.setup.max_advance_mm
    k = int(np.searchsorted(np.maximum.accumulate(estimate.tips[1:, X]), depth))
    return float(estimate.moves[min(k, len(estimate.moves) - 1)].motion.begun)


def set_field(scenario: Scenario, estimate: Any, monitor: Monitor, since: float) -> Any:
    """Return the estimate with the error of the tracker's field that the references show, from a time (s) on.

    In a clean field it is the scenario's.
    """
    settings, largest, least = scenario.monitor, monitor.largest_indicator(), scenario.tracker.field_sd_mm
    sd = settings.indicator_error_mm * largest / math.sqrt(3.0)
    return estimate.with_field(max(least, sd) if largest > settings.indicator_limit else least, since)


def check_silent(scenario: Scenario, watch: Watch, now: float) -> Verdict:
    """Require a good reading of some sensor that is not excluded: never move on predictions alone; now (s)."""
    limits = {one.title: one.delay_s + 1.0 / one.rate_hz for one in scenario.sensor} | {TRACKER: 0.0}
    ages = {
        name: now - watch.of(name).heard - more for name, more in limits.items() if watch.of(name).excluded.ok
    }
    least = min(ages.values(), default=math.inf)
    if least <= scenario.control.stale_after_s:
        return OK
    reason = f"no good reading of any sensor for {least:.2f} s, limit {scenario.control.stale_after_s:.2f} s"
    return Verdict(VerdictKind.MISSING, reason)


def check_uncertain(
    scenario: Scenario, estimate: Any, states: Sequence[SensorState], tracker: str
) -> Verdict:
    """Require a tip that is known well enough, by all sensors together; tracker: its verdict in words."""
    sd, limit = tip_sd(estimate), scenario.control.tip_sd_limit
    if sd <= limit:
        return OK
    known = "; ".join(f"{one.name}: {one.verdict}" for one in states)
    reason = f"known to ± {sd:.2f} mm across, limit {limit:.2f} mm (tracker: {tracker}; {known})"
    return Verdict(VerdictKind.UNCERTAIN, reason)


def tip_sd(estimate: Any) -> float:
    """Return the standard deviation (mm) of the tip's lateral position in the worst direction."""
    return float(np.sqrt(np.linalg.eigvalsh(estimate.tip_covariance[1:, 1:])[-1]))
