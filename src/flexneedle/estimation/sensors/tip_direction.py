"""Direction of the tip, as slopes dy/dx and dz/dx: a sensor with 5 or 6 degrees of freedom measures it."""

from flexneedle.estimation.prior import Priors
from flexneedle.estimation.sensor import Sensor
from flexneedle.scenario.model import Scenario
from flexneedle.types import THETA, Lateral, Measurement


def _read(measurement: Measurement) -> Lateral | None:
    return measurement.direction


def _variance(measurement: Measurement) -> float | None:
    covariance = measurement.direction_covariance
    return None if covariance is None else 0.5 * (covariance[0][0] + covariance[1][1])


def _sd(scenario: Scenario) -> float | None:
    return scenario.tracker.direction_jitter


def _unexplained(_scenario: Scenario, settings: Priors) -> float:
    return 1e-3 * settings.model_slope_sd_mrad


SENSOR = Sensor("tip direction", THETA, _read, _variance, _sd, _unexplained, "tilt")
