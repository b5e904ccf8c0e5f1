"""Conversion of coordinates of the insertion to coordinates of a topic and back: axes, signs, origin and unit.

Messages are built in metres with x along the insertion (`flexneedle.record.messages`). A pose on the needle has axes,
too: if the needle is straight along the insertion, its orientation in the frame of the insertion is the identity.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, isfinite

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import from_matrix, product
from flexneedle.lab.ros.profile import PlacedTopic, TopicProfile
from flexneedle.record.messages import PointMessage, PoseMessage
from flexneedle.record.messages import Quaternion as QuaternionMessage
from flexneedle.types import FARTHEST_MM, Floats, Point, Quaternion

_UNIT_LENGTH = 1e-2  # tolerance; the quaternion of an unfilled message has length 0
_OVERFLOW = 1e100
_PER_METRE = {"m": 1.0, "mm": 1e3}
_TO_Z = np.array([0.5, 0.5, 0.5, 0.5])  # z to x, x to y, y to z: a tracker's sensor has the needle along z
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class FrameMap:
    """Map between the frame of the insertion and the frame of a topic.

    id: name of the frame; per_metre: its units in a metre; rotation (3, 3): from coordinates of the insertion; origin:
    the insertion's, in this frame, m; turn: the quaternion of `rotation`; body: the quaternion of the axes of a pose on
    the needle.
    """

    id: str
    per_metre: float
    rotation: Floats
    origin: Floats
    turn: Floats
    body: Floats

    @classmethod
    def of(cls, profile: TopicProfile, topic: PlacedTopic) -> "FrameMap":
        """Return the map of a topic of a profile."""
        frame = profile.frames[topic.frame]
        rotation, body = frame.rotation, profile.needle.rotation
        origin = 1e-3 * np.array(frame.origin_mm)
        return cls(
            frame.id, _PER_METRE[topic.unit], rotation, origin, from_matrix(rotation), from_matrix(body)
        )

    # To the topic

    def map_poses(self, poses: Sequence[PoseMessage]) -> list[PoseMessage]:
        """Return poses on the needle in the frame of the topic."""
        if not len(poses):
            return []
        positions = self._map_positions(np.array([_xyz(one.position) for one in poses]))
        turns = np.array([_wxyz(one.orientation) for one in poses])
        if not self._has_same_axes:
            turn, back = (np.broadcast_to(one, turns.shape) for one in (self.turn, self.body * _CONJUGATE))
            turns = product(product(turn, turns), back)
        pairs = zip(positions.tolist(), turns.tolist(), strict=True)
        return [PoseMessage(PointMessage(*xyz), _to_quaternion(turn)) for xyz, turn in pairs]

    def map_pose(self, pose: PoseMessage) -> PoseMessage:
        """Return a pose on the needle in the frame of the topic."""
        return self.map_poses([pose])[0]

    def map_point(self, point: PointMessage) -> PointMessage:
        """Return a point in the frame of the topic."""
        return PointMessage(*self._map_positions(np.array([_xyz(point)]))[0].tolist())

    @property
    def axes(self) -> QuaternionMessage:
        """Orientation of the axes of the insertion in the frame of the topic."""
        return _to_quaternion(self.turn.tolist())

    def map_covariance(self, matrix: Floats) -> Floats:
        """Return the covariance (3, 3), m², of a position in the frame of the topic and its unit."""
        return self.per_metre**2 * self.map_turns(matrix)

    def map_turns(self, matrix: Floats) -> Floats:
        """Return the covariance (3, 3), rad², of a rotation about the axes of the topic."""
        turned: Floats = self.rotation @ matrix @ self.rotation.T
        return turned

    # From the topic

    def to_point(self, point: PointMessage) -> Point:
        """Return a position (mm) in the frame of the insertion.

        Raises InputError for a position that is not finite or too far.
        """
        given = [value / self.per_metre for value in _xyz(point)]
        if not all(map(isfinite, given)):
            raise InputError(f"position {_format(_xyz(point))}: not a number")
        near = max(map(abs, given)) < _OVERFLOW
        x, y, z = (
            (1e3 * (np.array(given) - self.origin) @ self.rotation).tolist() if near else (FARTHEST_MM,) * 3
        )
        if hypot(x, y, z) > FARTHEST_MM:
            raise InputError(f"position {_format(_xyz(point))}: farther than 10 m")
        return x, y, z

    def to_orientation(self, turn: QuaternionMessage) -> Quaternion:
        """Return the rotation from a sensor with z along the needle to the frame of the insertion.

        Raises InputError for anything but a unit quaternion.
        """
        given = _wxyz(turn)
        length = hypot(*given)
        if not isfinite(length) or abs(length - 1.0) > _UNIT_LENGTH:
            raise InputError(f"orientation {_format(given)}: not a unit quaternion")
        needle = product(product(self.turn * _CONJUGATE, np.array(given) / length), self.body)
        w, x, y, z = product(needle, _TO_Z).tolist()
        return w, x, y, z

    def _map_positions(self, metres: Floats) -> Floats:
        """Return positions (n, 3), m, in the frame of the topic and its unit."""
        placed = metres if self._has_same_place else metres @ self.rotation.T + self.origin
        scaled: Floats = placed if self.per_metre == 1.0 else self.per_metre * placed
        return scaled

    @property
    def _has_same_axes(self) -> bool:
        """Whether axes need no change, so that numbers remain exact to the last bit."""
        return bool((self.turn == _NO_TURN).all() and (self.body == _NO_TURN).all())

    @property
    def _has_same_place(self) -> bool:
        return bool((self.turn == _NO_TURN).all() and not self.origin.any())


def _xyz(point: PointMessage) -> Point:
    return point.x, point.y, point.z


def _wxyz(turn: QuaternionMessage) -> Quaternion:
    return turn.w, turn.x, turn.y, turn.z


def _to_quaternion(turn: Sequence[float]) -> QuaternionMessage:
    w, x, y, z = turn
    return QuaternionMessage(x, y, z, w)


def _format(numbers: Sequence[float]) -> str:
    return f"({', '.join(f'{number:.6g}' for number in numbers)})"
