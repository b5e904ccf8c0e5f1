"""Kinds of measurements that correct the model: lateral quantities of the tip."""

from collections.abc import Callable
from dataclasses import dataclass

from flexneedle.estimation.prior import Priors
from flexneedle.scenario.model import Scenario
from flexneedle.types import THETA, Lateral, Measurement, Y

POSITION = "tip position"


@dataclass(frozen=True)
class Sensor:
    """A lateral quantity of the tip that a tracker measures."""

    name: str
    column: int  # column of y in the tip's pose; z is the next
    offset: str  # name of the slot of its constant offset, which turns with the bevel
    read: Callable[[Measurement], Lateral | None]  # returns y and z of a measurement, None if it has none
    # returns the variance of y or z that a measurement reports, else None
    variance: Callable[[Measurement], float | None]
    # returns the standard deviation of y or z by the scenario, None if the quantity is not measured
    sd: Callable[[Scenario], float | None]
    # returns the standard deviation of the mean of a move's readings which no parameter explains
    unexplained: Callable[[Scenario, Priors], float]


def _read_position(measurement: Measurement) -> Lateral | None:
    return None if measurement.y is None else (measurement.y, measurement.z or 0.0)


def _position_variance(measurement: Measurement) -> float | None:
    if measurement.covariance is None:
        return None
    _, (_, y, _), (_, _, z) = measurement.covariance
    return y if measurement.z is None else 0.5 * (y + z)


def _direction_variance(measurement: Measurement) -> float | None:
    covariance = measurement.direction_covariance
    return None if covariance is None else 0.5 * (covariance[0][0] + covariance[1][1])


def _position_error(scenario: Scenario, settings: Priors) -> float:
    return max(settings.least_model_sd_mm, settings.model_sd * scenario.needle.bevel.offset_mm)


_SENSORS = (
    Sensor(
        POSITION,
        Y,
        "run_out",
        read=_read_position,
        variance=_position_variance,
        sd=lambda scenario: scenario.tracker.jitter_per_axis,
        unexplained=_position_error,
    ),
    Sensor(
        "tip direction",  # slopes dy/dx and dz/dx, of a sensor with 5 or 6 degrees of freedom
        THETA,
        "tilt",
        read=lambda measurement: measurement.direction,
        variance=_direction_variance,
        sd=lambda scenario: scenario.tracker.direction_jitter,
        unexplained=lambda _scenario, settings: 1e-3 * settings.model_slope_sd_mrad,
    ),
)
SENSORS = {sensor.name: sensor for sensor in _SENSORS}
"""The sensors by name, the tip's position first."""


def sensors_of(scenario: Scenario) -> tuple[Sensor, ...]:
    """Return the sensors of a scenario's tracker, the tip's position first."""
    return tuple(sensor for sensor in _SENSORS if sensor.sd(scenario) is not None)
