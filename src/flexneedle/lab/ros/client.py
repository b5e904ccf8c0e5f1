"""Client of the ROS node. Only its start waits."""

from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from select import select
from time import monotonic
from typing import Self

from flexneedle.errors import InputError, RunError
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.ros.profile import INSERTION_KEYS, TopicProfile
from flexneedle.lab.ros.records import (
    NodeHeartbeat,
    NodeLoss,
    NodeSetup,
    Published,
    Received,
    RosState,
    RosTarget,
)
from flexneedle.results import Period, Plan
from flexneedle.types import VISIBLE

_START_S, _SILENT_S, _STOP_S = 30.0, 1.0, 2.0


def check_installed() -> None:
    """Raise InputError if cyclonedds is not installed."""
    if find_spec("cyclonedds") is None:
        raise InputError("ROS 2 needs cyclonedds, which is not installed: pip install 'flexneedle[ros]'")


def open_node(profile: TopicProfile, *, epoch: float = 0.0) -> "NodeClient":
    """Start the node of an insertion, which publishes the topics of the profile and reads stop, arm and target.

    epoch: Unix time (s) of the records' time 0, for the stamps of messages (default: stamps are the records' times).
    Raises InputError if cyclonedds is not installed or ROS_DOMAIN_ID is invalid, RunError if the node does not start.
    """
    return NodeClient(profile.select(**INSERTION_KEYS), epoch=epoch)


class NodeClient:
    """A node that publishes and reads all topics of a profile. Use it as a context manager, or call `close`.

    subscribers, publishers: number of nodes of each topic, by key of `publish` and `subscribe`, at the last `poll`.
    """

    def __init__(self, profile: TopicProfile, *, epoch: float = 0.0) -> None:
        check_installed()
        self._process = ChildProcess(f"{__package__}.node", keep_printed=True)
        self._channel, self._lost = self._process.channel, ""
        self._heard_at: float | None = None
        self._early: list[Received] = []
        self.subscribers: Mapping[str, int] = {}
        self.publishers: Mapping[str, int] = {}
        self._channel.send(NodeSetup(profile, epoch))
        try:
            self._await_ready()
        except BaseException:  # also on Ctrl-C: the process must end
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def publish(self, record: Plan | Period | Published) -> None:
        """Publish a record. If the node does not keep up, the oldest periods and joint targets are dropped."""
        light = replace(record, shapes=record.shapes[:0], history=()) if isinstance(record, Plan) else record
        self._channel.send(light, keep=isinstance(record, Plan | RosTarget | RosState))

    def poll(self) -> list[Received]:
        """Return the records received since the last call, oldest first. No record follows a `NodeLoss`."""
        self._channel.flush()
        received, self._early = self._early, []
        for record in self._channel.receive():
            if isinstance(record, NodeHeartbeat):
                self._heard_at = record.time
                self.subscribers, self.publishers = record.subscribers, record.publishers
            else:
                received.append(record)
        if not self._lost and (reason := self._find_loss()):
            received.append(NodeLoss(monotonic(), reason))
        self._lost = next((one.reason for one in received if isinstance(one, NodeLoss)), self._lost)
        return received

    def wait(self, seconds: float) -> None:
        """Wait until a record arrives, at most for `seconds`."""
        select([self._channel], [], [], seconds)

    @property
    def status(self) -> str:
        """VISIBLE while the node shows signs of life, otherwise the reason in a few words."""
        return self._lost or self._find_loss() or VISIBLE

    @property
    def pid(self) -> int:
        """Identifier of the node's process."""
        return self._process.pid

    @property
    def dropped(self) -> int:
        """Number of records that were not published because the node did not keep up."""
        return self._channel.dropped

    def close(self) -> None:
        """End the node."""
        self._process.end(_STOP_S)
        self._process.close()

    def _find_loss(self) -> str:
        """Return the reason why nothing more is received, or ""."""
        if self._channel.ended:
            line = self._process.last_line()
            return f"the ROS node has ended: {line}" if line else "the ROS node has ended"
        silent = 0.0 if self._heard_at is None else monotonic() - self._heard_at
        return f"the ROS node does not answer for {silent:.1f} s" if silent > _SILENT_S else ""

    def _await_ready(self) -> None:
        deadline = monotonic() + _START_S
        while self._heard_at is None:
            if monotonic() > deadline:
                raise RunError(f"the ROS node has not started within {_START_S:g} s")
            self.wait(0.1)
            self._early = self.poll()  # a stop may come first
            if self._lost:
                raise RunError(self._lost)
