"""A simulated electromagnetic tracker behind the port of a real one."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from flexneedle.rig.ports import Clock
from flexneedle.rig.tracking.field.poses import SensorPose
from flexneedle.rig.tracking.field.room import SENSORS, Room
from flexneedle.rig.tracking.field.sensors import Noiseless, SensorReadings, noiseless, noisy
from flexneedle.rig.tracking.quaternion import along, from_matrix, product, z_axis
from flexneedle.rig.tracking.registration import Rigid, identity
from flexneedle.rig.tracking.table import TIP
from flexneedle.types import VISIBLE, Floats, Frame, Point, Quaternion, SensorReading

MISSING = "missing"
"""Status of a reading without a position."""


class FieldTracker:
    """Reads the sensors of `poses_at(time)`, by name, poses in the stage's frame, every `period` s. A `Tracker`.

    room: its errors, whose middle lies at `center` (mm) in the stage's frame. A frame arrives `delay` s after it was
    taken, with the time at which it was taken; the first one was taken `delay` and `ahead` s before the start. Each
    sensor on its own sees nothing in a share `missing` of them.
    to_tracker maps the stage's frame to that in which readings are told. plate_distance_at(time): how far the plate
    is from the middle, mm; left out, as in the environment. The roll of the tip sensor, which has one coil, is not
    known: its orientation is the shortest turn to its axis.
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
        plate_distance_at: Callable[[float], float] | None = None,
    ) -> None:
        self._room, self._poses_at, self._clock = room, poses_at, clock
        self._period, self._delay, self._missing = period, delay, missing
        self._center, self._plate_distance_at = np.array(center), plate_distance_at
        self._to_tracker = identity() if to_tracker is None else to_tracker
        self._turn_to_tracker = from_matrix(self._to_tracker.rotation)
        # Noise is drawn by sensor and reading: neither a longer delay, with more readings from before the start, nor
        # another sensor changes it.
        after, before = rng.spawn(2)
        self._rngs = dict(zip(SENSORS, after.spawn(len(SENSORS)), strict=True))
        self._rngs_before = dict(zip(SENSORS, before.spawn(len(SENSORS)), strict=True))
        self._taken = -math.ceil(
            (delay + ahead) / period - 1e-6
        )  # the last frame; number k is taken at k periods
        self._first = self._taken + 1
        self._still: dict[str, tuple[tuple[SensorPose, float | None], Noiseless]] = {}

    def read(self) -> tuple[Frame, ...]:
        """Return the frames that arrived since the last call, oldest first."""
        due = math.floor((self._clock.now() - self._delay) / self._period + 1e-6)
        frames = tuple(self._frame(k) for k in range(self._taken + 1, due + 1))
        self._taken = max(due, self._taken)
        return frames

    @property
    def status(self) -> str:
        """VISIBLE: it never falls silent."""
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
        seen = noisy(self._room.environment, self._noiseless(name, pose, plate), rng)
        if rng.random() < self._missing:
            return SensorReading(None, status=MISSING)
        return self._told(name, seen)

    def _noiseless(self, name: str, pose: SensorPose, plate: float | None) -> Noiseless:
        """As it was in the last frame, if the sensor stands still: references do."""
        last, seen = self._still.get(name, (None, None))
        if seen is None or last != (pose, plate):
            place = np.array([pose.position]) - self._center
            seen = noiseless(self._room, name, place, np.array([pose.orientation]), plate)
            self._still[name] = (pose, plate), seen
        return seen

    def _told(self, name: str, seen: SensorReadings) -> SensorReading:
        place = self._to_tracker.apply(seen.positions[0] + self._center)
        turn = product(self._turn_to_tracker, seen.turns[0])
        if name == TIP:
            turn = along(z_axis(turn))
        indicator = None if seen.indicators is None else float(seen.indicators[0])
        return SensorReading(_point(place), _quaternion(turn), indicator)


def _point(values: Floats) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def _quaternion(values: Floats) -> Quaternion:
    w, x, y, z = values.tolist()
    return w, x, y, z
