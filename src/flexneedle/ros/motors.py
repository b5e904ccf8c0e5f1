"""The driver `ros`: motors as joints of a topic. A count is the joint's own unit, m or rad (`counts_per_mm = 0.001`).

Targets are sent as a stream of set points that move at the limited speed, so that the joints stop by themselves when
the stream does. Acceleration is left to the controller of the joints.
"""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import copysign, isfinite
from typing import Any, Self

from flexneedle.errors import DriverError
from flexneedle.rig.ports import MotorState
from flexneedle.ros.client import NodeClient
from flexneedle.ros.profile import Profile
from flexneedle.ros.records import JointReading, JointTargets, Lost, Refused
from flexneedle.ros.settings import DriverSettings, checked, profile_with
from flexneedle.scenario.problems import printable

_CONNECT_S = 5.0
_LONGEST = 200  # characters of a list of joints


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
        self._profile, self._channels, self._stale = profile, tuple(channels), stale_s
        self._speeds: dict[str, float] = {}
        self._offsets = dict.fromkeys(channels, 0.0)
        self._connect()

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
        reading = self._fresh()
        if any(point.moving for point in self._points.values()):
            self._advance()
        return {channel: self._state(channel, reading) for channel in self._channels}

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
        reading, now = self._fresh(), time.monotonic()
        for channel, position in positions.items():
            if channel not in self._speeds:
                raise DriverError(f"joint {channel}: set its speed first")
            goal = position - self._offsets[channel]
            point = self._points.get(channel) or SetPoint(reading.positions[channel], goal, 0.0, now)
            self._points[channel] = replace(point.at(now), goal=goal, speed=self._speeds[channel])
        self._stopped = False
        self._send()

    def stop(self) -> None:
        """Hold all channels where they were measured last, at once, or at their set points if that is too old."""
        self._poll()
        if not self._stopped:
            now = time.monotonic()
            held = self._measured_lately(now)
            for channel, point in self._points.items():
                place = held.get(channel, point.at(now).position)
                self._points[channel] = SetPoint(place, place, point.speed, now)
            self._stopped = True
        self._send()

    def define(self, channel: str, position: float) -> None:
        """Call the present position of a channel at rest `position`."""
        self._check({channel: position})
        reading = self._fresh()
        if channel in self._points and self._points[channel].moving:
            raise DriverError(f"joint {channel}: moves: its position can be defined at rest only")
        self._offsets[channel] = position - reading.positions[channel]

    def power(self, channel: str, on: bool) -> None:
        """Joints of topics are on: switching one on does nothing. Raises DriverError for switching one off."""
        self._check({channel: 0.0})
        if not on:
            raise DriverError(f"joint {channel}: joints of topics cannot be switched off here")

    def reconnect(self) -> None:
        """Start a new node. Motions that were under way are not taken up."""
        self._node.close()
        self._connect()

    def close(self) -> None:
        """End the node."""
        self._node.close()

    def _connect(self) -> None:
        self._node = NodeClient(self._profile, epoch=time.time() - time.monotonic())
        self._reading: JointReading | None = None
        self._refused = ""
        self._points: dict[str, SetPoint] = {}
        self._stopped = True
        try:
            self._await_states(time.monotonic() + _CONNECT_S)
            self._fresh()
        except BaseException:  # also on Ctrl-C: the process must end
            self._node.close()
            raise

    def _await_states(self, deadline: float) -> None:
        while time.monotonic() < deadline:
            self._poll()
            if self._reading is not None:
                return
            time.sleep(0.01)

    def _poll(self) -> None:
        for request in self._node.poll():
            if isinstance(request, JointReading):
                self._reading, self._refused = request, ""
            elif isinstance(request, Refused):
                self._refused = f": {request.reason}"
            elif isinstance(request, Lost):
                raise DriverError(request.reason)

    def _fresh(self) -> JointReading:
        """The newest joint states. Raises DriverError if they are missing, too old or without a channel."""
        self._poll()
        topic, reading = self._profile.subscribe.joint_states, self._reading
        name = topic.topic if topic else ""
        if reading is None:
            raise DriverError(f"{name}: no joint states{self._refused}")
        age = time.monotonic() - reading.time
        if age > self._stale:
            raise DriverError(f"{name}: the last joint states are {age:.2f} s old{self._refused}")
        missing = [channel for channel in self._channels if channel not in reading.positions]
        if missing:
            found = printable(", ".join(reading.positions))[:_LONGEST]
            raise DriverError(f"{name}: no joint {', '.join(missing)}; joints: {found}")
        return reading

    def _measured_lately(self, now: float) -> Mapping[str, float]:
        """Measured positions, none if they are too old."""
        reading = self._reading
        return reading.positions if reading is not None and now - reading.time <= self._stale else {}

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
            self._node.publish(JointTargets(time.monotonic(), positions))


def make_motors(settings: Mapping[str, Any], channels: Sequence[str]) -> RosMotors:
    """Return the motors of the settings of a rig file; channels: names of joints.

    Raises RigError for invalid settings or a profile without the topics, InputError if cyclonedds is not installed,
    DriverError if no joint states arrive within 5 s or a joint is not among them.
    """
    given = checked(settings, DriverSettings)
    profile = profile_with(given.profile, "publish.joint_targets", "subscribe.joint_states")
    return RosMotors(profile, channels, 1e-3 * given.stale_ms)
