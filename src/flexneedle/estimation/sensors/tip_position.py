"""Position of the tip."""

from flexneedle.estimation.prior import Priors
from flexneedle.estimation.sensor import Sensor
from flexneedle.scenario.model import Scenario
from flexneedle.types import Lateral, Measurement, Y


def _read(measurement: Measurement) -> Lateral | None:
    return None if measurement.y is None else (measurement.y, measurement.z or 0.0)


def _variance(measurement: Measurement) -> float | None:
    if measurement.covariance is None:
        return None
    _, (_, y, _), (_, _, z) = measurement.covariance
    return y if measurement.z is None else 0.5 * (y + z)


def _sd(scenario: Scenario) -> float:
    return scenario.tracker.jitter_per_axis


def _unexplained(scenario: Scenario, settings: Priors) -> float:
    return max(settings.least_model_sd_mm, settings.model_sd * scenario.needle.bevel.offset_mm)


SENSOR = Sensor("tip position", Y, _read, _variance, _sd, _unexplained, "run_out")
