"""True poses of sensors in the frame of the stage; references are placed where their indicator is low."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from flexneedle.geometry.quaternion import along
from flexneedle.phantom.tracking.field.room import REFERENCES, Room
from flexneedle.phantom.tracking.field.sensors import noiseless, noisy
from flexneedle.scenario.sections.environment import Environment
from flexneedle.types import Floats, Point, Quaternion

_TRIES = 40
_FURTHEST_MM = 30.0  # further away a reference would not represent the field at the needle
_READINGS = 40
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


def placed_references(
    room: Room, center: Point, limit: float, rng: np.random.Generator, plate_distance: float | None = None
) -> Mapping[str, SensorPose]:
    """Return poses of the references near those given by the environment, each with an indicator below `limit`.

    In the paper all indicators are below the threshold at the start of the experiment (section IV-B). A reference above
    it is moved by at most 30 mm; the best of forty positions is used if none is below the limit. plate_distance (mm):
    as in `Room`.
    """

    def indicator(name: str, pose: SensorPose) -> float:
        position = np.array([pose.position]) - np.array(center)
        return _indicator(room, name, position, np.array([pose.orientation]), rng, plate_distance)

    poses = reference_poses(room.environment, center)
    return {name: _clean(partial(indicator, name), pose, limit, rng) for name, pose in poses.items()}


def _clean(
    indicator: Callable[[SensorPose], float], first: SensorPose, limit: float, rng: np.random.Generator
) -> SensorPose:
    best, least = first, indicator(first)
    for _ in range(1, _TRIES):
        if least < limit:
            break
        shift = rng.normal(0.0, 1.0, 3)
        shift *= _FURTHEST_MM * rng.random() ** (1 / 3) / np.linalg.norm(shift)
        x, y, z = (np.array(first.position) + shift).tolist()
        pose = SensorPose((x, y, z), first.orientation)
        if (value := indicator(pose)) < least:
            best, least = pose, value
    return best


def _indicator(
    room: Room,
    name: str,
    position: Floats,
    orientation: Floats,
    rng: np.random.Generator,
    plate_distance: float | None,
) -> float:
    """Return the median indicator over a second at rest."""
    positions, orientations = (values.repeat(_READINGS, 0) for values in (position, orientation))
    exact = noiseless(room, name, positions, orientations, plate_distance)
    indicators = noisy(room.environment, exact, rng).indicators
    if indicators is None:
        raise ValueError(f"{name} has no indicator: must be a reference")
    return float(np.median(indicators))
