"""Public names for a motor driver or a tracker of a rig file: ports, records, settings and errors."""

from flexneedle.errors import DriverError, RigError
from flexneedle.lab.rig.devices.opening import MotorsFactory, TrackerFactory
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock, MotorPaces, Motors, MotorSetup, MotorState, Tracker
from flexneedle.scenario.sections.fields import Section
from flexneedle.types import VISIBLE, Frame, SensorReading

__all__ = [
    "VISIBLE",
    "Clock",
    "DriverError",
    "Frame",
    "MotorPaces",
    "MotorSetup",
    "MotorState",
    "Motors",
    "MotorsFactory",
    "RigError",
    "Section",
    "SensorReading",
    "Tracker",
    "TrackerFactory",
    "check_settings",
]
