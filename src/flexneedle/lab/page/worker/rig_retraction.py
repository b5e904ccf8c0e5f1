"""Withdrawal of the needle of the connected rig, as by `flexneedle rig retract`."""

from time import monotonic

from flexneedle.errors import InputError, StoppedError
from flexneedle.lab.page.job_orders import SILENT_S, RigReport
from flexneedle.lab.page.rigs import usable_rig
from flexneedle.lab.page.worker.task import Cancelled, WorkerTask
from flexneedle.lab.rig.devices.opening import read_positions
from flexneedle.lab.rig.notices import SWITCHED_ON
from flexneedle.lab.rig.preflight.moves import AxisMove, describe_withdrawn, plan_retraction, require_start
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport

_POLL_S = 0.05
"""Time between two checks whether a waiting retraction may begin, or the server is silent."""


def retract(task: WorkerTask) -> None:
    """Report the motion, wait for "go", and withdraw the needle.

    Raises InputError if there is nothing to retract, Cancelled after a stop, DriverError after a fault, RefusedError if
    the axis has moved meanwhile.
    """
    task.report_job("running", text="the position is read, nothing moves")
    rig = usable_rig(task.order.rig)
    position = read_positions(rig)["insertion"]
    move = plan_retraction(rig, position)
    if move is None:
        raise InputError(describe_withdrawn(rig, position))
    guard = RetractionGuard(task)
    try:
        guard.wait_for_go([str(move), SWITCHED_ON])
        _carry_out(rig, move, guard)
    except StoppedError as stop:
        guard.report("stopped", str(stop).removeprefix("stopped: "))
        raise Cancelled from None


def _carry_out(rig: RigFile, move: AxisMove, guard: "RetractionGuard") -> None:
    with SupervisorClient.of_operator(rig, guard.take) as supervisor:
        guard.follow_stops(supervisor)
        guard.follow_motion(move)
        require_start(move, supervisor.positions[move.name])
        supervisor.arm()
        supervisor.retract(move.goal, move.speed)
        guard.end(f"the needle was withdrawn to {move.axis.to_text(move.goal)} mm")


class RetractionGuard:
    """Reports the rig's state, waits for "go", and stops the motors on request or when the server is silent."""

    def __init__(self, task: WorkerTask) -> None:
        self._task, self._control = task, task.control
        self._supervisor: SupervisorClient | None = None
        self._ended = False
        self._move: AxisMove | None = None
        self._last: RigReport | None = None
        self._text = ""

    def wait_for_go(self, moves: list[str]) -> None:
        """Report the motion and wait. Raises StoppedError after a stop, and without a signal of the server."""
        self.report(str(SupervisorState.IDLE), moves=moves)
        self._task.report_job("running", text="waits, nothing moves")
        while self._control.held:
            self._control.check_stop()
            if silence := self._silence():
                raise StoppedError(silence)
            self._control.wait(_POLL_S)
        self.report(str(SupervisorState.IDLE))
        self._task.report_job("running", text="motors are switched on")

    def follow_stops(self, supervisor: SupervisorClient) -> None:
        """Stop the motors from now on as soon as the job is stopped. Raises StoppedError if it is stopped already."""
        self._supervisor = supervisor
        self._control.on_stop = supervisor.request_stop
        self._control.check_stop()

    def take(self, found: TickReport) -> None:
        """Report a tick of the supervisor; called in its thread."""
        if (silence := self._silence()) and not self._control.stopped and self._supervisor is not None:
            self._control.stopped = silence
            self._supervisor.request_stop(silence)
        if not self._ended:
            self.report(str(found.state), found.why or self._left(found))

    def follow_motion(self, move: AxisMove) -> None:
        """Report from now on how far the needle is still to be withdrawn."""
        self._move = move

    def _left(self, found: TickReport) -> str:
        """Return the remaining way in words while the needle is withdrawn, "" otherwise."""
        move, axes = self._move, found.axes
        if found.state is not SupervisorState.RETRACTING or move is None or move.name not in axes:
            return ""
        left = abs(axes[move.name].position - move.goal)
        text = f"{left:.0f} mm left"
        if text != self._text:
            self._text = text
            self._task.report_job(
                "running", 1.0 - min(left / abs(move.distance), 1.0), f"withdrawing, {text}"
            )
        return text

    def end(self, text: str) -> None:
        """Report that the needle is withdrawn."""
        self._ended = True
        self.report("ended", text)

    def report(self, state: str, why: str = "", moves: list[str] | None = None) -> None:
        """Report a changed state to the server."""
        found = RigReport(state, why, 1 if moves else 0, tuple(moves or ()))
        if found != self._last:
            self._last = found
            self._task.report(found)

    def _silence(self) -> str:
        silent = monotonic() - self._control.heard
        return f"no signal of the page's server for {silent:.1f} s" if silent > SILENT_S else ""
