"""True poses of sensors in the frame of the stage."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.geometry.quaternion import along
from flexneedle.phantom.tracking.field.room import REFERENCES
from flexneedle.scenario.sections.environment import Environment
from flexneedle.types import Point, Quaternion

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""Orientation of a sensor with axes parallel to the stage's."""


class SensorPose(NamedTuple):
    """Position (mm) and orientation of a sensor in the frame of the stage; its z axis is along the needle."""

    position: Point
    orientation: Quaternion = UPRIGHT


def tip_sensor_pose(tip: Sequence[float], direction: Sequence[float], offset: float = 0.0) -> SensorPose:
    """Return the pose of the sensor `offset` mm behind the `tip` (x, y, z) mm of a needle that points in `direction`.

    direction: x, y, z, of any length above 0.
    """
    position, axis = np.asarray(tip, dtype=float), np.asarray(direction, dtype=float)
    axis = axis / np.linalg.norm(axis)
    x, y, z = (position - offset * axis).tolist()
    w, i, j, k = along(axis).tolist()
    return SensorPose((x, y, z), (w, i, j, k))


def reference_poses(environment: Environment, center: Point) -> Mapping[str, SensorPose]:
    """Return the poses of the three references around a workspace with its center at `center` (mm), not rotated."""
    sensor = environment.reference
    positions = zip(REFERENCES, (sensor.ref1_mm, sensor.ref2_mm, sensor.ref3_mm), strict=True)
    return {name: SensorPose((x + center[0], y + center[1], z + center[2])) for name, (x, y, z) in positions}
