"""Sensors along the needle in the closed loop: read, checked, excluded where they contradict the others.

A sensor that contradicts the others, still after a further advance, is excluded, and the insertion is fitted again
without its last readings. If it is the tracker, or it is not clear which one is wrong, the needle is held.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flexneedle.estimation.along import without_prediction
from flexneedle.estimation.estimate import Estimate, can_fuse
from flexneedle.estimation.faults import Fault
from flexneedle.estimation.fitted import TRACKER
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.monitor.sensors import SensorMonitor, check_readings
from flexneedle.ports import NeedleSensor
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import OK, VISIBLE, Needles, SensorState, Verdict, VerdictKind, X

_FAULTY = 9.0  # log odds (natural) of a fault of a sensor, from which it is excluded
_IN_DOUBT = 15.0  # of a fault of the tracker, from which the needle is held: a hold may be wrong
_LARGE = 0.25  # over the miss limit: with an error as large it is held from `_LIKELY` on
_LIKELY = 1.0
_CLEAR = 3.0  # by which a fault must be likelier than another
_NONE = "", -math.inf
_MOVES = 2  # after which faults are searched again: the newest readings are averaged over two


@dataclass(frozen=True)
class Watch:
    """The monitors of the tracker and of the sensors along the needle, by name."""

    monitors: Mapping[str, SensorMonitor] = field(default_factory=dict)
    judged: int = 0  # number of moves when nothing was in doubt
    # depths (mm) at which sensors' faults were found that are not confirmed yet
    suspects: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str) -> SensorMonitor:
        """Return the monitor of a sensor."""
        return self.monitors.get(name, _NEW)

    def change(self, name: str, monitor: SensorMonitor) -> "Watch":
        """Return the watch with another state of a monitor."""
        return replace(self, monitors={**self.monitors, name: monitor})


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
    monitor, checked = check_readings(monitor, readings, compared, now, max_age)
    good = np.array([one.verdict.ok for one in checked])
    nis = compared.nis(good) if good.any() else math.nan
    empty = [one.reading for one in checked if one.verdict.kind is VerdictKind.MISSING]
    if _is_seen(sensor, scenario, predicted):  # an image without the needle is no loss before it comes there
        empty = []
    monitor = monitor.hear(
        [one.reading.time for one in checked if one.verdict.ok],
        [one.time for one in empty if one.status == VISIBLE],
    )
    if monitor.excluded.ok:
        frozen = monitor.check_frozen(depth, scenario.monitor.frozen_travel_mm, sensor.resolution)
        monitor = replace(monitor, excluded=frozen)
    return monitor, SensorState(sensor.title, checked, monitor.excluded, nis)


def _is_seen(sensor: Sensor, scenario: Scenario, predicted: Any) -> bool:
    """Return if the sensor should measure the predicted needle."""
    nodes = predicted.state.nodes
    needle = Needles(nodes[None], scenario.needle.length_mm / (len(nodes) - 1))
    return bool(sensor.sees(needle, scenario.setup.axes).any())


def exclude_faulty(
    estimate: Any, watch: Watch, states: Sequence[SensorState], before: Watch
) -> tuple[Any, Watch, tuple[SensorState, ...], Verdict]:
    """Return estimate, watch and states after an exclusion, and a verdict: not OK if the needle must be held.

    before: the watch of the period before, to see which sensors have been found frozen since.
    """
    depth = float(estimate.tips[-1, X])
    frozen = [one.name for one in states if not one.verdict.ok and before.of(one.name).excluded.ok]
    for name in frozen:
        estimate = estimate.without(name, _time_of_depth(estimate, min(depth, watch.of(name).since)))
    if frozen:
        return estimate, watch, tuple(states), OK
    if len(estimate.moves) - watch.judged < _MOVES:
        return estimate, watch, tuple(states), OK
    faults = {name: one for name, one in estimate.faults().items() if watch.of(name).excluded.ok}
    likely = [name for name, one in faults.items() if name != TRACKER and one.log_odds > _FAULTY]
    watch = replace(watch, suspects={name: watch.suspects.get(name, depth) for name in likely})
    miss_limit = estimate.nominal.scenario.control.miss_limit_mm
    found, verdict = judge_faults(faults, miss_limit if estimate.tracked else None)
    if verdict.ok:
        return estimate, replace(watch, judged=len(estimate.moves)), tuple(states), OK
    if TRACKER in found:
        return estimate, watch, tuple(states), verdict
    if depth < watch.suspects[found[0]] + estimate.nominal.scenario.setup.max_advance_mm:
        return estimate, watch, tuple(states), OK  # the fit may still follow a leap
    if len(found) > 1:
        return estimate, watch, tuple(states), verdict
    (name,) = found
    watch = watch.change(name, replace(watch.of(name), excluded=verdict))
    after = tuple(replace(one, verdict=verdict) if one.name == name else one for one in states)
    return estimate.without(name, _time_of_depth(estimate, faults[name].since)), watch, after, OK


def judge_faults(faults: Mapping[str, Fault], miss_limit: float | None) -> tuple[tuple[str, ...], Verdict]:
    """Return the sensor that is wrong, none, or two of which it is not clear which one is wrong, and a verdict.

    faults: the likeliest of each sensor by name; miss_limit (mm): None if the tracker is lost.
    """
    odds = {name: one.log_odds for name, one in faults.items()}
    tip, error = odds.pop(TRACKER, -math.inf), faults[TRACKER].error if TRACKER in faults else 0.0
    (name, most), (other, second) = (*sorted(odds.items(), key=lambda one: -one[1]), _NONE, _NONE)[:2]
    if most > _FAULTY and most - tip > _CLEAR:
        seen = f"log odds of an error {most:.1f}"
        if most - second > _CLEAR:
            reason = f"by the other sensors and the model ({seen}, limit {_FAULTY:.1f})"
            return (name,), Verdict(VerdictKind.CONTRADICTED, reason)
        reason = f"{name} or {other}, not clear which ({seen} and {second:.1f}, limit {_FAULTY:.1f})"
        return (name, other), Verdict(VerdictKind.CONTRADICTED, reason)
    is_large = miss_limit is not None and error > _LARGE * miss_limit
    limit = _LIKELY if is_large else _IN_DOUBT
    if tip > limit and most - tip < _CLEAR:
        seen, against = f"log odds of an error of {error:.1f} mm {tip:.1f}", f"limit {limit:.1f}"
        if tip - most > _CLEAR:
            reason = f"{TRACKER}, by the other sensors ({seen}, {against})"
            return (TRACKER,), Verdict(VerdictKind.CONTRADICTED, reason)
        reason = f"{TRACKER} or {name}, not clear which ({seen} and {most:.1f}, {against})"
        return (TRACKER, name), Verdict(VerdictKind.CONTRADICTED, reason)
    return (), OK


def _time_of_depth(estimate: Any, depth: float) -> float:
    """Return the time (s) at which the tip came to a depth (mm)."""
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
    least = min(_silence(scenario, watch, now), now - watch.of(TRACKER).heard)
    if least <= scenario.control.stale_after_s:
        return OK
    limit = scenario.control.stale_after_s
    since = f" for {least:.2f} s, limit {limit:.2f} s" if math.isfinite(least) else ""
    excluded = [f"{name}: {one.excluded}" for name, one in watch.monitors.items() if not one.excluded.ok]
    reason = "; ".join([f"no good reading of any sensor{since}", *excluded])
    return Verdict(VerdictKind.MISSING, reason)


def is_sensed(scenario: Scenario, watch: Watch, now: float) -> bool:
    """Return if a sensor along the needle, not excluded, has a reading that is good and not stale; now (s).

    A reading without the needle is good where none is, but not before the first of any sensor with the needle.
    """
    return _silence(scenario, watch, now) <= scenario.control.stale_after_s


def _silence(scenario: Scenario, watch: Watch, now: float) -> float:
    """Return the time (s) since the last reading as for `is_sensed`, less the sensor's delay and period."""
    if not any(one.measured for one in watch.monitors.values()):
        return math.inf
    good = (one for one in scenario.sensor if watch.of(one.title).excluded.ok)
    ages = (now - watch.of(one.title).heard - one.longest_wait for one in good)
    return min(ages, default=math.inf)


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
