"""Client of a protocol's node, a process. Only its start waits."""

from dataclasses import replace
from select import select
from time import monotonic
from typing import Any, Self

from flexneedle.errors import RunError
from flexneedle.lab.link.records import NodeHeartbeat, NodeLoss
from flexneedle.lab.process import ChildProcess
from flexneedle.results import Period, Plan
from flexneedle.types import VISIBLE

_START_S, _SILENT_S, _STOP_S = 30.0, 1.0, 2.0


class LinkClient:
    """A node that publishes and receives records. Use it as a context manager, or call `close`.

    Args:
        module: Module of the node's process.
        setup: The first record to it.
        name: Name of the protocol in messages.

    Raises RunError if the node does not start.
    """

    droppable: tuple[type, ...] = (Period,)
    """Records of which the oldest are dropped if the node does not keep up."""

    def __init__(self, module: str, setup: object, name: str) -> None:
        self._process = ChildProcess(module, keep_printed=True)
        self._channel, self._lost, self._name = self._process.channel, "", name
        self._heard_at: float | None = None
        self._early: list[Any] = []
        self._channel.send(setup)
        try:
            self._await_ready()
        except BaseException:  # also on Ctrl-C: the process must end
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def publish(self, record: Any) -> None:
        """Publish a record. If the node does not keep up, the oldest of `droppable` are dropped."""
        light = replace(record, shapes=record.shapes[:0], history=()) if isinstance(record, Plan) else record
        self._channel.send(light, keep=not isinstance(record, self.droppable))

    def poll(self) -> list[Any]:
        """Return the records received since the last call, oldest first. No record follows a `NodeLoss`."""
        self._channel.flush()
        received, self._early = self._early, []
        for record in self._channel.receive():
            if isinstance(record, NodeHeartbeat):
                self._take_heartbeat(record)
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

    def _take_heartbeat(self, beat: NodeHeartbeat) -> None:
        self._heard_at = beat.time

    def _find_loss(self) -> str:
        """Return the reason why nothing more is received, or ""."""
        node = f"the {self._name} node"
        if self._channel.ended:
            line = self._process.last_line()
            return f"{node} has ended: {line}" if line else f"{node} has ended"
        silent = 0.0 if self._heard_at is None else monotonic() - self._heard_at
        return f"{node} does not answer for {silent:.1f} s" if silent > _SILENT_S else ""

    def _await_ready(self) -> None:
        deadline = monotonic() + _START_S
        while self._heard_at is None:
            if monotonic() > deadline:
                raise RunError(f"the {self._name} node has not started within {_START_S:g} s")
            self.wait(0.1)
            self._early = self.poll()  # a stop may come first
            if self._lost:
                raise RunError(self._lost)
