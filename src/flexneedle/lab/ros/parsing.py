"""Conversion of received messages to records, with checks: other nodes may send anything."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

from rosbags.serde import SerdeError

from flexneedle.errors import InputError, make_printable
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.profile import SUBSCRIBED, PlacedTopic, TopicProfile
from flexneedle.lab.ros.records import (
    JointReading,
    Received,
    RosArm,
    RosRefusal,
    RosStop,
    RosTarget,
    TipReading,
)
from flexneedle.record.messages import STORE, Header
from flexneedle.types import VISIBLE, Point

LARGEST_BYTES = 1_000_000
"""Longer messages are refused unread."""
MOST_POSES = 10_000
_BOOL, _HEADER = "std_msgs/msg/Bool", 4  # bytes before the value
_OF_ONE = ("tip", "shape", "joint_states")
_MOST_JOINTS = 1000  # of a robot, of which the rig uses a few
_LONGEST_TEXT = 60
_WINDOW_S = 10.0
_MOST_IN_WINDOW = 1000
_OBSERVED_S = 0.5  # of a clock that was set back, before a time is derived from it


class StampClock:
    """Times of measurement on the clock of this computer, from the stamps and arrivals of one topic.

    The sender's clock differs by an unknown amount, estimated as the smallest difference of arrival and stamp in the
    last 10 s (the message with the least delay). A delayed message thus keeps its earlier time, and no time is later
    than the arrival. Messages with a stamp before the last one are refused. If two of them are in order, the clock was
    set back or both were delayed: earlier differences are forgotten, and messages are refused until differences of half
    a second are known. A single old message has no effect, because it may be a delayed one.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque(maxlen=_MOST_IN_WINDOW)
        self._last = -math.inf  # the largest stamp that was not old
        self._newest = -math.inf  # the largest stamp since the clock was last set back
        self._behind: float | None = None  # stamp of the previous message, if it was before the newest
        self._since = -math.inf  # arrival at which observation of the clock began

    def to_time(self, stamp: float, arrival: float) -> float:
        """Return the time (s) of measurement, on the clock of `arrival`, of a message with `stamp` (s).

        Raises InputError if the message is not newer than the one before, or has no stamp to detect old data by.
        """
        if stamp == 0.0:
            raise InputError("no time stamp: old data could not be recognised")
        if stamp <= self._newest and self._behind is not None and stamp > self._behind:
            self._newest, self._since = -math.inf, arrival
            self._differences.clear()
        self._behind = stamp if stamp <= self._newest else None
        if self._behind is None:
            self._newest = stamp
            self._add(arrival, stamp)
        if stamp <= self._last:
            back = self._last - stamp
            raise InputError(f"old data: its stamp is {back:.3f} s before the last message's")
        self._last = stamp
        if arrival < self._since + _OBSERVED_S:
            raise InputError(f"its clock was set back: refused until observed for {_OBSERVED_S:g} s")
        return stamp + min(difference for _, difference in self._differences)

    def _add(self, arrival: float, stamp: float) -> None:
        self._differences.append((arrival, arrival - stamp))
        while self._differences[0][0] < arrival - _WINDOW_S:
            self._differences.popleft()


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

        publishers: number of publishers of the topic. A message that cannot be accepted gives a `RosRefusal`, on the
        topic of stops a `RosStop`.
        """
        self.number += 1
        try:
            if publishers > 1 and self.key in _OF_ONE:
                raise InputError(f"{publishers} publishers: measurements must come from one")
            return _PARSERS[self.key](self, self._deserialize(data), arrival)
        except InputError as error:
            self.refused += 1
            if self.key == "stop":
                return RosStop(arrival, self.topic, str(error))
            return RosRefusal(arrival, self.topic, str(error), self.refused)

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
    return RosStop(arrival, subscription.topic) if message.data else None


def _parse_arm(subscription: Subscription, message: Any, arrival: float) -> Received:
    topic = subscription.topic
    return RosArm(arrival, topic) if message.data else RosStop(arrival, topic, "disarmed")


def _parse_target(subscription: Subscription, message: Any, arrival: float) -> Received:
    point = subscription.check_frame(message.header).to_point(message.point)
    subscription.check_stamp(message.header, arrival)
    return RosTarget(arrival, point)


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
