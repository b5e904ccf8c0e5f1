"""Client of the supervisor, which it starts: requests, results and reports."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import inf, isfinite
from statistics import median
from threading import Condition, Lock, Thread
from time import monotonic
from typing import Any, Self

from flexneedle.errors import DriverError, RefusedError, StoppedError
from flexneedle.geometry.registration import identity
from flexneedle.interrupts import uninterrupted
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.signals import SignalLine
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Measurement, Point

CONTROLLER = "the controller"
"""Source of the stop at the end of an insertion."""
_HEARTBEAT_S = 0.1
_SILENT_S = 1.0  # without a report: the supervisor hangs
_PATIENCE_S = 0.3  # for reports that have not been taken, after a time without Python's lock
_OPEN_S = 60.0  # to find a tracker
_END_S = 5.0
_MOST_KEPT = 4000  # measurements: 100 s without a reader
_ENOUGH = 9  # measurements for a median


class SupervisorClient:
    """A supervisor in a separate process. Use it as a context manager.

    on_report: called with the report of each tick, in a thread; its exception is raised where the client waits next,
    or given to `threading.excepthook` at the end. Raises DriverError or StoppedError if the rig has a fault or is
    stopped, RefusedError if it refuses a request.
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

    @classmethod
    def of_operator(cls, rig: RigFile) -> Self:
        """Return the supervisor of a rig without its tracker, for motions of single axes."""
        monitor = MonitorSettings(enabled=False)
        return cls(protocol.SupervisorTask(rig, monotonic(), 2, monitor, identity(), 0.0, inf, tracked=False))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the motors, and end the supervisor."""
        try:
            if self._ended is None:
                self._send(protocol.CloseCommand(), lost=True)
            self._process.end(_END_S)
            self._thread.join()  # it ends with the supervisor's end of the channel
            with uninterrupted(), self._sending:
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
        """Number of the supervisor's process."""
        return self._process.pid

    @property
    def ended(self) -> str | None:
        """Reason why the supervisor has ended, "" at a request; None while it works."""
        with self._locked():
            return self._ended

    @property
    def report(self) -> protocol.TickReport:
        """Report of the last tick."""
        with self._locked():
            if self._latest is None:
                raise DriverError(f"the supervisor has not reported: {self._ended or 'it opens'}")
            return self._latest

    @property
    def positions(self) -> dict[str, float]:
        """Positions of the axes, mm or rad. Raises DriverError after a fault, StoppedError after a stop."""
        found = self.report
        self._raise_end_state(found.state, found.why)
        return {name: axis.position for name, axis in found.axes.items()}

    def read(self) -> tuple[Measurement, ...]:
        """Return the measurements since the last call, oldest first."""
        with self._locked():
            found = tuple(self._measurements)
            self._measurements.clear()
        return found

    def tip(self, within: float) -> Point | None:
        """Return the position (mm) of the tip at rest, None if it is not measured.

        It is the median of at least 9 measurements or of all within a time (s). `read` returns them, too.
        """
        until, found = monotonic() + within, list[Point]()

        def enough() -> bool:
            found[:] = filter(None, map(_position, self._measurements))
            return len(found) >= _ENOUGH or monotonic() >= until

        self._wait(enough, within + 1.0, "the clock does not advance")
        if not found:
            return None
        x, y, z = (median(values) for values in zip(*found, strict=True))
        return x, y, z

    @property
    def status(self) -> str:
        """Status of the tracker."""
        return self.report.tracker

    # Requests

    def arm(self, deepest: float = inf) -> str:
        """Switch the motors on; deepest: largest advance (mm) from here. Raises StoppedError after a stop.

        A motor at rest that is more than its largest error from its commanded position is switched off and on again,
        so that it is held at its position. Returns a note about it, or "".
        """
        self._check_follower()
        refused = None
        try:
            self._request(protocol.ArmCommand(deepest))
        except RefusedError as error:
            refused = error
        report = self.report
        self._raise_end_state(report.state, report.why)
        if refused is not None:
            raise refused
        return report.why

    def reset(self) -> None:
        """Leave the states stopped and fault. Refused while motors move: `stop` returns when they rest."""
        self._request(protocol.ResetCommand())

    def stop(self, who: str = CONTROLLER) -> None:
        """Stop all motors, and return when they rest, so that a reset is accepted."""
        if self._ended is not None:
            return
        sent = self._send(protocol.StopCommand(who))
        self._wait(lambda: self._has_stopped(sent), _END_S, "the motors do not come to rest", stopped=True)

    def off(self) -> None:
        """Stop all motors, and switch them off. Raises DriverError, with the reason, if one is still on."""
        self.stop("rig off")
        self._request(protocol.OffCommand())
        if any(axis.motor.on for axis in self.report.axes.values()):
            raise DriverError(self.report.why)

    def request_stop(self, who: str) -> None:
        """Request that all motors stop, without waiting for it. Call it in any thread, at any time.

        Nothing is done after the supervisor's end: it has stopped the motors.
        """
        self._send(protocol.StopCommand(who), lost=True)

    def take_signals(self) -> None:
        """Let each signal of this process that has a Python handler stop the motors, until the end.

        The supervisor receives it from the system, even while this process is busy. Call it in the main thread.
        """
        self._signals.take()

    def step(
        self,
        roll: float,
        travel: Mapping[str, float],
        duration: float,
        expected: protocol.Expectation | None = None,
        roll_duration: float = 0.0,
    ) -> protocol.MotionResult:
        """Carry out a step of an insertion: the roll (rad) in `roll_duration` s, then the travel in `duration` s.

        travel: mm or rad by axis. An axis that needs more time takes longer.
        """
        return self._carry_out(
            lambda number: protocol.StepCommand(number, roll, travel, duration, expected, roll_duration)
        )

    def move_to(self, axis: str, position: float, speed: float | None = None) -> protocol.MotionResult:
        """Move one axis alone to a position (mm or rad), at its largest speed or slower (mm/s or rad/s)."""
        return self._move_axis(axis, position, speed, retract=False)

    def retract(self, position: float, speed: float | None = None) -> protocol.MotionResult:
        """Withdraw the base to a position of the insertion axis (mm)."""
        return self._move_axis("insertion", position, speed, retract=True)

    def home(self, axis: str) -> protocol.MotionResult:
        """Find the home of an axis. The rig must be armed again after it."""
        return self._carry_out_to_goal(lambda number: protocol.HomeCommand(number, axis))

    def wait(self, seconds: float) -> None:
        """Wait while nothing moves."""
        until = monotonic() + seconds
        self._wait(lambda: monotonic() >= until, seconds + 1.0, "the clock does not advance", every=seconds)

    def _move_axis(
        self, axis: str, position: float, speed: float | None, *, retract: bool
    ) -> protocol.MotionResult:
        fastest = self._axis_of(axis).speed if speed is None else speed
        return self._carry_out_to_goal(
            lambda number: protocol.MoveCommand(number, axis, position, fastest, retract)
        )

    def _carry_out_to_goal(self, made: Callable[[int], protocol.Request]) -> protocol.MotionResult:
        """Carry out a motion. Raises DriverError if it ended before its goal."""
        done = self._carry_out(made)
        if done.why:
            raise DriverError(done.why)
        return done

    def _axis_of(self, axis: str) -> Axis:
        found = dict(self._task.rig.axes.items())
        if axis not in found:
            raise RefusedError(f"the rig has no axis {axis}; axes: {', '.join(found)}")
        return found[axis]

    def _carry_out(self, made: Callable[[int], protocol.Request]) -> protocol.MotionResult:
        self._check_follower()  # before anything begins to move
        self._number += 1
        number = self._number
        self._send(made(number))
        self._wait(lambda: number in self._answers, inf, "")
        answer = self._answers.pop(number)
        if isinstance(answer, protocol.RequestRefused):
            self._raise_end_state(answer.state, answer.cause)
            raise RefusedError(answer.why)
        self._raise_end_state(answer.state, answer.why)
        return answer

    def _check_follower(self) -> None:
        """Raise the exception of `on_report`, before anything moves. The rig can still be stopped."""
        if self._failed is not None:
            self._failure_raised = True
            raise self._failed

    def _request(self, request: protocol.Request) -> None:
        """Have a request acted on, and return with its report. Raises RefusedError if it is refused."""
        self._answers.pop(0, None)
        sent = self._send(request)
        self._wait(lambda: self.report.requests >= sent, _END_S, "no answer to a request", stopped=True)
        if isinstance(refused := self._answers.pop(0, None), protocol.RequestRefused):
            raise RefusedError(refused.why)

    # Waiting

    def _send(self, message: Any, *, lost: bool = False) -> int:
        """Send a message; return how many requests were sent with it."""
        with uninterrupted(), self._sending:
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
            over = monotonic() > until  # looked at once more

    def _check_condition(
        self, condition: Callable[[], bool], until: float, *, stopped: bool, every: float
    ) -> bool:
        """Return whether a condition is met; otherwise wait for a report, and send a heartbeat."""
        with self._locked():
            if condition():
                return True
            if self._ended is not None:
                raise self._end_error()
            if not stopped:
                self._check_follower()
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
    def _locked(self) -> Iterator[None]:
        """Lock the data of the receiving thread; an interrupt must not leave them locked."""
        with uninterrupted(), self._changed:
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

    def _has_stopped(self, sent: int) -> bool:
        """Return whether the rig has acted on these requests, and its motors rest."""
        report = self.report
        return (
            report.requests >= sent
            and report.at_rest
            and report.state in (SupervisorState.STOPPED, SupervisorState.FAULT)
        )

    # The thread

    def _receive(self) -> None:
        why = "it was killed"
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
            except Exception as error:  # noqa: BLE001  raised where the client waits: this thread must go on
                with self._changed:
                    self._failed = self._failed or error
                    self._changed.notify_all()


def _position(measurement: Measurement) -> Point | None:
    """Return the position (mm) of a measurement, z = 0 in the plane; None if it is not measured."""
    x, y, z = measurement.x, measurement.y, 0.0 if measurement.z is None else measurement.z
    return None if x is None or y is None or not all(map(isfinite, (x, y, z))) else (x, y, z)
