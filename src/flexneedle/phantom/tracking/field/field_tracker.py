"""A simulated electromagnetic tracker with the port of a real one."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from flexneedle.geometry.quaternion import along, from_matrix, product, z_axis
from flexneedle.geometry.rigid import Rigid, identity
from flexneedle.phantom.tracking.field.poses import SensorPose
from flexneedle.phantom.tracking.field.room import SENSORS, Room
from flexneedle.phantom.tracking.field.sensors import Noiseless, SensorReadings, noiseless, noisy
from flexneedle.ports import Clock
from flexneedle.types import TIP, VISIBLE, Floats, Frame, Point, Quaternion, SensorReading

MISSING = "missing"
"""Status of a reading without a position."""


class FieldTracker:
    """Simulated electromagnetic tracker: a `Tracker`.

    The roll of the tip sensor, which has one coil, is not measured: its orientation is the shortest rotation of the z
    axis to its axis.

    Args:
        room: Errors of the sensors.
        poses_at: Returns the true poses of the sensors by name, in the stage's frame, at a time.
        clock: Clock of the run.
        period: Time between two frames (s).
        rng: Random numbers.
        center: Center of the room in the stage's frame (mm).
        delay: Time (s) from a frame to its arrival; a frame has the time of measurement.
        ahead: Further time (s) before the start from which frames are available.
        missing: Share of the frames in which a sensor is missing, independently of the others.
        to_tracker: Map from the stage's frame to the tracker's.
        plate_distance_at: Returns the distance (mm) of the plate from the center at a time (default, and None: the
            environment's).
    """

    def __init__(
        self,
        room: Room,
        poses_at: Callable[[float], Mapping[str, SensorPose]],
        clock: Clock,
        period: float,
        rng: np.random.Generator,
        *,
        center: Point = (0.0, 0.0, 0.0),
        delay: float = 0.0,
        ahead: float = 0.0,
        missing: float = 0.0,
        to_tracker: Rigid | None = None,
        plate_distance_at: Callable[[float], float | None] | None = None,
    ) -> None:
        self._room, self._poses_at, self._clock = room, poses_at, clock
        self._period, self._delay, self._missing = period, delay, missing
        self._center, self._plate_distance_at = np.array(center), plate_distance_at
        self._to_tracker = identity() if to_tracker is None else to_tracker
        self._rotation_to_tracker = from_matrix(self._to_tracker.rotation)
        # Each sensor has two generators, for readings before the start and for later ones: neither the delay nor
        # another sensor changes the noise of later ones.
        after, before = rng.spawn(2)
        self._rngs = dict(zip(SENSORS, after.spawn(len(SENSORS)), strict=True))
        self._rngs_before = dict(zip(SENSORS, before.spawn(len(SENSORS)), strict=True))
        self._taken = -math.ceil((delay + ahead) / period - 1e-6)  # number k is taken at k periods
        self._first = self._taken + 1
        self._at_rest: dict[str, tuple[tuple[SensorPose, float | None], Noiseless]] = {}

    def read(self) -> tuple[Frame, ...]:
        """Return the frames that arrived since the last call, oldest first."""
        due = math.floor((self._clock.now() - self._delay) / self._period + 1e-6)
        frames = tuple(self._frame(k) for k in range(self._taken + 1, due + 1))
        self._taken = max(due, self._taken)
        return frames

    @property
    def status(self) -> str:
        """VISIBLE: it never stops."""
        return VISIBLE

    def _frame(self, number: int) -> Frame:
        time = number * self._period
        plate = None if self._plate_distance_at is None else self._plate_distance_at(time)
        rngs = self._rngs if time > 0.0 else self._rngs_before
        readings = {
            name: self._reading(name, pose, plate, rngs[name]) for name, pose in self._poses_at(time).items()
        }
        return Frame(time, number - self._first, readings)

    def _reading(
        self, name: str, pose: SensorPose, plate: float | None, rng: np.random.Generator
    ) -> SensorReading:
        readings = noisy(self._room.environment, self._noiseless(name, pose, plate), rng)
        if rng.random() < self._missing:
            return SensorReading(None, status=MISSING)
        return self._in_tracker_frame(name, readings)

    def _noiseless(self, name: str, pose: SensorPose, plate: float | None) -> Noiseless:
        """Return the reading without noise; the previous one for a sensor at rest, such as a reference."""
        last, exact = self._at_rest.get(name, (None, None))
        if exact is None or last != (pose, plate):
            position = np.array([pose.position]) - self._center
            exact = noiseless(self._room, name, position, np.array([pose.orientation]), plate)
            self._at_rest[name] = (pose, plate), exact
        return exact

    def _in_tracker_frame(self, name: str, readings: SensorReadings) -> SensorReading:
        position = self._to_tracker.apply(readings.positions[0] + self._center)
        orientation = product(self._rotation_to_tracker, readings.orientations[0])
        if name == TIP:
            orientation = along(z_axis(orientation))
        indicator = None if readings.indicators is None else float(readings.indicators[0])
        return SensorReading(_point(position), _quaternion(orientation), indicator)


def _point(values: Floats) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def _quaternion(values: Floats) -> Quaternion:
    w, x, y, z = values.tolist()
    return w, x, y, z
