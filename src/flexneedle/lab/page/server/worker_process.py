"""The process of a worker on the event loop: started, read, and started again when it has ended."""

import asyncio
import sys
from collections.abc import Callable, Sequence

from flexneedle.errors import describe_error
from flexneedle.lab.page.job_orders import JobChange, Report, WorkerReady, WorkOrder
from flexneedle.lab.process import ChildProcess

_SHORT_S, _LONGEST_PAUSE_S, _END_S = 2.0, 30.0, 3.0


class WorkerProcess:
    """A worker. ready: whether it can take work."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        on_report: Callable[[Report], None],
        on_end: Callable[[int], None],
    ) -> None:
        """command: module and arguments; on_end: called with the exit status of a process that has ended."""
        self._name, self._command = name, command
        self._on_report, self._on_end = on_report, on_end
        self.ready = False
        self._child: ChildProcess | None = None
        self._keeping: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the process, and keep it running."""
        self._keeping = asyncio.create_task(self._keep())

    def send(self, order: WorkOrder | JobChange) -> None:
        """Send an order, if the process runs; never waits."""
        if self._child is not None:
            self._child.channel.send(order)

    def kill(self) -> None:
        """Kill the process; it is started again."""
        if self._child is not None:
            self._child.end(0.0)

    async def end(self, seconds: float = _END_S) -> None:
        """End the process for good: its channel ends, at which it stops its job; kill it after a time."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
        await self._end_child(seconds)

    async def _keep(self) -> None:
        loop, pause = asyncio.get_running_loop(), 0.0
        while True:
            began = loop.time()
            await self._run()
            self.ready = False
            status = await self._end_child(_END_S)
            pause = 0.0 if loop.time() - began > _SHORT_S else min(_LONGEST_PAUSE_S, 2.0 * pause + 0.1)
            self._on_end(status)
            await asyncio.sleep(pause)

    async def _run(self) -> None:
        """Run one process until its channel ends."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        child = self._child = ChildProcess(*self._command)
        loop.add_reader(child.channel.fileno(), self._receive, child, ended)
        try:
            await ended.wait()
        finally:
            loop.remove_reader(child.channel.fileno())

    async def _end_child(self, seconds: float) -> int:
        child, self._child = self._child, None
        if child is None:
            return 0
        try:
            return await asyncio.to_thread(child.end, seconds)
        finally:
            child.close()

    def _receive(self, child: ChildProcess, ended: asyncio.Event) -> None:
        try:
            for report in child.channel.receive():
                self.ready = self.ready or isinstance(report, WorkerReady)
                self._on_report(report)
        except Exception as error:  # noqa: BLE001  the server survives an invalid message of a worker
            print(
                f"flexneedle: the worker of {self._name} is ended: {describe_error(error)}", file=sys.stderr
            )
            child.end(0.0)
            ended.set()
        if child.channel.ended:
            ended.set()
