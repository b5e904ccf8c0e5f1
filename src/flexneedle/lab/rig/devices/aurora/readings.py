"""Conversion of the link's values of a sensor to a reading, or to the reason why there is none. Pure functions."""

from collections.abc import Mapping, Sequence
from math import hypot, isfinite
from typing import Any

from flexneedle.lab.rig.devices.aurora.library import DISABLED
from flexneedle.types import FARTHEST_MM, VISIBLE, SensorReading

NAMES = ("tip", "ref1", "ref2", "ref3")
"""Sensors at the ports 1 to 4 (default)."""

_MEASURED = 0  # other kinds: disabled, missing, and a port that is not occupied
_STALE = SensorReading(None, status="stale")
_BITS = {
    0x0040: "out of volume",
    0x0100: "broken coil",
    0x0200: "disturbed",
    0x0400: "signal too small",
    0x0800: "signal too large",
    0x1000: "processing exception",
    0x2000: "hardware failure",
    0x0080: "partly out of volume",
}
_OCCUPIED = 0x01
_POSE = 8
_UNIT_WITHIN = 1e-2  # TX rounds to 1e-4


def sensor_name(port: str, channel: str, names: Sequence[str]) -> str:
    """Return the name of the sensor at a port ("01") and channel ("00") from PHINF.

    The name depends only on the port, not on the other ports in use, so that sensors are never mixed up. The second
    sensor of a split port is NAME.2, and a port beyond the names is portN.
    """
    known = port.isdigit() and 1 <= int(port) <= len(names)
    name = names[int(port) - 1] if known else f"port{port.lstrip('0') or '0'}"
    return name if channel == "00" else f"{name}.{int(channel, 16) + 1}"


def make_readings(
    found: Mapping[str, Sequence[Any]], number: int, names: Mapping[str, str]
) -> dict[str, SensorReading]:
    """Return the readings of a frame by name. found: values from the link; names: by port handle."""
    return {
        names[handle]: _STALE if kind == _MEASURED and frame != number else make_reading(kind, status, pose)
        for handle, (kind, status, frame, pose) in found.items()
    }


def make_reading(kind: int, status: int, pose: Sequence[float]) -> SensorReading:
    """Return a sensor's reading: kind and port status from ndicapi, pose q0 qx qy qz, x y z (mm), indicator.

    Only a sensor completely inside the volume has a position.
    """
    fault = _find_fault(kind, status)
    if fault == VISIBLE and not _is_valid(pose):
        fault = "bad transform"
    if fault != VISIBLE:
        return SensorReading(None, status=fault)
    length = hypot(*pose[:4])
    w, qx, qy, qz = (part / length for part in pose[:4])
    x, y, z = pose[4:7]
    return SensorReading((x, y, z), (w, qx, qy, qz), pose[7])


def _find_fault(kind: int, status: int) -> str:
    """Return VISIBLE or the reason why a sensor has no position."""
    if kind == DISABLED:  # without a port status in ndicapi
        return "disabled"
    if not status & _OCCUPIED:
        return "unplugged"
    fault = next((words for bit, words in _BITS.items() if status & bit), None)
    return fault or (VISIBLE if kind == _MEASURED else "missing")


def _is_valid(pose: Sequence[float]) -> bool:
    return (
        len(pose) == _POSE
        and all(map(isfinite, pose))
        and abs(hypot(*pose[:4]) - 1) < _UNIT_WITHIN
        and max(map(abs, pose[4:7])) <= FARTHEST_MM
    )
