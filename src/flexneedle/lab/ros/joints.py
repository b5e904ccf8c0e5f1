"""States and targets of joints on topics, over a node of their own."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from threading import Thread

from flexneedle.errors import DriverError, make_printable
from flexneedle.lab.rig.devices.priority import set_normal_priority
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.profile import Profile
from flexneedle.lab.ros.records import JointReading, JointTargets, Lost, Refused

_CONNECT_S = 5.0
_LONGEST = 200  # characters of a list of joints


class JointLink:
    """The connection to joints by name, whose states are no older than `stale_s`.

    It waits for the node, and up to 5 s for joint states. Raises InputError or RunError if the node does not start,
    DriverError if no joint states arrive or a joint is not among them.
    """

    def __init__(self, profile: Profile, channels: Sequence[str], stale_s: float) -> None:
        self._channels, self._stale = tuple(channels), stale_s
        topic = profile.subscribe.joint_states
        self._topic = topic.topic if topic else ""
        self._reading: JointReading | None = None
        self._refused = ""
        self._node = NodeClient(profile, epoch=time.time() - time.monotonic())
        try:
            self._await_states(time.monotonic() + _CONNECT_S)
            self.fresh()
        except BaseException:  # also on Ctrl-C: the process must end
            self._node.close()
            raise

    def poll(self) -> None:
        """Take what was received. Raises DriverError if the node is lost."""
        for request in self._node.poll():
            if isinstance(request, JointReading):
                self._reading, self._refused = request, ""
            elif isinstance(request, Refused):
                self._refused = f": {request.reason}"
            elif isinstance(request, Lost):
                raise DriverError(request.reason)

    def fresh(self) -> JointReading:
        """The newest joint states. Raises DriverError if they are missing, too old or without a channel."""
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

    def send(self, positions: Mapping[str, float]) -> None:
        """Send the positions that joints are to take, in their own units."""
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


def opening(connect: Callable[[], JointLink]) -> Future[JointLink]:
    """Connect in a thread, which ends with the process at the latest."""
    found = Future[JointLink]()

    def run() -> None:
        try:
            set_normal_priority()  # a thread has that of the one that starts it, here of the ticks
            found.set_result(connect())
        except BaseException as error:  # noqa: BLE001  raised where the result is taken
            found.set_exception(error)

    Thread(target=run, name="connecting", daemon=True).start()
    return found


def abandon(found: Future[JointLink]) -> None:
    """Close a connection as soon as it is open."""
    found.add_done_callback(lambda done: None if done.exception() else done.result().close())
