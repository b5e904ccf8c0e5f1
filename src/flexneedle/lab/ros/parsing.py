"""Conversion of received messages to records, with checks: other nodes may send anything."""

from collections.abc import Callable, Sequence
from typing import Any

from rosbags.serde import SerdeError

from flexneedle.errors import InputError, make_printable
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, LinkTarget
from flexneedle.lab.link.sensing import MOST_POINTS, read_points
from flexneedle.lab.link.stamps import StampClock
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.needle import is_unfilled, pose_to_point, read_curvatures
from flexneedle.lab.ros.profile import (
    CURVATURES,
    POINT,
    POSE,
    SHAPE,
    PlacedTopic,
    SensorTopic,
    TopicProfile,
)
from flexneedle.lab.ros.records import JointReading, Received, TipReading
from flexneedle.record.messages import STORE, Header
from flexneedle.types import VISIBLE, Point, Reading

LARGEST_BYTES = 1_000_000
"""Longer messages are refused unread."""
_BOOL, _HEADER = "std_msgs/msg/Bool", 4  # bytes before the value
_OF_ONE = ("tip", "shape", "joint_states")
_MOST_JOINTS = 1000  # of a robot, of which the rig uses a few
_LONGEST_TEXT = 60


class Subscription:
    """One key of `subscribe`, or `sensors.NAME`: makes records of the messages of its topic."""

    def __init__(self, profile: TopicProfile, key: str) -> None:
        topic, self.kind = profile.read_topics[key]
        self.key, self.topic = key, topic.topic
        self._frame = FrameMap.of(profile, topic) if isinstance(topic, PlacedTopic) and topic.frame else None
        self._clock = StampClock()
        self._parse = _SENSOR_PARSERS[self.kind] if isinstance(topic, SensorTopic) else _PARSERS[key]
        self._is_measurement = isinstance(topic, SensorTopic) or key in _OF_ONE
        self.order = topic.order if isinstance(topic, SensorTopic) else None
        self.number = self.refused = 0

    def read(self, data: bytes, arrival: float, publishers: int = 1, sent: float = 0.0) -> Received | None:
        """Return the record of a message in CDR that arrived at `arrival` (s, monotonic); None for no request.

        publishers: number of publishers of the topic; sent: stamp (s) of the publisher's DDS, the one of types without
        a header. A message that cannot be accepted gives a `LinkRefusal`, on the
        topic of stops a `LinkStop`.
        """
        self.number += 1
        try:
            if publishers > 1 and self._is_measurement:
                raise InputError(f"{publishers} publishers: measurements must come from one")
            if self.kind == CURVATURES:
                arrival = self._clock.to_time(sent, arrival)
            return self._parse(self, self._deserialize(data), arrival)
        except InputError as error:
            self.refused += 1
            if self.key == "stop":
                return LinkStop(arrival, self.topic, str(error))
            return LinkRefusal(arrival, self.topic, str(error), self.refused)

    def check_frame(self, header: Header) -> FrameMap:
        """Return the map of the topic's frame. Raises InputError if a message has another frame."""
        if self._frame is None:
            raise InputError(f"{self.key} has no frame")
        if header.frame_id.removeprefix("/") != self._frame.id.removeprefix("/"):
            raise InputError(f"frame_id {_quote(header.frame_id)}: must be {_quote(self._frame.id)}")
        return self._frame

    def check_stamp(self, header: Header, arrival: float) -> float:
        """Return the time of measurement by the stamp of a message. Raises InputError for old data."""
        return self._clock.to_time(header.stamp.sec + 1e-9 * header.stamp.nanosec, arrival)

    def _deserialize(self, data: bytes) -> Any:
        if len(data) > LARGEST_BYTES:
            raise InputError(f"{len(data)} bytes: longer than {LARGEST_BYTES}")
        try:
            message = STORE.deserialize_cdr(data, self.kind)
        except SerdeError as error:
            raise InputError(f"not a {self.kind}: {make_printable(str(error))}") from None
        if self.kind == _BOOL and data[_HEADER] > 1:  # the decoder takes any byte but 0 for true
            raise InputError(f"not a {self.kind}: {data[_HEADER]} is neither true nor false")
        return message


def _parse_stop(subscription: Subscription, message: Any, arrival: float) -> Received | None:
    return LinkStop(arrival, subscription.topic) if message.data else None


