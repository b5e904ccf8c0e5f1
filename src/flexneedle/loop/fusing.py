"""Readings of the sensors along the needle in the closed loop: read, check, and correct the estimate with the tip's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flexneedle.estimation.estimate import Estimate
from flexneedle.loop.monitor.sensors import SensorMonitor, check_frozen, check_readings
from flexneedle.ports import NeedleSensor
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import OK, SensorState, Verdict, VerdictKind, X


@dataclass(frozen=True)
class Watch:
    """The monitors of the sensors along the needle, by name."""

    monitors: Mapping[str, SensorMonitor] = field(default_factory=dict)


def read_sensors(
    scenario: Scenario,
    predicted: Estimate,
    watch: Watch,
    begun: float,
    now: float,
    ports: Mapping[str, NeedleSensor],
) -> tuple[Watch, tuple[SensorState, ...]]:
    """Read the sensors along the needle, and check their readings beside the prediction."""
    monitors, states = dict(watch.monitors), []
    for sensor in scenario.sensor:
        name = sensor.title
        monitors[name], state = _read_sensor(
            sensor, ports[name], monitors.get(name, SensorMonitor()), scenario, predicted, begun, now
        )
        states.append(state)
    return replace(watch, monitors=monitors), tuple(states)


def _read_sensor(
    sensor: Sensor,
    port: NeedleSensor,
    monitor: SensorMonitor,
    scenario: Scenario,
    predicted: Any,
    begun: float,
    now: float,
) -> tuple[SensorMonitor, SensorState]:
    readings, name = port.read(), sensor.title
    if not readings:
        return monitor, SensorState(name, verdict=monitor.excluded)
    depth = float(predicted.state.tip[X])
    for one in readings:
        monitor = monitor.repeat(one, depth)
    compared = predicted.compare(name, readings)
    max_age = scenario.control.stale_after_s + now - begun + sensor.delay_s + 3.0 * sensor.delay_sd_s
    checked = check_readings(readings, compared, now, max_age)
    frozen = check_frozen(monitor, depth, scenario.monitor.frozen_travel_mm, sensor.resolution)
    verdict = monitor.excluded if not monitor.excluded.ok else frozen
    good = [one.verdict.ok for one in checked]
    state = SensorState(name, checked, verdict, compared.nis(good) if any(good) else float("nan"))
    return replace(monitor, excluded=verdict), state


def check_uncertain(
    scenario: Scenario, estimate: Any, states: Sequence[SensorState], tracker: str
) -> Verdict:
    """Require a tip that is known well enough, by all sensors together; tracker: its verdict in words."""
    sd, limit = tip_sd(estimate), scenario.control.tip_sd_limit
    if sd <= limit:
        return OK
    states_of = [f"{one.name}: {one.verdict}" for one in states]
    reason = (
        f"known to ± {sd:.2f} mm across, limit {limit:.2f} mm (tracker: {tracker}; {'; '.join(states_of)})"
    )
    return Verdict(VerdictKind.UNCERTAIN, reason)


def tip_sd(estimate: Any) -> float:
    """Return the standard deviation (mm) of the tip's lateral position in the worst direction."""
    return float(np.sqrt(np.linalg.eigvalsh(estimate.tip_covariance[1:, 1:])[-1]))
