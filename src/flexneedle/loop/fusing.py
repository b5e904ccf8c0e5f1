"""Sensors along the needle in the closed loop: read, checked, excluded where they contradict the others.

Where readings contradict the prediction, either of the sensors may be wrong, or the model. So the insertion is fitted
again without the last readings of each sensor in turn. A sensor is excluded if the fit without it explains all others
so much better that no chance explains it, and clearly better than the fit without any other sensor. If the tracker is
the one, or it is not clear which, the needle is held.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.fitted import TRACKER
from flexneedle.loop.monitor.sensors import SensorMonitor, check_readings
from flexneedle.ports import NeedleSensor
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import OK, Measurement, SensorState, Verdict, VerdictKind, X

_STEPS = 12  # of the largest advance: readings of which are left out
_GAIN = 40.0  # least fall of the cost of the fit without the last readings of a faulty sensor
_SURE = 160.0  # fall of the cost with which some sensor is wrong, even if it is not clear which
_CLEAR = 1.8  # ratio of the misfits of the others
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
    compared = predicted.compare(sensor.title, readings)
    max_age = scenario.control.stale_after_s + now - begun + sensor.delay_s + 3.0 * sensor.delay_sd_s
    checked = check_readings(readings, compared, now, max_age)
    good = np.array([one.verdict.ok for one in checked])
    outlying = np.array([one.verdict.kind is VerdictKind.OUTLIER for one in checked])
    # Where most are outliers, they are no chance: the sensor is faulty, or the prediction is wrong.
    judged = good | outlying if outlying.sum() > _OUTLYING * (good | outlying).sum() else good
    nis = compared.nis(judged) if judged.any() else math.nan
    monitor = monitor.innovate(nis)
    if monitor.excluded.ok:
        frozen = monitor.check_frozen(depth, scenario.monitor.frozen_travel_mm, sensor.resolution)
        monitor = replace(monitor, excluded=frozen)
    return monitor, SensorState(sensor.title, checked, monitor.excluded, nis)


def watch_tracker(predicted: Any, watch: Watch, good: Sequence[Measurement]) -> Watch:
    """Return the watch with the innovation of good readings of the tracker."""
    nis = predicted.compare_tip(good) if good else math.nan
    return watch.change(TRACKER, watch.of(TRACKER).innovate(nis))


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
    names = [TRACKER, *(one.name for one in states)]
    active = [name for name in names if watch.of(name).excluded.ok and estimate.count_values(name, since)]
    if not any(watch.of(name).suspicious for name in active):
        return estimate, watch, tuple(states), OK
    first, clear = _find_faulty(estimate, active, since)
    if not first:
        return estimate, watch, tuple(states), OK
    reason = f"its innovations are {math.sqrt(watch.of(first).level):.1f} times their standard deviation"
    if first == TRACKER or not clear:
        reason = f"{reason}, by the other sensors" if clear else "the sensors contradict each other"
        verdict = Verdict(VerdictKind.CONTRADICTED, f"{first}: {reason}")
        return (
            estimate,
            watch.change(TRACKER, replace(watch.of(TRACKER), excluded=verdict)),
            tuple(states),
            verdict,
        )
    verdict = Verdict(VerdictKind.CONTRADICTED, reason)
    after = tuple(replace(one, verdict=verdict) if one.name == first else one for one in states)
    monitors = {name: replace(watch.of(name), nis=()) for name in active}
    monitors[first] = replace(watch.of(first), excluded=verdict)
    return estimate.without(first, since), Watch({**watch.monitors, **monitors}), after, OK


def _find_faulty(estimate: Any, active: Sequence[str], since: float) -> tuple[str, bool]:
    """Return the sensor without which the others agree best, and True if it is clear; "" if none is found.

    The last readings of a faulty sensor, from `since` (s) on, cost far more than a reading's share. Which one it is, is
    told by the fits without each of them in the tissue: what is left agrees only without the faulty one. While this is
    not clear, the search goes on, up to a cost at which the needle must not move on.
    """
    counts = {name: estimate.count_values(name, since) for name in active}
    gains = [estimate.cost - estimate.without(name, since).cost - 0.5 * counts[name] for name in active]
    if (most := max(gains)) < _GAIN:
        return "", False
    entry = _time_of_entry(estimate)
    whole = {name: estimate.count_values(name, entry) for name in active}
    misfits = {}
    for name in active:
        others = sum(whole.values()) - whole[name]
        misfits[name] = estimate.without(name, entry).cost / others if others else 0.0
    first, *others = sorted(active, key=lambda name: misfits[name])
    clear = not others or misfits[others[0]] > _CLEAR * misfits[first]
    return (first if clear or most > _SURE else ""), clear


def _time_of_entry(estimate: Any) -> float:
    """Return the time (s) at which the tip entered the tissue."""
    inside = np.flatnonzero(estimate.tips[1:, X] > 0.0)
    return float(estimate.moves[inside[0] if inside.size else -1].motion.begun)


def _time_of_depth(estimate: Any, scenario: Scenario) -> float:
    """Return the time (s) at which the tip was some steps less deep than now."""
    depth = float(estimate.tips[-1, X]) - _STEPS * scenario.setup.max_advance_mm
    k = int(np.searchsorted(np.maximum.accumulate(estimate.tips[1:, X]), depth))
    return float(estimate.moves[min(k, len(estimate.moves) - 1)].motion.begun)


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
