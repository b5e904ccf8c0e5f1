"""Connection of the worker's insertions to OpenIGTLink, which stays open between them."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from flexneedle.errors import RunError, one_line
from flexneedle.lab.igtl.bridge import IgtlBridge
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.igtl.settings import IgtlAddress, IgtlSettings
from flexneedle.lab.link.bridge import LinkBridge
from flexneedle.lab.page.job_orders import JobChange
from flexneedle.lab.page.worker.task import WorkerTask


class IgtlLink:
    """Settings and connection.

    Args:
        arguments: Address and name of the registration; without any, there is no connection.
        forward: Called in another thread with what is received between insertions.

    A connection that cannot be opened is reported on stderr, and opened again for the next insertion.
    """

    def __init__(
        self,
        arguments: Sequence[str] = (),
        forward: Callable[[PeerGeometry], object] = lambda _received: None,
    ) -> None:
        self._forward = forward
        self._settings = IgtlSettings(IgtlAddress.parse(arguments[0]), arguments[1]) if arguments else None
        self._bridge: IgtlBridge | None = None
        try:
            self._open()
        except RunError as error:
            _print(f"flexneedle: {one_line(error)}")

    @contextmanager
    def insertion(self, task: WorkerTask) -> Iterator[dict[str, LinkBridge]]:
        """Publish an insertion, and stop its task on request; yield the connection, if any, by its key.

        Raises RunError if the connection cannot be opened.
        """
        bridge = self._open()
        if bridge is None:
            yield {}
            return

        def stop(why: str) -> None:
            task.control.take(JobChange(task.order.job, stop=why))

        with bridge.insertion(task.scenario, _print, stop):
            yield {"igtl": bridge}

    def close(self) -> None:
        """Close the connection."""
        if self._bridge is not None:
            self._bridge.close()

    def _open(self) -> IgtlBridge | None:
        if self._bridge is not None and self._bridge.lost:
            self._bridge.close()
            self._bridge = None
        if self._bridge is None and self._settings is not None:
            self._bridge = IgtlBridge(self._settings, _print, forward=self._forward)
        return self._bridge


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
