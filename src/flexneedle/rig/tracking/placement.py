"""Where a lab puts its reference sensors: around the workspace, and where the field is clean."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from flexneedle.rig.tracking.field.poses import SensorPose, reference_poses
from flexneedle.rig.tracking.field.room import Room
from flexneedle.rig.tracking.field.sensors import noiseless, noisy
from flexneedle.types import Floats, Point

_TRIES = 40
_FURTHEST_MM = 30.0  # moved away from the needle for a clean place, a reference would speak for another field
_READINGS = 40


def placed_references(
    room: Room, center: Point, limit: float, rng: np.random.Generator, plate_distance: float | None = None
) -> Mapping[str, SensorPose]:
    """Return poses of the three references near those of the environment, each where it tells less than `limit`.

    The paper keeps all indicators below the threshold as the experiment begins (section IV-B); a reference that does
    not is moved, by 30 mm at most. Where no place of forty is clean, the best of them stays. plate_distance (mm): as
    in `Room`.
    """

    def told(name: str, pose: SensorPose) -> float:
        place = np.array([pose.position]) - np.array(center)
        return _indicator(room, name, place, np.array([pose.orientation]), rng, plate_distance)

    poses = reference_poses(room.environment, center)
    return {name: _clean(partial(told, name), pose, limit, rng) for name, pose in poses.items()}


def _clean(
    told: Callable[[SensorPose], float], first: SensorPose, limit: float, rng: np.random.Generator
) -> SensorPose:
    best, least = first, told(first)
    for _ in range(1, _TRIES):
        if least < limit:
            break
        way = rng.normal(0.0, 1.0, 3)
        way *= _FURTHEST_MM * rng.random() ** (1 / 3) / np.linalg.norm(way)
        x, y, z = (np.array(first.position) + way).tolist()
        pose = SensorPose((x, y, z), first.orientation)
        if (value := told(pose)) < least:
            best, least = pose, value
    return best


def _indicator(
    room: Room,
    name: str,
    place: Floats,
    turn: Floats,
    rng: np.random.Generator,
    plate_distance: float | None,
) -> float:
    """Median indicator of a second at rest."""
    places, turns = (values.repeat(_READINGS, 0) for values in (place, turn))
    told = noisy(room.environment, noiseless(room, name, places, turns, plate_distance), rng).indicators
    if told is None:
        raise ValueError(f"{name} has no indicator: it is not a reference")
    return float(np.median(told))
