"""The driver `ros`: motors as joints of a topic. A count is the joint's own unit, m or rad (`counts_per_mm = 0.001`).

Targets are sent as a stream of set points that move at the limited speed, so that the joints stop by themselves when
the stream does. Acceleration is left to the controller of the joints.
"""

import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from math import copysign, isfinite
from typing import Any, Self

from flexneedle.errors import DriverError, FlexneedleError, one_line
from flexneedle.lab.ros.joints import JointLink, abandon, opening
from flexneedle.lab.ros.profile import Profile
from flexneedle.lab.ros.records import JointReading
from flexneedle.lab.ros.settings import DriverSettings, checked, profile_with
from flexneedle.ports import MotorState

_CONNECTING = "the ROS node is connecting"


@dataclass(frozen=True)
class SetPoint:
    """A position that moves to `goal` at no more than `speed`; position is that at `time` (s)."""

    position: float
    goal: float
    speed: float
    time: float

    def at(self, now: float) -> "SetPoint":
        """The set point at a later time."""
        left = self.goal - self.position
        step = min(abs(left), self.speed * max(0.0, now - self.time))
        position = self.goal if step == abs(left) else self.position + copysign(step, left)
        return replace(self, position=position, time=now)

    @property
    def moving(self) -> bool:
        """Whether the goal is not reached."""
        return self.position != self.goal


class RosMotors:
    """The port `Motors` of joints on topics; channels are the names of joints."""

    def __init__(self, profile: Profile, channels: Sequence[str], stale_s: float) -> None:
        self._profile, self._channels = profile, tuple(channels)
        self._speeds: dict[str, float] = {}
        self._offsets = dict.fromkeys(channels, 0.0)
        self._points: dict[str, SetPoint] = {}
        self._connect = partial(JointLink, profile, self._channels, stale_s)
        self._link: JointLink | None = self._connect()
        self._newest: JointReading | None = None  # of the last call of `read`
        self._opening: Future[JointLink] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        """Domain and topic of the targets."""
        topic = self._profile.publish.joint_targets
        return f"ROS domain {os.environ.get('ROS_DOMAIN_ID') or 0}, {topic.topic if topic else ''}"

    def read(self) -> Mapping[str, MotorState]:
        """State of every channel; it also sends the set points of a motion that is under way."""
        reading = self._connected.fresh()
        if any(point.moving for point in self._points.values()):
            self._advance()
        repeated, self._newest = reading is self._newest, reading
        states = {channel: self._state(channel, reading) for channel in self._channels}
        return {channel: replace(state, repeated=repeated) for channel, state in states.items()}

    def set_speed(self, channel: str, speed: float, _acceleration: float) -> None:
        """Limit the speed of the motions to come, and of those under way. The acceleration is that of the joint."""
        self._check({channel: speed})
        if not speed > 0.0:
            raise DriverError(f"joint {channel}: speed {speed:g}: must be above 0")
        self._speeds[channel] = speed
        if channel in self._points:
            self._points[channel] = replace(self._points[channel].at(time.monotonic()), speed=speed)

    def follow(self, positions: Mapping[str, float]) -> None:
        """Move channels to absolute positions; each call replaces the one before."""
        self._check(positions)
        reading, now = self._connected.fresh(), time.monotonic()
        for channel, position in positions.items():
            if channel not in self._speeds:
                raise DriverError(f"joint {channel}: set its speed first")
            goal = position - self._offsets[channel]
            point = self._points.get(channel) or SetPoint(reading.positions[channel], goal, 0.0, now)
            self._points[channel] = replace(point.at(now), goal=goal, speed=self._speeds[channel])
        self._send()

    def stop(self) -> None:
        """Hold all channels at their present set points, at once.

        Not where they were measured, which was earlier: a set point there would be a jump back, at no limited speed.
        """
        self._connected.poll()
        for channel, point in self._points.items():
            self._points[channel] = replace(point, goal=point.position)
        self._send()

    def define(self, channel: str, position: float) -> None:
        """Call the present position of a channel at rest `position`."""
        self._check({channel: position})
        reading = self._connected.fresh()
        if channel in self._points and self._points[channel].moving:
            raise DriverError(f"joint {channel}: moves: its position can be defined at rest only")
        self._offsets[channel] = position - reading.positions[channel]

    def power(self, channel: str, on: bool) -> None:
        """Joints of topics are on: switching one on does nothing. Raises DriverError for switching one off."""
        self._check({channel: 0.0})
        if not on:
            raise DriverError(f"joint {channel}: joints of topics cannot be switched off here")

    def reconnect(self) -> None:
        """Start a new node, in a thread; motions that were under way are not taken up.

        Raises DriverError until the node is connected: call it again. Also with the reason, if it does not connect;
        the next call starts another one.
        """
        if self._opening is None:
            old, self._link, self._points = self._link, None, {}
            self._opening = opening(partial(self._reopened, old))
        if not self._opening.done():
            raise DriverError(_CONNECTING)
        found, self._opening = self._opening, None
        try:
            self._link = found.result()
        except FlexneedleError as error:
            raise DriverError(one_line(error)) from error

    def close(self) -> None:
        """End the node."""
        if self._link is not None:
            self._link.close()
        if self._opening is not None:
            abandon(self._opening)

    @property
    def _connected(self) -> JointLink:
        if self._link is None:
            raise DriverError("the ROS node is not connected")
        return self._link

    def _reopened(self, old: JointLink | None) -> JointLink:
        if old is not None:
            old.close()
        return self._connect()

    def _state(self, channel: str, reading: JointReading) -> MotorState:
        measured, offset = reading.positions[channel], self._offsets[channel]
        point = self._points.get(channel)
        commanded = measured if point is None else point.position
        return MotorState(measured + offset, commanded + offset, point is not None and point.moving)

    def _check(self, values: Mapping[str, float]) -> None:
        for channel, value in values.items():
            if channel not in self._channels:
                raise DriverError(f"joint {channel!r}: must be one of {', '.join(self._channels)}")
            if not isfinite(value):
                raise DriverError(f"joint {channel}: {value:g} is not a number")

    def _advance(self) -> None:
        now = time.monotonic()
        self._points = {channel: point.at(now) for channel, point in self._points.items()}
        self._send()

    def _send(self) -> None:
        if self._points:
            positions = {channel: point.position for channel, point in self._points.items()}
            self._connected.send(positions)


def make_motors(settings: Mapping[str, Any], channels: Sequence[str]) -> RosMotors:
    """Return the motors of the settings of a rig file; channels: names of joints.

    Raises RigError for invalid settings or a profile without the topics, InputError if cyclonedds is not installed,
    DriverError if no joint states arrive within 5 s or a joint is not among them.
    """
    given = checked(settings, DriverSettings)
    profile = profile_with(given.profile, "publish.joint_targets", "subscribe.joint_states")
    return RosMotors(profile, channels, 1e-3 * given.stale_ms)