def _parse_arm(subscription: Subscription, message: Any, arrival: float) -> Received:
    topic = subscription.topic
    return LinkArm(arrival, topic) if message.data else LinkStop(arrival, topic, "disarmed")


def _parse_target(subscription: Subscription, message: Any, arrival: float) -> Received:
    point = subscription.check_frame(message.header).to_point(message.point)
    subscription.check_stamp(message.header, arrival)
    return LinkTarget(arrival, point)


def _parse_tip(subscription: Subscription, message: Any, arrival: float) -> TipReading:
    return _make_reading(subscription, message.header, message.pose, arrival)


def _parse_shape(subscription: Subscription, message: Any, arrival: float) -> TipReading:
    """Return the last pose, the tip; the others are not used."""
    _check_count(message.poses)
    return _make_reading(subscription, message.header, message.poses[-1], arrival)


def _make_reading(subscription: Subscription, header: Header, pose: Any, arrival: float) -> TipReading:
    """Return a reading; an impossible position is a missing one with its reason, because the tracker works."""
    frame, time = subscription.check_frame(header), subscription.check_stamp(header, arrival)
    position: Point | None = None
    orientation, status = None, VISIBLE
    if is_unfilled(pose):
        return TipReading(time, subscription.number, None, None, "missing (position and orientation are 0)")
    try:
        position = frame.to_point(pose.position)
        orientation = frame.to_orientation(pose.orientation)
    except InputError as error:
        if position is None:
            status = str(error)
    return TipReading(time, subscription.number, position, orientation, status)


def _parse_joints(subscription: Subscription, message: Any, arrival: float) -> JointReading:
    """Return the positions; velocities and efforts, which are NaN where an interface is missing, are not used."""
    names, positions = message.name, message.position.tolist()
    if not 1 <= len(names) <= _MOST_JOINTS or len(set(names)) != len(names):
        raise InputError(f"{len(names)} joints: must be 1 to {_MOST_JOINTS}, each once")
    if len(positions) != len(names):
        raise InputError(
            f"{len(names)} names, {len(positions)} positions: must be as many positions as names"
        )
    time = subscription.check_stamp(message.header, arrival)
    return JointReading(time, dict(zip(names, positions, strict=True)))


def _parse_curvatures(subscription: Subscription, message: Any, time: float) -> Reading:
    """Return both curvatures of each grating; time: corrected by the publisher's stamp."""
    return Reading(time, read_curvatures(message, subscription.order))


def _parse_points(subscription: Subscription, message: Any, arrival: float) -> Reading:
    _check_count(message.poses)
    return _read_poses(subscription, message.header, message.poses, arrival)


def _parse_pose(subscription: Subscription, message: Any, arrival: float) -> Reading:
    return _read_poses(subscription, message.header, [message.pose], arrival)


def _read_poses(subscription: Subscription, header: Header, poses: Sequence[Any], arrival: float) -> Reading:
    frame, time = subscription.check_frame(header), subscription.check_stamp(header, arrival)
    return Reading(time, *read_points(poses, lambda pose: pose_to_point(frame, pose)))


def _parse_point(subscription: Subscription, message: Any, arrival: float) -> Reading:
    frame = subscription.check_frame(message.header)
    time = subscription.check_stamp(message.header, arrival)
    return Reading(time, *read_points([message.point], frame.to_point))


def _check_count(poses: Sequence[Any]) -> None:
    if not 1 <= len(poses) <= MOST_POINTS:
        raise InputError(f"{len(poses)} poses: must be 1 to {MOST_POINTS}")


def _quote(text: str) -> str:
    printable = make_printable(text)
    return repr(printable if len(printable) <= _LONGEST_TEXT else printable[:_LONGEST_TEXT] + "…")


_PARSERS: dict[str, Callable[[Subscription, Any, float], Received | None]] = {
    "tip": _parse_tip,
    "shape": _parse_shape,
    "target": _parse_target,
    "stop": _parse_stop,
    "arm": _parse_arm,
    "joint_states": _parse_joints,
}
_SENSOR_PARSERS: dict[str, Callable[[Subscription, Any, float], Received | None]] = {
    CURVATURES: _parse_curvatures,
    SHAPE: _parse_points,
    POINT: _parse_point,
    POSE: _parse_pose,
}
