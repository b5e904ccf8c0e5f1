"""Public names for rig files and their devices: ports, records, settings, errors, and the rig of a file."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.errors import DriverError, RigError
from flexneedle.lab.rig.devices.opening import MotorsFactory, SensorFactory, TrackerFactory
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock, MotorPaces, Motors, MotorSetup, MotorState, NeedleSensor, Tracker
from flexneedle.scenario.sections.fields import Section
from flexneedle.types import VISIBLE, Frame, Reading, SensorReading

if TYPE_CHECKING:
    from flexneedle.lab.rig.rig_file import RigFile
    from flexneedle.lab.rig.supervised import SupervisedRig, Tick
    from flexneedle.lab.ros.bridge import Bridge

__all__ = [
    "VISIBLE",
    "Bridge",
    "Clock",
    "DriverError",
    "Frame",
    "MotorPaces",
    "MotorSetup",
    "MotorState",
    "Motors",
    "MotorsFactory",
    "NeedleSensor",
    "Reading",
    "RigError",
    "Section",
    "SensorFactory",
    "SensorReading",
    "Tick",
    "Tracker",
    "TrackerFactory",
    "check_settings",
    "open_rig",
]


# Not needed by drivers, and slow to import.
_LATER = {"Bridge": "flexneedle.lab.ros.bridge", "Tick": "flexneedle.lab.rig.supervised"}


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LATER[name]), name)


def open_rig(file: "str | Path | RigFile", *, dry_run: bool = False) -> "SupervisedRig":
    """Return the rig of a rig file for `flexneedle.insert(…, rig=…)`.

    Args:
        file: A rig file, or its name or path.
        dry_run: Whether the motors are only read and never move (default: False).

    Raises:
        RigError: The rig file breaks a rule.
    """
    from flexneedle.lab.rig.supervised import SupervisedRig  # not needed by drivers, and slow to import

    return SupervisedRig(file, dry_run=dry_run)
