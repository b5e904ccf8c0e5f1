"""Client of the supervisor, which it starts: requests of an insertion and of an operator, and their results."""

from collections.abc import Callable, Mapping
from math import inf
from time import monotonic
from typing import Self

from flexneedle.errors import DriverError, RefusedError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.connection import END_S, SupervisorConnection
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.phantom.tracking.stage import has_position, median_pose
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import TIP, VISIBLE, Measurement, Pose

CONTROLLER = "the controller"
"""Source of the stop at the end of an insertion."""
_ENOUGH = 9  # measurements for a median


class SupervisorClient(SupervisorConnection):
    """Client of a supervisor in a separate process. Use it as a context manager.

    Raises DriverError or StoppedError if the rig has a fault or is stopped, RefusedError if it refuses a request.
    """

    @classmethod
    def of_operator(
        cls, rig: RigFile, on_report: Callable[[protocol.TickReport], None] | None = None
    ) -> Self:
        """Return the supervisor of a rig without its tracker, for motions of single axes."""
        monitor = MonitorSettings(enabled=False)
        task = protocol.SupervisorTask(rig, monotonic(), 2, monitor, identity(), 0.0, inf, tracked=False)
        return cls(task, on_report)

    @property
    def positions(self) -> dict[str, float]:
        """Positions of the axes, mm or rad. Raises DriverError after a fault, StoppedError after a stop."""
        found = self.report
        self._raise_end_state(found.state, found.why)
        return {name: axis.position for name, axis in found.axes.items()}

    def tip(self, within: float) -> Pose | None:
        """Return the pose of the tip at rest, None if it is not measured; slopes that are not measured are NaN.

        It is the median of at least 9 measurements or of all within a time (s). `read` still returns them.
        """
        until, found = monotonic() + within, list[Measurement]()

        def enough() -> bool:
            found[:] = filter(has_position, self._measurements)
            return len(found) >= _ENOUGH or monotonic() >= until

        self._wait(enough, within + 1.0, "the clock does not advance")
        return median_pose(found)

    @property
    def tip_problem(self) -> str:
        """Reason in the newest measurement for which the tip is not measured, otherwise the tracker's status."""
        newest = self._measurements[-1] if self._measurements else None
        if newest is None or newest.frame is None:
            return f"the tracker's status is {self.status}"
        sensors = newest.frame.readings
        if TIP not in sensors:
            return f"the tracker has no sensor {TIP}, only {', '.join(sensors) or 'none'}"
        return (
            sensors[TIP].status
            if sensors[TIP].status != VISIBLE
            else "its position or orientation is not known"
        )

    def arm(self, deepest: float = inf) -> str:
        """Switch the motors on; deepest: largest advance (mm) from here. Raises StoppedError after a stop.

        A motor at rest that is more than its largest error from its commanded position is switched off and on again,
        so that it is held at its position. Returns a note about it, or "".
        """
        self._check_listener()
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
        self._wait(lambda: self._has_stopped(sent), END_S, "the motors are not known to rest", stopped=True)

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
        if speed is None:
            known = dict(self.rig.axes.items()).get(axis)
            speed = 0.0 if known is None else known.speed  # the supervisor refuses an axis that the rig lacks
        return self._carry_out_to_goal(
            lambda number: protocol.MoveCommand(number, axis, position, speed, retract)
        )

    def _carry_out_to_goal(self, made: Callable[[int], protocol.Request]) -> protocol.MotionResult:
        """Carry out a motion. Raises DriverError if it ended before its goal."""
        done = self._carry_out(made)
        if done.why:
            raise DriverError(done.why)
        return done

    def _carry_out(self, made: Callable[[int], protocol.Request]) -> protocol.MotionResult:
        self._check_listener()  # before anything begins to move
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

    def _request(self, request: protocol.Request) -> None:
        """Send a request and wait until it has been acted on. Raises RefusedError if it is refused."""
        self._answers.pop(0, None)
        sent = self._send(request)
        self._wait(lambda: self.report.requests >= sent, END_S, "no answer to a request", stopped=True)
        if isinstance(refused := self._answers.pop(0, None), protocol.RequestRefused):
            raise RefusedError(refused.why)

    def _has_stopped(self, sent: int) -> bool:
        """Return whether the rig has acted on these requests, and its motors rest."""
        report = self.report
        return (
            report.requests >= sent
            and report.at_rest
            and report.state in (SupervisorState.STOPPED, SupervisorState.FAULT)
        )
