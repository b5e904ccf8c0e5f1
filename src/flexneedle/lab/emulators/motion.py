"""Poses of the emulated sensors in each frame: the tip moves with its source, the references rest around it.

Poses are in the frame of an Aurora: the field generator at z = 0, the volume in front of it at z < 0 (mm). The noise
depends only on seed, sensor and frame number, so that any frame can be reproduced.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, pi, sin, sqrt
from statistics import NormalDist
from typing import Protocol

import numpy as np

from flexneedle.geometry.quaternion import from_vector, product
from flexneedle.types import Floats, Point, Quaternion

RATE_HZ = 40.0
"""Frame rate."""
SENSORS = ("tip", "ref1", "ref2", "ref3")
"""The sensors at ports 1 to 4: a 5-DOF tip and three 6-DOF references."""

CENTRE = (0.0, 0.0, -200.0)
"""Center of the circle (mm)."""

JITTER_MM = 0.07
"""RMS length of the deviation of a position, for a tip in an ideal environment."""

_RADIUS_MM, _PERIOD_S = 30.0, 20.0
_REFERENCES = {"ref1": (60.0, 0.0, -200.0), "ref2": (-60.0, 40.0, -200.0), "ref3": (-60.0, -40.0, -200.0)}
_INDICATOR, _INDICATOR_SPREAD = 0.024, 0.006
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EmulatedPose:
    """A sensor in one frame: position (mm) and unit quaternion in the tracker's frame, indicator."""

    position: Point
    orientation: Quaternion
    indicator: float


class TipSource(Protocol):
    """True poses of the tip by frame. Frame 0 is taken at power-on, others at `RATE_HZ`."""

    def newest(self, number: int) -> int:
        """Return the number of the newest frame, up to this one, in which the pose is known."""
        ...

    def at(self, number: int) -> tuple[Point, Quaternion]:
        """Return position (mm) and orientation of the tip's sensor in a frame, at most the newest.

        Both are in the tracker's frame.
        """
        ...


@dataclass(frozen=True)
class CirclingTip:
    """A tip that moves on a circle about z; the sensor's z axis is tangential, in the plane of x, y."""

    def newest(self, number: int) -> int:
        """Return the frame itself: all are known."""
        return number

    def at(self, number: int) -> tuple[Point, Quaternion]:
        """Return position (mm) and orientation in a frame."""
        angle = 2 * pi * number / (RATE_HZ * _PERIOD_S)
        x, y, z = CENTRE
        position = (x + _RADIUS_MM * cos(angle), y + _RADIUS_MM * sin(angle), z)
        # From z to x by a quarter turn about y; then about z to the tangent, a quarter turn ahead of the radius.
        half = (angle + pi / 2) / 2
        c, s = cos(half) / sqrt(2), sin(half) / sqrt(2)
        return position, (c, -s, c, s)


@dataclass(frozen=True)
class RestingTip:
    """A tip at rest at a position (mm), not rotated."""

    position: Point

    def newest(self, number: int) -> int:
        """Return the frame itself: all are known."""
        return number

    def at(self, _number: int) -> tuple[Point, Quaternion]:
        """Return position (mm) and orientation in any frame."""
        return self.position, _UPRIGHT


CIRCLE = CirclingTip()


@dataclass(frozen=True)
class SensorNoise:
    """Errors of the tip's sensor.

    position: RMS length of the deviation (mm); direction: standard deviation of a coordinate (rad); missing: share of
    the frames without a reading.
    """

    position: float = JITTER_MM
    direction: float = 0.0
    missing: float = 0.0


ORDINARY = SensorNoise()


def sensor_pose(
    sensor: str, number: int, seed: int, source: TipSource = CIRCLE, noise: SensorNoise = ORDINARY
) -> EmulatedPose:
    """Return a sensor's pose in a frame, with noise: the tip by its source, the others at rest."""
    drawn = _draw_noise(sensor, number, seed)
    if sensor == SENSORS[0]:
        position, orientation = source.at(number)
        size, orientation = noise.position, _tilt(orientation, noise.direction * drawn[4:6])
    else:
        position, orientation, size = _REFERENCES[sensor], _UPRIGHT, JITTER_MM
    x, y, z = (float(c + n * size / sqrt(3)) for c, n in zip(position, drawn[:3], strict=True))
    return EmulatedPose((x, y, z), orientation, float(abs(_INDICATOR + _INDICATOR_SPREAD * drawn[3])))


def is_missing(number: int, seed: int, noise: SensorNoise) -> bool:
    """Return whether the tip is not measured in a frame."""
    if noise.missing == 0.0:
        return False
    return bool(_draw_noise(SENSORS[0], number, seed)[6] < NormalDist().inv_cdf(noise.missing))


@lru_cache(maxsize=64)  # a frame is requested several times
def _draw_noise(sensor: str, number: int, seed: int) -> Floats:
    """Return normal numbers (7,) of a sensor in a frame: 3 for position, indicator, 2 for its axis, missing."""
    drawn = np.random.default_rng((seed, SENSORS.index(sensor), number)).standard_normal(7)
    drawn.setflags(write=False)
    return drawn


def _tilt(orientation: Quaternion, angles: Floats) -> Quaternion:
    """Return the orientation after small rotations (2,) in rad about the sensor's x and y axes."""
    if not angles.any():
        return orientation
    small = from_vector(np.array([*angles, 0.0]))
    w, x, y, z = product(np.array(orientation), small).tolist()
    return w, x, y, z
