"""Conversion of received messages to records, with checks: other nodes may send anything."""

from collections.abc import Callable
from typing import Any

from rosbags.serde import SerdeError

from flexneedle.errors import InputError, make_printable
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, LinkTarget
from flexneedle.lab.link.stamps import StampClock
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.profile import SUBSCRIBED, PlacedTopic, TopicProfile
from flexneedle.lab.ros.records import JointReading, Received, TipReading
from flexneedle.record.messages import STORE, Header
from flexneedle.types import VISIBLE, Point

LARGEST_BYTES = 1_000_000
"""Longer messages are refused unread."""
MOST_POSES = 10_000
_BOOL, _HEADER = "std_msgs/msg/Bool", 4  # bytes before the value
_OF_ONE = ("tip", "shape", "joint_states")
_MOST_JOINTS = 1000  # of a robot, of which the rig uses a few
_LONGEST_TEXT = 60


class Subscription:
    """One key of `subscribe`: makes records of the messages of its topic."""

    def __init__(self, profile: TopicProfile, key: str) -> None:
        topic = getattr(profile.subscribe, key)
        self.key, self.topic, self.kind = key, topic.topic, SUBSCRIBED[key]
        self._frame = FrameMap.of(profile, topic) if isinstance(topic, PlacedTopic) else None
        self._clock = StampClock()
        self.number = self.refused = 0

    def read(self, data: bytes, arrival: float, publishers: int = 1) -> Received | None:
        """Return the record of a message in CDR that arrived at `arrival` (s, monotonic); None for no request.

        publishers: number of publishers of the topic. A message that cannot be accepted gives a `LinkRefusal`, on the
        topic of stops a `LinkStop`.
        """
        self.number += 1
        try:
            if publishers > 1 and self.key in _OF_ONE:
                raise InputError(f"{publishers} publishers: measurements must come from one")
            return _PARSERS[self.key](self, self._deserialize(data), arrival)
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
    count = len(message.poses)
    if not 1 <= count <= MOST_POSES:
        raise InputError(f"{count} poses: must be 1 to {MOST_POSES}")
    return _make_reading(subscription, message.header, message.poses[-1], arrival)


def _make_reading(subscription: Subscription, header: Header, pose: Any, arrival: float) -> TipReading:
    """Return a reading; an impossible position is a missing one with its reason, because the tracker works."""
    frame, time = subscription.check_frame(header), subscription.check_stamp(header, arrival)
    position: Point | None = None
    orientation, status = None, VISIBLE
    numbers = (pose.position, pose.orientation)
    if not any(getattr(part, axis, 0.0) for part in numbers for axis in "xyzw"):
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
