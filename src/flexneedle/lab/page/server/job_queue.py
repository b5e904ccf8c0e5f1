"""A worker's process and its jobs: the running one, the waiting ones, and the rules of replacement."""

import asyncio
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flexneedle.errors import describe_error
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.page.job_orders import JobChange, Report, RigReport, WorkerReady, WorkOrder
from flexneedle.lab.page.protocol import JobKind, JobMessage
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.process import ChildProcess

_URGENCY: dict[JobKind, int] = {
    "needle": 0,
    "estimate": 1,
    "recording": 2,
    "study": 2,
    "plan": 3,
    "compare": 3,
    "row": 4,
    "reach": 9,
}
_OTHER = 5
_SHORT: frozenset[JobKind] = frozenset(("needle", "estimate"))
"""Jobs that a newer one does not cancel, so that a dragged target has an estimate at each place."""
_BACKGROUND: frozenset[JobKind] = frozenset(("row", "reach"))
"""Jobs that are interrupted by more urgent ones, and done again."""
_CLOSING: frozenset[JobKind] = frozenset(("check", "recording", "study"))
"""Jobs that read devices or files, which they close before they end."""
_SLOTS: dict[JobKind, JobKind] = {"compare": "plan", "row": "recording"}
"""Kinds that replace another kind and are replaced by it."""
_ENDS = ("done", "failed", "cancelled")
_STARTS = "the computation starts; the first time after installation this takes about a minute"
"""Text of a worker's first job until the worker is ready."""

_SHORT_S, _LONGEST_PAUSE_S, _END_S = 2.0, 30.0, 3.0
"""A process that lived less than the first is started again after a pause, which grows up to the second."""

OnEnd = Callable[[WorkOrder, str, str], None]
"""Called with a job, its last state, and a line about it."""


@dataclass(eq=False)
class QueuedJob:
    """A job. cancelled: whether the worker was asked to cancel it; again: whether it is then done again."""

    order: WorkOrder
    cancelled: bool = False
    again: bool = False

    @property
    def slot(self) -> tuple[str, str]:
        """Place of the job: jobs of one slot replace each other."""
        return _SLOTS.get(self.order.kind, self.order.kind), self.order.of

    @property
    def urgency(self) -> tuple[int, int]:
        """Rank of the job; the lowest is next."""
        return _URGENCY.get(self.order.kind, _OTHER), self.order.job

    def yields_to(self, other: "QueuedJob") -> bool:
        """Return whether this job, which runs, is interrupted for another."""
        background = self.order.kind in _BACKGROUND and not self.cancelled
        return background and other.urgency[0] < self.urgency[0]


