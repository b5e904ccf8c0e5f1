"""The supervisor without its process: requests and ticks move the motors of a rig.

Each tick reads motors and tracker, checks both, and either sends the next targets or stops. Targets are at most the
queue of `loop` ahead, so that motors stop if the ticks end. Nothing waits, except for a reply of a device, at most its
timeout.
"""

from collections.abc import Callable
from typing import Any

from flexneedle.errors import DriverError
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.axes import RigAxes
from flexneedle.lab.rig.supervisor.checks import stuck_problem
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.machine import RigEvent, SupervisorState, next_state, refusal_reason
from flexneedle.lab.rig.supervisor.motion import SETTLE_S, CommandedMotion, Leg, StopUnderWay, warn_unstopped
from flexneedle.lab.rig.supervisor.requests import (
    RequestRules,
    end_leaving_switch,
    leave_switch,
    make_homing,
    make_move,
    make_step,
    start_problem,
)
from flexneedle.lab.rig.supervisor.tip_watch import TrackedTip
from flexneedle.ports import Clock, Motors, Tracker

HEARTBEAT_S = 0.5
"""Longest time (s) without a message of the client during a motion."""

_STALL_S = 0.5  # longest time without a tick after which a motion continues
_UNCHECKED = frozenset({SupervisorState.IDLE, SupervisorState.STOPPED, SupervisorState.FAULT})
"""States in which motors may be off, or have been stopped: only a motion is a problem."""


