"""Conformance kits: checks of a controller, plant, driver, motors, tracker or sensor against the contract of its port.

Subclass a kit in a pytest file, and return your part from `make`:

    from flexneedle.testing import ControllerConformance

    class TestMine(ControllerConformance):
        def make(self):
            return MY_CONTROLLER
"""

from flexneedle.testing.controller import ControllerConformance
from flexneedle.testing.driver import DriverConformance
from flexneedle.testing.motors_kit import MotorsConformance
from flexneedle.testing.needle_sensor import NeedleSensorConformance
from flexneedle.testing.plant import PlantConformance
from flexneedle.testing.sensor import SensorConformance
from flexneedle.testing.tip_tracker import TipTrackerConformance
from flexneedle.testing.tracker_kit import TrackerConformance

__all__ = [
    "ControllerConformance",
    "DriverConformance",
    "MotorsConformance",
    "NeedleSensorConformance",
    "PlantConformance",
    "SensorConformance",
    "TipTrackerConformance",
    "TrackerConformance",
]
