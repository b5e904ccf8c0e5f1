"""Kinds of measurements that correct the model: each is a file here with a SENSOR."""

from importlib import import_module
from pkgutil import iter_modules

from flexneedle.estimation.sensor import Sensor
from flexneedle.scenario.model import Scenario

POSITION = "tip position"


def _find_sensors() -> dict[str, Sensor]:
    """Return the SENSOR of each module of this package, by name: the tip's position, then in alphabetical order."""
    modules = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
    sensors = sorted((module.SENSOR for module in modules), key=lambda one: (one.name != POSITION, one.name))
    return {sensor.name: sensor for sensor in sensors}


SENSORS: dict[str, Sensor] = _find_sensors()


def sensors_of(scenario: Scenario) -> tuple[Sensor, ...]:
    """Return the sensors of a scenario's tracker, the tip's position first."""
    return tuple(sensor for sensor in SENSORS.values() if sensor.sd(scenario) is not None)
