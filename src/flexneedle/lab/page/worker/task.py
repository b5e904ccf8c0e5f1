"""A job at work: its order, its control by the server, and its reports."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from queue import SimpleQueue
from threading import Condition, Thread
from time import monotonic
from typing import Any

from flexneedle.control.controllers import DEFAULT
from flexneedle.errors import StoppedError
from flexneedle.lab.page.job_orders import JobChange, Report, WorkOrder
from flexneedle.lab.page.protocol import JobMessage
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.process import MessageChannel
from flexneedle.scenario.model import Scenario

_POLL_S = 0.1
"""Time between two attempts to send queued reports."""
_FLUSH_S = 1.0
_SERVER_ENDED = "the server of the page has ended"


class Cancelled(Exception):
    """The job is cancelled."""


class JobControl:
    """Changes of one job, received by a thread and read by the job.

    Attributes:
        pace: Pace of a virtual insertion: 1 is real time, 0 paused.
        held: Reason to hold the needle on a rig, "" without one.
        stopped: Reason to end the insertion as interrupted, "" without one.
        heard: Time of the last change or beat (monotonic, s).
        on_stop: Called with the reason in the receiving thread as soon as the job is stopped or cancelled.
    """

    def __init__(self, pace: float = 1.0, held: str = "") -> None:
        self.pace, self.held = pace, held
        self.stopped = ""
        self.heard = monotonic()
        self.on_stop: Callable[[str], None] = lambda _why: None
        self._cancelled = False
        self._advances = 0
        self._disturbs: list[DisturbRequest] = []
        self._changed = Condition()

    def take(self, change: JobChange) -> None:
        """Apply a change of the server."""
        with self._changed:
            self.heard = monotonic()
            self._cancelled |= change.cancel
            self.stopped = self.stopped or change.stop
            self.held = change.hold or ("" if change.go else self.held)
            self._advances += change.advance
            if change.pace is not None:
                self.pace = change.pace
                self._advances = 0
            if change.disturb is not None:
                self._disturbs.append(change.disturb)
            self._changed.notify_all()
        if change.cancel or change.stop:
            self.on_stop(change.stop or "cancelled")

    def check(self) -> None:
        """Raise Cancelled if the job is cancelled."""
        if self._cancelled:
            raise Cancelled

    def check_stop(self) -> None:
        """Raise Cancelled if the job is cancelled, StoppedError if it is stopped."""
        self.check()
        if self.stopped:
            raise StoppedError(f"stopped: {self.stopped}")

    def wait(self, seconds: float | None) -> None:
        """Wait for a change, at most this time."""
        with self._changed:
            if not (self._cancelled or self.stopped or self._advances or self._disturbs):
                self._changed.wait(seconds)

    def take_advance(self) -> bool:
        """Return whether a single period was requested, and clear the request."""
        with self._changed:
            if self._advances == 0:
                return False
            self._advances -= 1
            return True

    def take_disturbs(self) -> list[DisturbRequest]:
        """Return the disturbances since the last call."""
        with self._changed:
            taken, self._disturbs = self._disturbs, []
            return taken


@dataclass(frozen=True)
class WorkerTask:
    """A job at work. report: sends an object to the server, without waiting for it."""

    order: WorkOrder
    control: JobControl
    report: Callable[[Report], object]

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario of the order. Raises ScenarioError."""
        return Scenario.from_values(self.order.scenario, self.order.name)

    @property
    def controller(self) -> str:
        """Name of the controller."""
        return self.order.controller or DEFAULT

    def report_job(self, state: str, share: float | None = None, text: str = "") -> None:
        """Report the state of the job."""
        values: dict[str, Any] = {"job": self.order.job, "kind": self.order.kind, "state": state}
        self.report(JobMessage(**values, share=share, text=text))


class TaskQueue:
    """Tasks in the order of the server, whose changes they get while they wait and run.

    When the channel ends, all tasks are stopped and cancelled, and no task follows.
    """

    def __init__(self, channel: MessageChannel) -> None:
        self._channel = channel
        self._tasks: SimpleQueue[WorkerTask | None] = SimpleQueue()
        self._open: dict[int, JobControl] = {}
        Thread(target=self._run, name="orders", daemon=True).start()

    def next(self) -> WorkerTask | None:
        """Wait for the next task; return None after the last."""
        return self._tasks.get()

    def close(self, task: WorkerTask) -> None:
        """Send the last reports of a task, and ignore later changes of its job."""
        self._channel.flush(_FLUSH_S)
        self._open.pop(task.order.job, None)

    def _run(self) -> None:
        try:
            while not self._channel.ended:
                for received in self._channel.receive(_POLL_S):
                    self._take(received)
                self._channel.flush()
        finally:
            for job, control in list(self._open.items()):
                control.take(JobChange(job, cancel=True, stop=_SERVER_ENDED))
            self._tasks.put(None)

    def _take(self, received: WorkOrder | JobChange) -> None:
        if isinstance(received, JobChange):
            if received.job in self._open:
                self._open[received.job].take(received)
            return
        held = "not armed" if received.rig else ""
        control = self._open[received.job] = JobControl(0.0 if received.paused else 1.0, held)
        self._tasks.put(WorkerTask(received, control, self._channel.send))