class Supervisor:
    """State machine of a rig: requests and ticks change the state and move the motors.

    send: called with each message to the client except reports.
    """

    def __init__(
        self,
        task: protocol.SupervisorTask,
        motors: Motors,
        tracker: Tracker,
        clock: Clock,
        send: Callable[[Any], None],
    ) -> None:
        self._task, self._clock, self._send = task, clock, send
        self.state, self.why = SupervisorState.IDLE, ""
        self._heard = self._ticked_at = now = clock.now()
        self._axes, self._tip = RigAxes(task.rig, motors, clock), TrackedTip(task, tracker, now)
        self._motion: CommandedMotion | None = None
        self._stopping: StopUnderWay | None = None  # until the motors rest
        self._deepest, self._requests = 0.0, 0

    @property
    def at_rest(self) -> bool:
        """Whether all motors are known to rest."""
        return self._axes.at_rest

    # Requests

    def request(self, request: protocol.Request) -> None:
        """Act on a message of the client."""
        self._heard = self._clock.now()
        self._requests += 1
        match request:
            case protocol.StopCommand(who):
                self.stop(who)
            case protocol.ResetCommand():
                if self._allow(RigEvent.RESET):
                    self._change_state(RigEvent.RESET)
            case protocol.OffCommand():
                self._power_off()
            case protocol.ArmCommand(deepest):
                self._arm(deepest)
            case protocol.StepCommand():
                self._begin_step(request)
            case protocol.MoveCommand():
                self._begin_move(request)
            case protocol.HomeCommand():
                self._begin_homing(request)

    def stop(self, who: str) -> None:
        """Stop all motors, in any state: a motor at rest may have been moved by another program."""
        if self.state not in (SupervisorState.STOPPED, SupervisorState.FAULT):
            self._change_state(RigEvent.STOP, who)
        self._halt_motors(who)

    def _change_state(self, event: RigEvent, why: str = "") -> None:
        """Change the state by an event that it accepts."""
        new = next_state(self.state, event)
        if new is not None:
            self.state, self.why = new, why

    def _allow(self, event: RigEvent, number: int = 0) -> bool:
        """Return whether the state accepts an event and nothing moves; otherwise refuse the request with the reason."""
        return self._accept(refusal_reason(self.state, event, self.why, moving=self._is_busy), number)

    @property
    def _is_busy(self) -> bool:
        """Whether a motion or a stop is under way."""
        return self._motion is not None or self._stopping is not None

    def _accept(self, problem: str, number: int = 0) -> bool:
        """Return whether a request has no problem; otherwise refuse it."""
        if problem:
            self._send(protocol.RequestRefused(number, problem, self.state, self.why))
        return not problem

    @property
    def _rules(self) -> RequestRules:
        """Rules of requests from the present goals."""
        drives = self._axes.drives
        return RequestRules(drives, {name: self._axes.goal(name) for name in drives}, self._deepest)

    def _arm(self, deepest: float) -> None:
        if not self._allow(RigEvent.ARM) or not self._accept(self._start_problem):
            return
        try:
            changed = self._axes.power_on()
        except DriverError as error:
            self._handle_lost_motors(str(error))
            return
        if not self._accept(self._start_problem):  # once more: motors may have moved as they were switched on
            return
        self._axes.take_positions()
        self._deepest = self._axes.positions["insertion"] + deepest
        self._change_state(RigEvent.ARM, changed)

    @property
    def _start_problem(self) -> str:
        """Problem of an insertion from where the axes rest, or ""; an operator may move them back."""
        return start_problem(self._axes.drives, self._axes.states) if self._task.tracked else ""

    def _power_off(self) -> None:
        if not self._allow(RigEvent.OFF):
            return
        try:
            self._axes.power_off()
        except DriverError as error:
            self._change_state(RigEvent.FAULT, str(error))
            self._handle_lost_motors(str(error))

    def _begin_step(self, step: protocol.StepCommand) -> None:
        number = step.number
        if self.state is SupervisorState.HOLDING and self._stopping is not None:
            self._report_nothing_done(number)
            return
        if not self._allow(RigEvent.STEP, number) or not self._accept(self._rules.step_problem(step), number):
            return
        if step.expected is not None:  # until the travel begins the tip rests
            self._tip.expect_start(step.expected, self._clock.now())
        if not self._tip.verdict.ok:
            self._report_nothing_done(number)
            return
        self._begin(RigEvent.STEP, make_step(step))

    def _report_nothing_done(self, number: int) -> None:
        now, why = self._clock.now(), self.why if self._tip.verdict.ok else str(self._tip.verdict)
        self._send(
            protocol.MotionResult(number, dict.fromkeys(self._axes.drives, 0.0), now, now, self.state, why)
        )

    def _begin_move(self, go: protocol.MoveCommand) -> None:
        event = RigEvent.RETRACT if go.retract else RigEvent.JOG
        if self._allow(event, go.number) and self._accept(self._rules.move_problem(go), go.number):
            self._begin(event, make_move(go, self._axes.drives[go.axis], self._axes.goal(go.axis)))

    def _begin_homing(self, home: protocol.HomeCommand) -> None:
        number = home.number
        if not self._allow(RigEvent.HOME, number) or not self._accept(self._rules.home_problem(home), number):
            return
        drive = self._axes.drives[home.axis]
        if not self._accept(stuck_problem(drive, self._axes.state(drive)), number):
            return
        self._change_state(RigEvent.HOME)
        self._motion = motion = make_homing(number, drive, at_switch=self._axes.is_at_switch(drive))
        now = self._clock.now()
        if motion.here is None:
            self._begin_next_leg(now)
        else:
            motion.until = now + SETTLE_S

    def _begin(self, event: RigEvent, motion: CommandedMotion) -> None:
        """Begin a motion at once, not at the next tick."""
        self._change_state(event)
        self._motion, self._ticked_at = motion, self._clock.now()
        self._begin_next_leg(self._clock.now())

    # Ticks

    def tick(self) -> None:
        """Read motors and tracker, check, and send targets or stop."""
        before, now = self._ticked_at, self._clock.now()
        self._ticked_at = now
        if self._motion is not None and self._motion.leg is not None and now - before > _STALL_S:
            # The motors have stopped at the end of their queue.
            self.stop(f"no tick for {now - before:.2f} s, limit {_STALL_S:.2f} s")
        self._read_tracker(now)
        self._check_motors()
        self._check_client(now)
        if self._stopping is not None:
            self._stop_motors(self._stopping, now)
        elif self._motion is not None and self._motion.leg is not None:
            self._continue_leg(self._motion, self._motion.leg, now)
        elif self._motion is not None and self._motion.here is not None:
            self._define_home_here(self._motion, self._motion.here, now)

    def report(self, late: float, work: float, missed: int) -> protocol.TickReport:
        """Return the report of the last tick, with the measurements since the last report."""
        axes, tip = self._axes, self._tip
        leg = None if self._motion is None or self._stopping is not None else self._motion.leg
        found = axes.axis_states(leg), tip.take(), tip.status, not self._is_busy
        return protocol.TickReport(
            self._ticked_at, self.state, self.why, *found, late, work, missed, self._requests
        )

    def _read_tracker(self, now: float) -> None:
        try:
            self._tip.read(now)
        except DriverError as error:
            self._enter_fault(str(error))
            return
        if not self._tip.verdict.ok and self.state is SupervisorState.INSERTING:
            self._hold(str(self._tip.verdict))

    def _hold(self, why: str) -> None:
        """Hold the needle. A roll under way is completed: a bevel at any other angle could not be steered."""
        self._change_state(RigEvent.HOLD, why)
        if self._motion is not None and self._motion.rolls:
            self._motion.why, self._motion.legs = why, []
        else:
            self._halt_motors(why)

    def _check_motors(self) -> None:
        if (axes := self._axes).lost:
            return
        try:
            axes.read()
        except DriverError as error:
            self._handle_lost_motors(str(error))
            return
        if self.state in _UNCHECKED:
            moving = any(state.moving for state in axes.states.values())
            if moving and self._stopping is None and self.state is not SupervisorState.IDLE:
                self._halt_motors(self.why)  # again, after a stop or a fault
            return
        if problem := axes.first_problem(self._motion, stopping=self._stopping is not None):
            self._enter_fault(problem)

    def _check_client(self, now: float) -> None:
        silent, limit = now - self._heard, self._task.rig.loop.decision_limit_s
        if self._motion is not None and silent > HEARTBEAT_S:
            self.stop(f"no heartbeat from the controller for {silent:.2f} s")
        elif self.state in (SupervisorState.INSERTING, SupervisorState.HOLDING) and silent > limit:
            self.stop(f"no command from the controller for {silent:.2f} s, limit {limit:.2f} s")

    # Faults and stops

    def _enter_fault(self, why: str) -> None:
        if self.state is not SupervisorState.FAULT:
            self._change_state(RigEvent.FAULT, why)
            self._halt_motors(why)

    def _handle_lost_motors(self, why: str) -> None:
        """Enter the fault state after a failed call of the motors, and stop them as soon as they can be reached."""
        self._enter_fault(why)
        self._stopping = self._stopping or StopUnderWay(now := self._clock.now(), now)

    def _halt_motors(self, why: str) -> None:
        """Stop the motors now, and end the motion under way once they rest."""
        if self._motion is not None:
            self._motion.why = self._motion.why or why
        now = self._clock.now()
        self._tip.stop(now)
        # A repeated stop keeps its first time: otherwise motors that do not stop would never be found.
        self._stopping = StopUnderWay(now if self._stopping is None else self._stopping.since, now)
        self._stop_motors(self._stopping, now)

    def _stop_motors(self, stopping: StopUnderWay, now: float) -> None:
        """Stop motors, repeatedly while they move or cannot be reached; once they rest, end the motion under way."""
        if now < stopping.due:
            if self.at_rest:
                self._stopping = None
                self._finish_motion(now)
                self._axes.settle()
            return
        stopping.repeat(now)
        if stopping.has_failed(now, self._axes.slowing):
            self._enter_fault("the motors do not stop: press the emergency stop")
            self._finish_motion(now)
        try:
            self._axes.stop()
        except DriverError as error:
            self._enter_fault(str(error))
            leg = None if self._motion is None else self._motion.leg
            self.why = warn_unstopped(self.why, leg, self._axes.drives, self._axes.states)
            if self._motion is not None:
                self._motion.why = self.why
            self._finish_motion(now)

    # Motions

    def _begin_next_leg(self, now: float) -> None:
        """Begin the next leg that moves anything, or end the motion."""
        if (motion := self._motion) is None:
            return
        motion.leg = None
        while motion.legs and motion.leg is None:
            motion.leg = self._axes.leg(*motion.legs.pop(0), now)
        if motion.leg is None:
            self._finish_motion(now)
            return
        if motion.expected is not None and not motion.legs:
            self._tip.expect(motion.expected, now, now + motion.leg.trajectory.duration)
        try:
            self._axes.begin(motion.leg, now)
        except DriverError as error:
            self._handle_refused_target(motion, str(error))

    def _continue_leg(self, motion: CommandedMotion, leg: Leg, now: float) -> None:
        """Send the next targets, or begin the next leg."""
        axes = self._axes
        leg.record_progress(axes.states, axes.newest.time)
        if motion.home is not None and axes.is_at_home(motion.home):
            axes.settle(motion.home)
            leave_switch(motion, motion.home, axes.home_offset(motion.home))
            self._begin_next_leg(now)
        elif leg.has_arrived(axes.states, now) and self._can_define_home(motion):
            if motion.home is not None:
                motion.why = f"{motion.home.name}: no limit switch within its range"
            motion.spans.append(leg.span(now, done=True))
            axes.keep_goal(leg)
            drive = motion.released
            if drive is not None and end_leaving_switch(motion, drive, axes.state(drive)):
                self._define_home(drive, motion.shift)
            self._begin_next_leg(now)
        elif leg.is_overdue(axes.states, now):
            restless = leg.has_arrived(axes.states, now) and motion.released
            missing = f"the motors have not arrived: {leg.describe_missing(axes.states)} from the goal"
            self._enter_fault(f"{restless.name}: has not come to rest" if restless else missing)
        elif motion.home is not None and axes.is_at_switch(motion.home):
            pass  # the motor controller slows it down, and takes no target meanwhile
        else:
            waited = leg.waited
            try:
                axes.follow(leg, now)
            except DriverError as error:
                self._handle_refused_target(motion, str(error))
            self._tip.wait(now, leg.waited - waited)  # while the trajectory waits for its motors

    def _can_define_home(self, motion: CommandedMotion) -> bool:
        """Return whether an axis that has left its switch rests, its servo included, so that its position is known."""
        return motion.released is None or self._axes.is_at_rest(motion.released)

    def _handle_refused_target(self, motion: CommandedMotion, why: str) -> None:
        """Enter the fault state after a refused target, unless the axis is at the switch of its home."""
        if motion.home is not None:
            self._check_motors()
            if self._axes.is_at_switch(motion.home):
                return
        self._enter_fault(why)

    def _finish_motion(self, now: float) -> None:
        """End the motion under way, and report its travel."""
        motion, self._motion = self._motion, None
        if motion is None:
            return
        if motion.leg is not None:
            motion.spans.append(motion.leg.span(now, done=False))
        if self.state in (SupervisorState.HOMING, SupervisorState.JOGGING, SupervisorState.RETRACTING):
            self._change_state(RigEvent.ARRIVED)
        travelled, (begun, ended, turned) = self._axes.take_travel(), motion.times(now)
        self._send(
            protocol.MotionResult(motion.number, travelled, begun, ended, self.state, motion.why, turned)
        )

    def _define_home_here(self, motion: CommandedMotion, drive: Drive, now: float) -> None:
        """Define the present position of an axis as its home, once the axis rests."""
        if self._axes.is_at_rest(drive):
            self._define_home(drive, self._axes.home_offset(drive))
            self._finish_motion(now)
        elif now > motion.until:
            self._enter_fault(f"{drive.name}: has not come to rest")

    def _define_home(self, drive: Drive, shift: float) -> None:
        """Shift the positions of an axis (counts), so that its home is at its position in the rig file."""
        try:
            self._axes.shift(drive, shift)
        except DriverError as error:
            self._handle_lost_motors(str(error))
