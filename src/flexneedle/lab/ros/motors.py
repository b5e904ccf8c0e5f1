"""The driver `ros`: motors as joints of a topic. A count is the unit of the joint, m or rad (`counts_per_mm = 0.001`).

Goals are sent as a stream of set points that move at the limited speed, so that the joints stop when the stream ends.
Acceleration is left to the controller of the joints.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from math import copysign, isfinite
from threading import Thread
from typing import Any, Self

from flexneedle.errors import DriverError, FlexneedleError, make_printable, one_line
from flexneedle.lab.link.fields import DeviceAge
from flexneedle.lab.link.records import LinkRefusal, NodeLoss
from flexneedle.lab.rig.devices.priority import set_normal_priority
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.profile import TopicProfile, load_part
from flexneedle.lab.ros.records import JointReading, JointTargets
from flexneedle.ports import MotorState
from flexneedle.scenario.sections.fields import Section

CONNECTING = "the ROS node is connecting"
_CONNECT_S = 5.0
_REPEAT_S = 1.0  # the last set point is sent for as long, since a busy machine may drop one
_LARGEST = 1e9  # position, in any unit
_LONGEST = 200  # characters of a list of joints


class RosDriverSettings(Section):
    """Settings beside `kind = "ros"` in the section `driver`."""

    profile: str = "neutral"
    """Name or file of the profile."""
    stale_ms: DeviceAge = 200.0
    """Age of the last joint states beyond which the motors count as lost."""


@dataclass(frozen=True)
class SetPoint:
    """A position at `time` (s) that moves to `goal` at no more than `speed`."""

    position: float
    goal: float
    speed: float
    time: float

    def advance(self, now: float) -> "SetPoint":
        """Return the set point at a later time."""
        left = self.goal - self.position
        step = min(abs(left), self.speed * max(0.0, now - self.time))
        position = self.goal if step == abs(left) else self.position + copysign(step, left)
        return replace(self, position=position, time=now)

    @property
    def moving(self) -> bool:
        """Whether the goal is not reached."""
        return self.position != self.goal


class JointLink:
    """A node for joints by name, whose states are no older than `stale_s`.

    Waits for the node, and up to 5 s for joint states. Raises InputError or RunError if the node does not start,
    DriverError if no joint states arrive or a joint is missing.
    """

    def __init__(self, profile: TopicProfile, channels: Sequence[str], stale_s: float) -> None:
        self._channels, self._stale = tuple(channels), stale_s
        topic = profile.subscribe.joint_states
        self._topic = topic.topic if topic else ""
        self._reading: JointReading | None = None
        self._refused = self._lost = ""
        self._node = NodeClient(profile, epoch=time.time() - time.monotonic())
        try:
            self._await_states(time.monotonic() + _CONNECT_S)
            self.read()
        except BaseException:  # also on Ctrl-C: the process must end
            self._node.close()
            raise

    def poll(self) -> None:
        """Take received records. Raises DriverError if the node is lost."""
        for record in self._node.poll():
            if isinstance(record, JointReading):
                self._refused = self._position_problem(record)
                self._reading = self._reading if self._refused else record
            elif isinstance(record, LinkRefusal):
                self._refused = f": {record.reason}"
            elif isinstance(record, NodeLoss):
                self._lost = record.reason
        if self._lost:
            raise DriverError(self._lost)

    def read(self) -> JointReading:
        """Return the newest joint states. Raises DriverError if they are missing, too old or lack a channel."""
        self.poll()
        reading, name = self._reading, self._topic
        if reading is None:
            raise DriverError(f"{name}: no joint states{self._refused}")
        age = time.monotonic() - reading.time
        if age > self._stale:
            raise DriverError(f"{name}: the last joint states are {age:.2f} s old{self._refused}")
        missing = [channel for channel in self._channels if channel not in reading.positions]
        if missing:
            found = make_printable(", ".join(reading.positions))[:_LONGEST]
            raise DriverError(f"{name}: no joint {', '.join(missing)}; joints: {found}")
        return reading

    def _position_problem(self, reading: JointReading) -> str:
        """Return the problem of the first joint of the rig without a possible position, or ""."""
        return next(
            (
                f": joint {channel}: {reading.positions[channel]:g} is not a position"
                for channel in self._channels
                if not abs(reading.positions.get(channel, 0.0)) < _LARGEST
            ),
            "",
        )

    def send(self, positions: Mapping[str, float]) -> None:
        """Send goals of joints, in their units."""
        self._node.publish(JointTargets(time.monotonic(), positions))

    def close(self) -> None:
        """End the node."""
        self._node.close()

    def _await_states(self, deadline: float) -> None:
        while time.monotonic() < deadline:
            self.poll()
            if self._reading is not None:
                return
            time.sleep(0.01)


def connect_in_thread(connect: Callable[[], JointLink]) -> Future[JointLink]:
    """Connect in a thread that ends with the process at the latest."""
    future = Future[JointLink]()

    def run() -> None:
        try:
            set_normal_priority()  # a thread inherits the priority of its parent, here of the ticks
            future.set_result(connect())
        except BaseException as error:  # noqa: BLE001  raised where the result is taken
            future.set_exception(error)

    Thread(target=run, name="connecting", daemon=True).start()
    return future


def close_once_open(future: Future[JointLink]) -> None:
    """Close a connection as soon as it is open."""
    future.add_done_callback(lambda done: None if done.exception() else done.result().close())


class RosMotors:
    """Motors as joints on topics.

    Args:
        channels: Names of the joints.
        connect: Function that opens a link to them.
        address: Domain and topic of the goals.
    """

    def __init__(self, channels: Sequence[str], connect: Callable[[], JointLink], address: str = "") -> None:
        self._channels, self._connect, self.address = tuple(channels), connect, address
        self._speeds: dict[str, float] = {}
        self._offsets = dict.fromkeys(channels, 0.0)
        self._points: dict[str, SetPoint] = {}
        self._send_until = 0.0
        self._link: JointLink | None = connect()
        self._newest: JointReading | None = None  # of the last call of `read`
        self._opening: Future[JointLink] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def read(self) -> Mapping[str, MotorState]:
        """Return the state of every channel, and send the set points of a motion, the last one repeatedly."""
        reading = self._get_link().read()
        if any(point.moving for point in self._points.values()) or time.monotonic() < self._send_until:
            self._advance()
        repeated, self._newest = reading is self._newest, reading
        states = {channel: self._make_state(channel, reading) for channel in self._channels}
        return {channel: replace(state, repeated=repeated) for channel, state in states.items()}

    def set_speed(self, channel: str, speed: float, _acceleration: float) -> None:
        """Limit the speed of present and later motions. The joint's controller limits the acceleration."""
        self._check({channel: speed})
        if not speed > 0.0:
            raise DriverError(f"joint {channel}: speed {speed:g}: must be above 0")
        self._get_link().poll()
        self._speeds[channel] = speed
        if channel in self._points:
            self._points[channel] = replace(self._points[channel].advance(time.monotonic()), speed=speed)

    def follow(self, positions: Mapping[str, float]) -> None:
        """Move channels to absolute positions; each call replaces the one before."""
        self._check(positions)
        reading, now = self._get_link().read(), time.monotonic()
        for channel, position in positions.items():
            if channel not in self._speeds:
                raise DriverError(f"joint {channel}: set its speed first")
            goal = position - self._offsets[channel]
            point = self._points.get(channel) or SetPoint(reading.positions[channel], goal, 0.0, now)
            self._points[channel] = replace(point.advance(now), goal=goal, speed=self._speeds[channel])
        self._send()

    def stop(self) -> None:
        """Hold all channels at their present set points, at once.

        The measured positions are older: a set point there would be a jump back at unlimited speed.
        """
        self._get_link().poll()
        for channel, point in self._points.items():
            self._points[channel] = replace(point, goal=point.position)
        self._send_until = time.monotonic() + _REPEAT_S
        self._send()

    def define(self, channel: str, position: float) -> None:
        """Define the present position of a channel at rest as `position`."""
        self._check({channel: position})
        reading = self._get_link().read()
        if channel in self._points and self._points[channel].moving:
            raise DriverError(f"joint {channel} moves: its position can be defined at rest only")
        self._offsets[channel] = position - reading.positions[channel]

    def power(self, channel: str, on: bool) -> None:
        """Do nothing to switch a joint on, because it is on. Raises DriverError for switching one off."""
        self._check({channel: 0.0})
        if not on:
            raise DriverError(f"joint {channel}: joints of topics cannot be switched off here")
        self._get_link().poll()

    def reconnect(self) -> None:
        """Start a new node in a thread, without the motions of the old one.

        Raises DriverError until the node is connected: call it again. If the connection fails, the error has the
        reason, and the next call starts another node.
        """
        if self._opening is None:
            old, self._link, self._points = self._link, None, {}
            self._opening = connect_in_thread(partial(self._replace, old))
        if not self._opening.done():
            raise DriverError(CONNECTING)
        opened, self._opening = self._opening, None
        try:
            self._link = opened.result()
        except FlexneedleError as error:
            raise DriverError(one_line(error)) from error

    def close(self) -> None:
        """End the node."""
        if self._link is not None:
            self._link.close()
        if self._opening is not None:
            close_once_open(self._opening)

    def _get_link(self) -> JointLink:
        if self._link is None:
            raise DriverError("the ROS node is not connected")
        return self._link

    def _replace(self, old: JointLink | None) -> JointLink:
        if old is not None:
            old.close()
        return self._connect()

    def _make_state(self, channel: str, reading: JointReading) -> MotorState:
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
        self._points = {channel: point.advance(now) for channel, point in self._points.items()}
        self._send()

    def _send(self) -> None:
        if self._points:
            if any(point.moving for point in self._points.values()):
                self._send_until = time.monotonic() + _REPEAT_S
            positions = {channel: point.position for channel, point in self._points.items()}
            self._get_link().send(positions)


def make_motors(settings: Mapping[str, Any], channels: Sequence[str]) -> RosMotors:
    """Return the motors of the settings of a rig file; channels: names of joints.

    Raises RigError for invalid settings or a profile without the topics, InputError if cyclonedds is not installed,
    DriverError if no joint states arrive within 5 s or a joint is missing.
    """
    given = check_settings(RosDriverSettings, settings)
    profile = load_part(given.profile, publish=("joint_targets",), subscribe=("joint_states",))
    topic = profile.publish.joint_targets
    address = f"ROS domain {os.environ.get('ROS_DOMAIN_ID') or 0}, {topic.topic if topic else ''}"
    return RosMotors(channels, partial(JointLink, profile, channels, 1e-3 * given.stale_ms), address)
