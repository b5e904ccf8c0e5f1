"""A device whose measurements are on a topic: the common part of trackers and sensors along the needle."""

from abc import ABC, abstractmethod
from time import monotonic
from typing import Generic, Self, TypeVar

from flexneedle.lab.link.records import LinkRefusal
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.records import Received
from flexneedle.ports import Clock
from flexneedle.types import VISIBLE

Item = TypeVar("Item")


class TopicReceiver(ABC, Generic[Item]):
    """Items of the messages of a node, each once, with times on `clock`.

    late_s: time without an item after which the status is not ok. While no message is accepted, `status` is the reason.
    """

    noun = "item"

    def __init__(self, node: NodeClient, clock: Clock, late_s: float) -> None:
        self._node, self._late = node, late_s
        self._offset = clock.now() - monotonic()
        self._last, self._refused = monotonic(), ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the node."""
        self._node.close()

    def read(self) -> tuple[Item, ...]:
        """Return the items since the last call, oldest first; may be empty."""
        found = [item for one in self._node.poll() if (item := self._take(one)) is not None]
        if found:
            self._last, self._refused = monotonic(), ""
        return tuple(found)

    @property
    def status(self) -> str:
        """VISIBLE while items arrive, otherwise the reason in a few words."""
        silent = monotonic() - self._last
        if self._node.status != VISIBLE:
            return self._node.status
        return VISIBLE if silent < self._late else self._explain(silent)

    def _explain(self, silent: float) -> str:
        return self._refused or f"no {self.noun} for {silent:.1f} s"

    def _take(self, record: Received) -> Item | None:
        if isinstance(record, LinkRefusal):
            self._refused = f"{record.source}: {record.reason}"
        return self._make(record)

    @abstractmethod
    def _make(self, record: Received) -> Item | None:
        """Return the item of a record, None if it is of another kind."""