class JobQueue:
    """The jobs of a worker, which gets one at a time."""

    def __init__(
        self,
        command: Sequence[str],
        hub: Hub,
        limits: PageLimits,
        numbers: Iterator[int],
        on_end: OnEnd,
        on_report: Callable[[Report], None],
    ) -> None:
        """Create an empty queue.

        Args:
            command: Module and arguments of the worker.
            hub: Receives its messages.
            limits: Times for which the worker may take to cancel.
            numbers: Numbers of jobs, shared with other workers.
            on_end: Called at the end of each job.
            on_report: Called with each report of the worker except the states of jobs.
        """
        self._hub, self._limits, self._numbers = hub, limits, numbers
        self._on_end, self._on_report = on_end, on_report
        self._waiting: list[QueuedJob] = []
        self._running: QueuedJob | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self.worker = WorkerProcess(command, self._take, self._fail)

    @property
    def orders(self) -> list[WorkOrder]:
        """Orders of the jobs that run or wait."""
        return [job.order for job in self._jobs()]

    def add(self, order: WorkOrder) -> int:
        """Add a job that replaces an older one of its slot; return its number."""
        job = QueuedJob(replace(order, job=next(self._numbers)))
        for other in [other for other in self._waiting if other.slot == job.slot]:
            self._waiting.remove(other)
            if other.order.kind != job.order.kind:  # the state of the new job does not replace the old one's
                self._finish(other, "cancelled", "")
        self._waiting.append(job)
        first = min(self._waiting, key=lambda other: other.urgency) is job
        self._publish(job, "waiting", "" if self.worker.ready or not first else _STARTS)
        running = self._running
        if running is not None and running.slot == job.slot:
            if running.order.kind not in _SHORT:
                self._cancel_running()
        elif running is not None and running.yields_to(job):
            self._cancel_running(again=True)
        self._start_next()
        return job.order.job

    def cancel(self, *kinds: JobKind) -> None:
        """Cancel the jobs of some kinds."""
        for job in [job for job in self._jobs() if job.order.kind in kinds]:
            self.cancel_job(job.order.job)

    def cancel_slot(self, kind: JobKind, of: str) -> None:
        """Cancel the jobs of a slot."""
        for job in [job for job in self._jobs() if job.slot == (kind, of)]:
            self.cancel_job(job.order.job)

    def cancel_job(self, number: int) -> None:
        """Cancel a job by number."""
        for job in [job for job in self._waiting if job.order.job == number]:
            self._waiting.remove(job)
            self._finish(job, "cancelled", "")
        if self._running is not None and self._running.order.job == number:
            self._cancel_running()

    def change(self, number: int, **change: Any) -> bool:
        """Send a `JobChange` to a job by number, if it runs; return whether it does."""
        running = self._running
        if running is None or running.order.job != number:
            return False
        self.worker.send(JobChange(number, **change))
        return True

    def expect_end(self, seconds: float | None) -> None:
        """Kill the worker if its job has not ended after a time; None: it may take any time."""
        if seconds is None and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        elif seconds is not None and self._deadline is None:
            self._deadline = asyncio.get_running_loop().call_later(seconds, self.worker.kill)

    def _jobs(self) -> list[QueuedJob]:
        return [*self._waiting, *(() if self._running is None else (self._running,))]

    def _cancel_running(self, again: bool = False) -> None:
        running = self._running
        if running is None:
            return
        running.again = again
        if not running.cancelled:
            running.cancelled = True
            self.change(running.order.job, cancel=True)
            closes = running.order.kind in _CLOSING
            self.expect_end(self._limits.close_s if closes else self._limits.cancel_s)

    def _start_next(self) -> None:
        if self._running is None and self._waiting and self.worker.ready:
            self._running = min(self._waiting, key=lambda job: job.urgency)
            self._waiting.remove(self._running)
            self._publish(self._running, "running")
            self.worker.send(self._running.order)

    def _take(self, report: Report) -> None:
        """Handle a report of the worker. Results of a cancelled job are discarded."""
        running = self._running
        match report:
            case WorkerReady():
                self._start_next()
            case RigReport() | PeerGeometry():
                self._on_report(report)
            case JobMessage():
                if running is None or report.job != running.order.job:
                    return
                if report.state in _ENDS:
                    self._end(running, report.state, report.text)
                elif not running.cancelled:
                    self._hub.publish(report)
            case _ if running is None or not running.cancelled:
                self._hub.publish(report)
                self._on_report(report)

    def _fail(self, status: int) -> None:
        """End the job of a process that has ended, or all jobs of a process that was never ready."""
        text = f"the worker has ended (exit status {status}) and is started again"
        if self._running is not None:
            self._end(self._running, "failed", text)
            return
        failed, self._waiting = self._waiting, []
        for job in failed:
            self._finish(job, "failed", text)

    def _end(self, job: QueuedJob, state: str, text: str) -> None:
        if job.cancelled and job.order.kind != "save":  # a save has no results that could be discarded
            state, text = "cancelled", ""
        self._running = None
        self.expect_end(None)
        if job.again and state == "cancelled":
            again = QueuedJob(job.order)
            self._waiting.append(again)
            self._publish(again, "waiting")
        else:
            self._finish(job, state, text)
        self._start_next()

    def _finish(self, job: QueuedJob, state: str, text: str) -> None:
        if not any(other.order.kind == job.order.kind for other in self._waiting):  # else its state is newer
            self._publish(job, state, text)
        self._on_end(job.order, state, text)

    def _publish(self, job: QueuedJob, state: str, text: str = "") -> None:
        values = {"job": job.order.job, "kind": job.order.kind, "state": state, "text": text}
        self._hub.publish(JobMessage.model_validate(values))


class WorkerProcess:
    """A worker. ready: whether it can take work."""

    def __init__(
        self, command: Sequence[str], on_report: Callable[[Report], None], on_end: Callable[[int], None]
    ) -> None:
        """command: module and arguments; on_end: called with the exit status of a process that has ended."""
        self._command = command
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
                f"flexneedle: the worker {self._command[-1]} is ended: {describe_error(error)}",
                file=sys.stderr,
            )
            child.end(0.0)
            ended.set()
        if child.channel.ended:
            ended.set()
