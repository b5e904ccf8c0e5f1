"""Connection to the supervisor's process: its reports, its messages, and waiting for both."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Condition, Lock, Thread
from time import monotonic
from typing import Any, Self

from flexneedle.errors import DriverError, StoppedError
from flexneedle.interrupts import delay_signals
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.signals import SignalLine
from flexneedle.types import Measurement

END_S = 5.0
"""Longest time (s) until the supervisor has acted on a request, or has ended."""
_HEARTBEAT_S = 0.1
_SILENT_S = 1.0  # without a report: the supervisor hangs
_PATIENCE_S = 0.3  # for reports that have not been received, after a time without Python's lock
_OPEN_S = 60.0  # to find a tracker
_MOST_KEPT = 4000  # measurements: 100 s without a reader


class SupervisorConnection:
    """A supervisor in a separate process, which ends with the context.

    on_report: called with the report of each tick, in a thread; its exception is raised where the client waits next,
    or given to `threading.excepthook` at the end.
    """

    def __init__(
        self, task: protocol.SupervisorTask, on_report: Callable[[protocol.TickReport], None] | None = None
    ) -> None:
        self._clock = WallClock(start=task.started)
        self._task, self._on_report = task, on_report
        self._changed, self._sending = Condition(), Lock()  # a stop may be requested in any thread
        self._latest: protocol.TickReport | None = None
        self._latest_at = monotonic()
        self._ended: str | None = None
        self._unopened = ""
        self._failed: Exception | None = None  # the first of on_report
        self._failure_raised = False
        self._answers: dict[int, protocol.MotionResult | protocol.RequestRefused] = {}
        self._measurements: deque[Measurement] = deque(maxlen=_MOST_KEPT)
        self._number = 0
        self._sent = -1  # requests; the task, which is sent first, is none
        self._signals = SignalLine()
        self._process = ChildProcess(
            f"{__package__}.process", descriptors=self._signals.descriptors, own_session=False
        )
        self._thread = Thread(target=self._receive, name="supervisor", daemon=True)
        self._thread.start()
        try:
            self._send(task)
            self._wait(lambda: self._latest is not None, _OPEN_S, "the rig does not open")
        except BaseException:  # also on Ctrl-C: the devices must be released
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the motors, and end the supervisor."""
        try:
            if self._ended is None:
                self._send(protocol.CloseCommand(), lost=True)
            self._process.end(END_S)
            self._thread.join()  # it ends with the supervisor's end of the channel
            with delay_signals(), self._sending:
                self._process.close()
        finally:
            self._signals.close()
            if self._failed is not None and not self._failure_raised:
                error, self._failure_raised = self._failed, True
                threading.excepthook(
                    threading.ExceptHookArgs((type(error), error, error.__traceback__, self._thread))
                )

    @property
    def rig(self) -> RigFile:
        """The rig."""
        return self._task.rig

    def now(self) -> float:
        """Return the seconds since the start of the run."""
        return self._clock.now()

    @property
    def pid(self) -> int:
        """Identifier of the process of the supervisor."""
        return self._process.pid

    @property
    def ended(self) -> str | None:
        """Reason why the supervisor has ended, "" at a request; None while it works."""
        with self._lock_data():
            return self._ended

    @property
    def report(self) -> protocol.TickReport:
        """Report of the last tick."""
        with self._lock_data():
            if self._latest is None:
                raise DriverError(f"the supervisor has not reported: {self._ended or 'it is starting'}")
            return self._latest

    @property
    def status(self) -> str:
        """Status of the tracker."""
        return self.report.tracker

    def read(self) -> tuple[Measurement, ...]:
        """Return the measurements since the last call, oldest first."""
        with self._lock_data():
            found = tuple(self._measurements)
            self._measurements.clear()
        return found

    def take_signals(self) -> None:
        """Let each signal of this process that has a Python handler stop the motors, until the end.

        The supervisor receives it from the system, even while this process is busy. Call it in the main thread.
        """
        self._signals.take()

    def _send(self, message: Any, *, lost: bool = False) -> int:
        """Send a message; return how many requests were sent with it."""
        with delay_signals(), self._sending:
            open_still = self._process.channel.send(message, keep=not isinstance(message, protocol.Heartbeat))
            self._sent += 1
        if not open_still and not lost:
            raise self._end_error()
        return self._sent

    def _end_error(self) -> DriverError:
        """Return the error after the supervisor's end: only its reason, such as a device's, if the rig did not open."""
        if self._unopened:
            return DriverError(self._unopened)
        return DriverError(f"the supervisor has ended{f': {self._ended}' if self._ended else ''}")

    def _wait(
        self,
        condition: Callable[[], bool],
        limit: float,
        problem: str,
        *,
        stopped: bool = False,
        every: float = _HEARTBEAT_S,
    ) -> None:
        """Wait for a condition, with heartbeats. stopped: it can be met in a rig that is stopped.

        Raises DriverError: the limit (s) is reached, or the supervisor has ended or hangs.
        """
        until = monotonic() + limit
        over = False
        while not self._check_condition(condition, until, stopped=stopped, every=every):
            if over:
                raise DriverError(f"{problem}: waited for {limit:g} s")
            over = monotonic() > until  # the condition is checked once more

    def _check_condition(
        self, condition: Callable[[], bool], until: float, *, stopped: bool, every: float
    ) -> bool:
        """Return whether a condition is met; otherwise wait for a report, and send a heartbeat."""
        with self._lock_data():
            if condition():
                return True
            if self._ended is not None:
                raise self._end_error()
            if not stopped:
                self._check_listener()
            if self._latest is not None:
                silent = monotonic() - self._latest_at
                if silent > _SILENT_S and not self._await_late_report():
                    raise DriverError(f"the supervisor has not reported for {silent:.1f} s")
                if not stopped:
                    self._raise_end_state(self._latest.state, self._latest.why)
            self._changed.wait(min(_HEARTBEAT_S, every, max(0.0, until - monotonic())))
            if self._latest is not None:
                self._send(protocol.Heartbeat(), lost=True)
        return False

    @contextmanager
    def _lock_data(self) -> Iterator[None]:
        """Lock the data of the receiving thread; an interrupt must not leave them locked."""
        with delay_signals(), self._changed:
            yield

    def _await_late_report(self) -> bool:
        """Return whether a report arrives that this process has had no time to receive."""
        before = self._latest_at
        self._changed.wait(_PATIENCE_S)
        return self._latest_at > before

    @staticmethod
    def _raise_end_state(state: SupervisorState, why: str) -> None:
        if state is SupervisorState.FAULT:
            raise DriverError(why)
        if state is SupervisorState.STOPPED:
            raise StoppedError(f"stopped: {why}")

    def _check_listener(self) -> None:
        """Raise the exception of `on_report`, before anything moves. The rig can still be stopped."""
        if self._failed is not None:
            self._failure_raised = True
            raise self._failed

    # The thread

    def _receive(self) -> None:
        why = f"it was killed; {self._describe_queues()}"
        while not self._process.channel.ended:
            for message in self._process.channel.receive(None):
                if isinstance(message, protocol.SupervisorEnded):
                    why = message.why
                    self._unopened = why if self._latest is None else ""
                else:
                    self._take(message)
        with self._changed:
            self._ended = why
            self._changed.notify_all()

    def _describe_queues(self) -> str:
        """Return what may still move once the supervisor cannot stop it, for messages."""
        if self._task.dry:
            return "nothing moves in a dry run"
        loop = self.rig.loop
        queues = ", ".join(
            f"{name} by at most {axis.to_text(loop.queue_of(axis, axis.speed))} {axis.unit}"
            for name, axis in self.rig.axes.items()
        )
        then = "press the emergency stop if an axis moves on"
        return f"motors may continue for {1e3 * loop.queue:g} ms and brake (loop.queue_ms): {queues}; {then}"

    def _take(self, message: protocol.TickReport | protocol.MotionResult | protocol.RequestRefused) -> None:
        with self._changed:
            match message:
                case protocol.TickReport():
                    self._latest, self._latest_at = message, monotonic()
                    self._measurements.extend(message.measurements)
                case _:
                    self._answers[message.number] = message
            self._changed.notify_all()
        if self._on_report is not None and isinstance(message, protocol.TickReport):
            try:
                self._on_report(message)
            except Exception as error:  # noqa: BLE001  raised where the client waits: this thread must continue
                with self._changed:
                    self._failed = self._failed or error
                    self._changed.notify_all()
