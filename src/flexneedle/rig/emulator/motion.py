"""Poses of the emulated sensors in each frame: the tip moves on a circle or rests, the references rest around it.

Poses are in the frame of an Aurora: the field generator at z = 0, the volume in front of it at z < 0 (mm). They depend
only on seed, sensor, frame number and the resting position of the tip, so that any frame can be reproduced.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, pi, sin, sqrt

import numpy as np

from flexneedle.types import Point, Quaternion

RATE_HZ = 40.0
"""Frame rate."""
SENSORS = ("tip", "ref1", "ref2", "ref3")
"""The sensors at ports 1 to 4: a 5-DOF tip and three 6-DOF references."""

CENTRE = (0.0, 0.0, -200.0)
"""Center of the circle (mm)."""

_RADIUS_MM, _PERIOD_S = 30.0, 20.0
_REFERENCES = {"ref1": (60.0, 0.0, -200.0), "ref2": (-60.0, 40.0, -200.0), "ref3": (-60.0, -40.0, -200.0)}
_JITTER_MM = 0.07  # RMS length, for a tip in an ideal environment
_INDICATOR, _INDICATOR_SPREAD = 0.024, 0.006


@dataclass(frozen=True)
class EmulatedPose:
    """A sensor in one frame: position (mm) and unit quaternion in the tracker's frame, indicator."""

    position: Point
    orientation: Quaternion
    indicator: float


@lru_cache(maxsize=64)  # a frame is requested several times
def pose(sensor: str, number: int, seed: int, rest: Point | None = None) -> EmulatedPose:
    """Return a sensor's pose in a frame, with jitter: the tip on its circle or at `rest` (mm), the others at rest."""
    noise = np.random.default_rng((seed, SENSORS.index(sensor), number)).standard_normal(4)
    position, orientation = _at_rest(sensor, rest) or _on_the_circle(number)
    x, y, z = (float(c + n * _JITTER_MM / sqrt(3)) for c, n in zip(position, noise[:3], strict=True))
    return EmulatedPose((x, y, z), orientation, float(abs(_INDICATOR + _INDICATOR_SPREAD * noise[3])))


def _at_rest(sensor: str, rest: Point | None) -> tuple[Point, Quaternion] | None:
    """Return position and orientation of a sensor at rest, None for a tip that moves."""
    position = rest if sensor == "tip" else _REFERENCES[sensor]
    return None if position is None else (position, (1.0, 0.0, 0.0, 0.0))


def _on_the_circle(number: int) -> tuple[Point, Quaternion]:
    """Return position and orientation on a circle about z; the sensor's z axis is tangential, in the plane of x, y."""
    angle = 2 * pi * number / (RATE_HZ * _PERIOD_S)
    x, y, z = CENTRE
    position = (x + _RADIUS_MM * cos(angle), y + _RADIUS_MM * sin(angle), z)
    # From z to x by a quarter turn about y; then about z to the tangent, a quarter turn ahead of the radius.
    half = (angle + pi / 2) / 2
    c, s = cos(half) / sqrt(2), sin(half) / sqrt(2)
    return position, (c, -s, c, s)
