"""From what the tracker's line says of a sensor to a reading, or to why there is none. Pure."""

from collections.abc import Mapping, Sequence
from math import hypot, isfinite
from typing import Any

from flexneedle.rig.devices.aurora.library import DISABLED
from flexneedle.types import VISIBLE, SensorReading

NAMES = ("tip", "ref1", "ref2", "ref3")
"""Sensors at the ports 1 to 4, unless said otherwise."""

_SEEN, _MISSING = 0, 2
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
_FARTHEST_MM = 10_000.0
_UNIT_WITHIN = 1e-2  # TX rounds to 1e-4


def sensor_name(port: str, channel: str, names: Sequence[str]) -> str:
    """Return the name of the sensor at a port ("01") and channel ("00"), as PHINF tells them.

    A port has the same name whichever others are in use, so that no sensor is ever taken for another. The second
    sensor of a split port is NAME.2, and a port beyond the names is portN.
    """
    known = port.isdigit() and 1 <= int(port) <= len(names)
    name = names[int(port) - 1] if known else f"port{port.lstrip('0') or '0'}"
    return name if channel == "00" else f"{name}.{int(channel, 16) + 1}"


def readings(
    found: Mapping[str, Sequence[Any]], number: int, names: Mapping[str, str]
) -> dict[str, SensorReading]:
    """Return the readings of a frame by name. found: as the link tells it; names: by port handle."""
    return {
        names[handle]: _STALE if gone == _SEEN and frame != number else reading(gone, status, pose)
        for handle, (gone, status, frame, pose) in found.items()
    }


def reading(gone: int, status: int, pose: Sequence[float]) -> SensorReading:
    """Return the reading in a frame: gone and status as ndicapi says them, pose q0 qx qy qz, x y z (mm), indicator.

    Only a sensor that is wholly inside of the volume has a position.
    """
    ill = _why_not(gone, status)
    if ill == VISIBLE and not _is_sound(pose):
        ill = "bad transform"
    if ill != VISIBLE:
        return SensorReading(None, status=ill)
    length = hypot(*pose[:4])
    w, qx, qy, qz = (part / length for part in pose[:4])
    x, y, z = pose[4:7]
    return SensorReading((x, y, z), (w, qx, qy, qz), pose[7])


def _why_not(gone: int, status: int) -> str:
    if gone == DISABLED:  # ndicapi does not read its port status then
        return "disabled"
    if not status & _OCCUPIED:
        return "unplugged"
    said = next((words for bit, words in _BITS.items() if status & bit), None)
    return said or ("missing" if gone == _MISSING else VISIBLE)


def _is_sound(pose: Sequence[float]) -> bool:
    return (
        all(map(isfinite, pose))
        and abs(hypot(*pose[:4]) - 1) < _UNIT_WITHIN
        and max(map(abs, pose[4:7])) < _FARTHEST_MM
    )
