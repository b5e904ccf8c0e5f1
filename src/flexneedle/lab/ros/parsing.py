"""Received messages to records: checks of what other nodes send, which may be anything."""

from collections.abc import Callable
from typing import Any

from rosbags.serde import SerdeError

from flexneedle.errors import InputError, make_printable
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.profile import SUBSCRIBED, PlacedTopic, Profile
from flexneedle.lab.ros.records import (
    Arm,
    JointReading,
    Refused,
    Request,
    ShapeReading,
    Stop,
    Target,
    TipReading,
)
from flexneedle.lab.ros.stamps import Stamps
from flexneedle.record.messages import STORE, Header
from flexneedle.types import VISIBLE, Point

_BOOL, _HEADER = "std_msgs/msg/Bool", 4  # bytes before the value
_OF_ONE = ("tip", "shape", "joint_states")
LARGEST_BYTES = 1_000_000
"""Longer messages are refused unread."""
MOST_POSES = 10_000
_MOST_JOINTS = 64
_LARGEST_JOINT = 1e9  # in any unit
_LONGEST_SHOWN = 60


class Subscription:
    """One key of `subscribe`: makes records of the messages of its topic."""

    def __init__(self, profile: Profile, key: str) -> None:
        topic = getattr(profile.subscribe, key)
        self.key, self.topic, self.kind = key, topic.topic, SUBSCRIBED[key]
        self.frame = FrameMap.of(profile, topic) if isinstance(topic, PlacedTopic) else None
        self.stamps = Stamps()
        self.number = self.refused = 0

    def read(self, data: bytes, arrival: float, publishers: int = 1) -> Request | None:
        """The record of a message in CDR that arrived at `arrival` (s, monotonic); None if it asks for nothing.

        publishers: of the topic. What cannot be taken is `Refused`; on the topic of stops it is a stop.
        """
        self.number += 1
        try:
            if publishers > 1 and self.key in _OF_ONE:
                raise InputError(f"{publishers} publishers: measurements must come from one")
            return _READERS[self.key](self, self._message(data), arrival)
        except InputError as error:
            self.refused += 1
            if self.key == "stop":
                return Stop(arrival, self.topic, str(error))
            return Refused(arrival, self.topic, str(error), self.refused)

    def placed(self, header: Header) -> FrameMap:
        """The map of the topic's frame. Raises InputError if a message has another frame."""
        if self.frame is None:
            raise InputError(f"{self.key} has no frame")
        if header.frame_id.removeprefix("/") != self.frame.id.removeprefix("/"):
            raise InputError(f"frame_id {_shown(header.frame_id)}: must be {_shown(self.frame.id)}")
        return self.frame

    def measured(self, header: Header, arrival: float) -> float:
        """When a message was measured, by its stamp. Raises InputError for old data."""
        return self.stamps.measured(header.stamp.sec + 1e-9 * header.stamp.nanosec, arrival)

    def _message(self, data: bytes) -> Any:
        if len(data) > LARGEST_BYTES:
            raise InputError(f"{len(data)} bytes: longer than {LARGEST_BYTES}")
        try:
            message = STORE.deserialize_cdr(data, self.kind)
        except SerdeError as error:
            raise InputError(f"not a {self.kind}: {make_printable(str(error))}") from None
        if self.kind == _BOOL and data[_HEADER] > 1:  # anything but 0 would be true
            raise InputError(f"not a {self.kind}: {data[_HEADER]} is neither true nor false")
        return message


def _stop(subscription: Subscription, message: Any, arrival: float) -> Request | None:
    return Stop(arrival, subscription.topic) if message.data else None


def _arm(subscription: Subscription, message: Any, arrival: float) -> Request:
    return Arm(arrival, subscription.topic) if message.data else Stop(arrival, subscription.topic, "disarmed")


def _target(subscription: Subscription, message: Any, arrival: float) -> Request:
    point = subscription.placed(message.header).to_point(message.point)
    subscription.measured(message.header, arrival)
    return Target(arrival, point)


def _tip(subscription: Subscription, message: Any, arrival: float) -> TipReading:
    return _reading(subscription, message.header, message.pose, arrival)


def _shape(subscription: Subscription, message: Any, arrival: float) -> ShapeReading:
    count = len(message.poses)
    if not 1 <= count <= MOST_POSES:
        raise InputError(f"{count} poses: must be 1 to {MOST_POSES}")
    frame = subscription.placed(message.header)
    points = tuple(frame.to_point(one.position) for one in message.poses)
    return ShapeReading(points, _reading(subscription, message.header, message.poses[-1], arrival))


def _reading(subscription: Subscription, header: Header, pose: Any, arrival: float) -> TipReading:
    """A tip that is not where it can be is a missing one, with its reason: the tracker itself does work."""
    frame, time = subscription.placed(header), subscription.measured(header, arrival)
    position: Point | None = None
    orientation, status = None, VISIBLE
    try:
        position = frame.to_point(pose.position)
        orientation = frame.to_orientation(pose.orientation)
    except InputError as error:
        if position is None:
            status = str(error)
    return TipReading(time, subscription.number, position, orientation, status)


def _joints(subscription: Subscription, message: Any, arrival: float) -> JointReading:
    names, positions, velocities = message.name, message.position.tolist(), message.velocity.tolist()
    if not 1 <= len(names) <= _MOST_JOINTS or len(set(names)) != len(names):
        raise InputError(f"{len(names)} joints: must be 1 to {_MOST_JOINTS}, each once")
    if len(positions) != len(names) or len(velocities) not in (0, len(names)):
        counts = f"{len(names)} names, {len(positions)} positions, {len(velocities)} velocities"
        raise InputError(f"{counts}: must be as many positions as names, and as many velocities or none")
    for name, value in (*zip(names, positions, strict=True), *zip(names, velocities, strict=False)):
        if not abs(value) < _LARGEST_JOINT:
            raise InputError(f"joint {_shown(name)}: {value:g} is not a position or speed")
    time = subscription.measured(message.header, arrival)
    return JointReading(
        time, dict(zip(names, positions, strict=True)), dict(zip(names, velocities, strict=False))
    )


def _shown(text: str) -> str:
    shown = make_printable(text)
    return repr(shown if len(shown) <= _LONGEST_SHOWN else shown[:_LONGEST_SHOWN] + "…")


_READERS: dict[str, Callable[[Subscription, Any, float], Request | None]] = {
    "tip": _tip,
    "shape": _shape,
    "target": _target,
    "stop": _stop,
    "arm": _arm,
    "joint_states": _joints,
}
