"""The supervisor without its process: requests, ticks, and what they make of motors and tracker.

Each tick reads motors and tracker, checks both, and either sends the next targets or stops. Motors get targets at most
the queue of `loop` ahead, so that they stop by themselves where ticks end. Nothing here waits but for replies of the
devices, each at most its reply timeout.
"""

from collections.abc import Callable
from typing import Any

from flexneedle.errors import DriverError
from flexneedle.lab.rig.supervisor import messages as say
from flexneedle.lab.rig.supervisor.axes import RigAxes
from flexneedle.lab.rig.supervisor.checks import resting_switch_problem, stuck_problem, switch_problem
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.inspection import Inspection
from flexneedle.lab.rig.supervisor.machine import Event, State, after, refusal
from flexneedle.lab.rig.supervisor.motion import SETTLE_S, Leg, Motion, beyond
from flexneedle.lab.rig.supervisor.requested import back_off, going, homing, stepping
from flexneedle.lab.rig.supervisor.room import Room
from flexneedle.lab.rig.supervisor.stopping import Stopping
from flexneedle.lab.rig.supervisor.tip import TrackedTip
from flexneedle.ports import Clock, Motors, Tracker

HEARTBEAT_S = 0.5
"""Longest time (s) without a message of the client during a motion."""

_STALL_S = 0.5  # without a tick, after which a motion under way is not taken up again
_UNCHECKED = frozenset({State.IDLE, State.STOPPED, State.FAULT})
"""States in which motors may be off, and have been stopped: nothing more can be done about what they do."""


class Supervisor:
    """State of a rig, and what its motors are to do. send: called with each message to the client but reports."""

    def __init__(
        self, task: say.Task, motors: Motors, tracker: Tracker, clock: Clock, send: Callable[[Any], None]
    ) -> None:
        self._task, self._clock, self._send = task, clock, send
        self.state, self.why = State.IDLE, ""
        self._heard = self._ticked_at = now = clock.now()
        self._axes, self._tip = RigAxes(task.rig, motors, clock), TrackedTip(task, tracker, now)
        self._motion: Motion | None = None
        self._stopping: Stopping | None = None  # until the motors rest
        self._deepest, self._requests = 0.0, 0

    @property
    def at_rest(self) -> bool:
        """Whether all motors are known to rest."""
        return self._axes.at_rest

    # Requests

    def request(self, request: say.Request) -> None:
        """Act on a message of the client."""
        self._heard = self._clock.now()
        self._requests += 1
        match request:
            case say.Stop(who):
                self.stop(who)
            case say.Reset():
                if self._allowed(Event.RESET):
                    self._enter(Event.RESET)
            case say.Off():
                self._off()
            case say.Arm(deepest):
                self._arm(deepest)
            case say.Step():
                self._step(request)
            case say.Go():
                self._go(request)
            case say.Home():
                self._home(request)

    def stop(self, who: str) -> None:
        """Stop all motors, in any state: what rests may have been moved by somebody else."""
        if self.state not in (State.STOPPED, State.FAULT):
            self._enter(Event.STOP, who)
        self._halt(who)

    def _enter(self, event: Event, why: str = "") -> None:
        """Change the state by an event that it accepts."""
        new = after(self.state, event)
        if new is not None:
            self.state, self.why = new, why

    def _allowed(self, event: Event, number: int = 0) -> bool:
        """Whether the state accepts an event and nothing moves; else the request is refused with the reason."""
        return self._possible(refusal(self.state, event, self.why, moving=self._busy), number)

    @property
    def _busy(self) -> bool:
        """Whether a motion or a stop is under way."""
        return self._motion is not None or self._stopping is not None

    def _possible(self, problem: str, number: int = 0) -> bool:
        """Whether a request has no problem; else it is refused."""
        if problem:
            self._send(say.Refused(number, problem, self.state, self.why))
        return not problem

    @property
    def _room(self) -> Room:
        """Where the axes may go from here."""
        drives = self._axes.drives
        return Room(drives, {name: self._axes.goal(name) for name in drives}, self._deepest)

    def _arm(self, deepest: float) -> None:
        if not self._allowed(Event.ARM):
            return
        if not self._possible(self._outside):  # as it most often is, before any motor is switched on
            return
        try:
            changed = self._axes.power_on()
        except DriverError as error:
            self._unreachable(str(error))
            return
        if not self._possible(self._outside):
            return
        self._axes.take_positions()
        self._deepest = self._axes.positions["insertion"] + deepest
        self._enter(Event.ARM, changed)

    @property
    def _outside(self) -> str:
        """A problem with where an axis rests as an insertion begins, or ""; an operator may move it back."""
        if not self._task.tracked:
            return ""
        axes = self._axes
        problems = [beyond(axes.drives, list(axes.positions.items()), resting=True)]
        problems += [resting_switch_problem(drive, axes.state(drive)) for drive in axes.drives.values()]
        return next((f"arm: refused: {problem}" for problem in problems if problem), "")

    def _off(self) -> None:
        if not self._allowed(Event.OFF):
            return
        try:
            self._axes.power_off()
        except DriverError as error:
            self._enter(Event.FAULT, str(error))
            self._unreachable(str(error))

    def _step(self, step: say.Step) -> None:
        if self.state is State.HOLDING and self._stopping is not None:
            self._nothing_done(step.number)
            return
        if not self._allowed(Event.STEP, step.number):
            return
        if not self._possible(self._room.step_problem(step), step.number):
            return
        if step.expected is not None:  # until the travel begins the tip is where it is
            self._tip.expect_start(step.expected, self._clock.now())
        if not self._tip.verdict.ok:  # still, or again: nothing moves
            self._nothing_done(step.number)
            return
        self._begin(Event.STEP, stepping(step))

    def _nothing_done(self, number: int) -> None:
        now, why = self._clock.now(), self.why if self._tip.verdict.ok else str(self._tip.verdict)
        self._send(say.Done(number, dict.fromkeys(self._axes.drives, 0.0), now, now, self.state, why))

    def _go(self, go: say.Go) -> None:
        event = Event.RETRACT if go.retract else Event.JOG
        if self._allowed(event, go.number) and self._possible(self._room.go_problem(go), go.number):
            self._begin(event, going(go, self._axes.drives[go.axis], self._axes.goal(go.axis)))

    def _home(self, home: say.Home) -> None:
        if not self._allowed(Event.HOME, home.number):
            return
        if not self._possible(self._room.home_problem(home), home.number):
            return
        drive = self._axes.drives[home.axis]
        if not self._possible(stuck_problem(drive, self._axes.state(drive)), home.number):
            return
        self._enter(Event.HOME)
        self._motion = motion = homing(home.number, drive, at_switch=self._axes.at_switch(drive))
        now = self._clock.now()
        if motion.here is None:
            self._next_leg(now)
        else:
            motion.until = now + SETTLE_S

    def _begin(self, event: Event, motion: Motion) -> None:
        """Begin a motion at once, not at the next tick."""
        self._enter(event)
        self._motion, self._ticked_at = motion, self._clock.now()
        self._next_leg(self._clock.now())

    # Ticks

    def tick(self) -> None:
        """Read motors and tracker, check, and send targets or stop."""
        before, now = self._ticked_at, self._clock.now()
        self._ticked_at = now
        self._check_ticks(now - before)
        self._measure(now)
        self._check_motors()
        self._check_client(now)
        if self._stopping is not None:
            self._stop_motors(self._stopping, now)
        elif self._motion is not None and self._motion.leg is not None:
            self._go_on(self._motion, self._motion.leg, now)
        elif self._motion is not None and self._motion.here is not None:
            self._call_home(self._motion, self._motion.here, now)

    def report(self, late: float, work: float, missed: int) -> say.Report:
        """What the last tick found, with the measurements since the last report."""
        axes, tip = self._axes, self._tip
        leg = None if self._motion is None or self._stopping is not None else self._motion.leg
        found = axes.shown(leg), tip.take(), tip.status, not self._busy
        return say.Report(self._ticked_at, self.state, self.why, *found, late, work, missed, self._requests)

    def _check_ticks(self, seconds: float) -> None:
        """Ticks were late: the motors have stopped, and after long nothing goes on by itself."""
        if self._motion is not None and self._motion.leg is not None and seconds > _STALL_S:
            self.stop(f"no tick for {seconds:.2f} s, limit {_STALL_S:g} s")

    def _measure(self, now: float) -> None:
        try:
            self._tip.read(now)
        except DriverError as error:
            self._fault(str(error))
            return
        if not self._tip.verdict.ok and self.state is State.INSERTING:
            self._hold(str(self._tip.verdict))

    def _hold(self, why: str) -> None:
        """Stop the insertion. A roll under way is completed: a bevel at any angle could not be steered."""
        self._enter(Event.HOLD, why)
        if self._motion is not None and self._motion.rolls:
            self._motion.why, self._motion.legs = why, []
        else:
            self._halt(why)

    def _check_motors(self) -> None:
        axes = self._axes
        if axes.lost:
            return
        try:
            axes.read()
        except DriverError as error:
            self._unreachable(str(error))
            return
        if self.state in _UNCHECKED:
            self._check_rest()
            return
        stopping = self._stopping is not None
        inspection = Inspection(self._motion, axes.goals, stopping, axes.newest, axes.before, axes.switches)
        if problem := inspection.first_problem(axes.drives):
            self._fault(problem)

    def _check_rest(self) -> None:
        """After a stop or a fault motors rest; one that is moved by somebody else is stopped again."""
        moving = any(state.moving for state in self._axes.states.values())
        if moving and self._stopping is None and self.state is not State.IDLE:
            self._halt(self.why)

    def _check_client(self, now: float) -> None:
        silent, limit = now - self._heard, self._task.rig.loop.decision_limit_s
        if self._motion is not None and silent > HEARTBEAT_S:
            self.stop(f"no heartbeat of the controller for {silent:.2f} s")
        elif self.state in (State.INSERTING, State.HOLDING) and silent > limit:
            self.stop(f"no command of the controller for {silent:.2f} s, limit {limit:g} s")

    # Faults and stops

    def _fault(self, why: str) -> None:
        if self.state is not State.FAULT:
            self._enter(Event.FAULT, why)
            self._halt(why)

    def _unreachable(self, why: str) -> None:
        """The motors cannot be read or commanded: a fault, and they are stopped as soon as they can be."""
        self._fault(why)
        if self._stopping is None:
            self._stopping = Stopping.at(self._clock.now())

    def _halt(self, why: str) -> None:
        """Stop the motors now, and end the motion under way once they rest."""
        if self._motion is not None:
            self._motion.why = self._motion.why or why
        now = self._clock.now()
        self._tip.stop(now)
        # A stop that is repeated does not begin anew: motors that do not stop would never be found.
        self._stop_motors(Stopping.at(now) if self._stopping is None else self._stopping.due_at(now), now)

    def _stop_motors(self, stopping: Stopping, now: float) -> None:
        """Stop motors, again while they move or cannot be reached; once they rest, end the motion under way."""
        if now < stopping.due:
            if self.at_rest:
                self._stopping = None
                self._finish(now)
                self._axes.settle()
            return
        self._stopping = stopping.again(now)
        if stopping.has_failed(now, self._axes.slowing):
            self._fault("the motors do not stop")
            self._finish(now)
        try:
            self._axes.stop()
        except DriverError as error:
            self._fault(str(error))
            self._finish(now)

    # Motions

    def _next_leg(self, now: float) -> None:
        """Begin the next leg that moves anything, or end the motion."""
        motion = self._motion
        if motion is None:
            return
        motion.leg = None
        while motion.legs and motion.leg is None:
            motion.leg = self._axes.leg(*motion.legs.pop(0), now)
        if motion.leg is None:
            self._finish(now)
            return
        if motion.expected is not None and not motion.legs:
            self._tip.expect(motion.expected, now, now + motion.leg.trajectory.duration)
        try:
            self._axes.begin(motion.leg, now)
        except DriverError as error:
            self._not_followed(motion, str(error))

    def _go_on(self, motion: Motion, leg: Leg, now: float) -> None:
        """Send the next targets, or go on to the next leg."""
        axes = self._axes
        leg.note(axes.states, axes.newest.time)
        if motion.home is not None and axes.at_home(motion.home):
            self._leave_switch(motion, motion.home)
            self._next_leg(now)
        elif leg.has_arrived(axes.states, now) and self._may_be_defined(motion):
            if motion.home is not None:
                motion.why = f"{motion.home.name}: no limit switch within its range"
            motion.spans.append(leg.span(now, done=True))
            axes.keep_goal(leg)
            if motion.released is not None:
                self._has_left(motion, motion.released)
            self._next_leg(now)
        elif leg.overdue(axes.states, now):
            restless = leg.has_arrived(axes.states, now) and motion.released
            missing = f"the motors have not arrived: {leg.missing(axes.states)} from the goal"
            self._fault(f"{restless.name}: does not rest" if restless else missing)
        elif motion.home is not None and axes.at_switch(motion.home):
            pass  # the motor controller slows it down, and takes no target meanwhile
        else:
            waited = leg.waited
            try:
                axes.follow(leg, now)
            except DriverError as error:
                self._not_followed(motion, str(error))
            self._tip.wait(now, leg.waited - waited)  # while the trajectory waits for its motors

    def _may_be_defined(self, motion: Motion) -> bool:
        """Whether the position may be shifted after this leg: of an axis off its home, once its servo rests, too.

        Else the shift would count from a position that is no more true.
        """
        return motion.released is None or self._axes.rests(motion.released)

    def _not_followed(self, motion: Motion, why: str) -> None:
        """A target was refused: a fault, but not at the limit switch that is the home, which the next tick reads."""
        if motion.home is not None:
            self._check_motors()
            if self._axes.at_switch(motion.home):
                return
        self._fault(why)

    def _finish(self, now: float) -> None:
        """End the motion under way, and report what was done."""
        motion, self._motion = self._motion, None
        if motion is None:
            return
        if motion.leg is not None:
            motion.spans.append(motion.leg.span(now, done=False))
        if self.state in (State.HOMING, State.JOGGING, State.RETRACTING):
            self._enter(Event.ARRIVED)
        travelled, (begun, ended, turned) = self._axes.take_travel(), motion.times(now)
        self._send(say.Done(motion.number, travelled, begun, ended, self.state, motion.why, turned))

    def _leave_switch(self, motion: Motion, drive: Drive) -> None:
        """At rest at the switch that was searched: note where that is, and move off it."""
        motion.shift = self._axes.from_home(drive)
        self._axes.settle(drive)
        motion.home, motion.released, motion.legs = None, drive, [back_off(drive)]

    def _call_home(self, motion: Motion, drive: Drive, now: float) -> None:
        """Call where an axis is its home, once it rests there."""
        if self._axes.rests(drive):
            self._set_home(drive, self._axes.from_home(drive))
            self._finish(now)
        elif now > motion.until:
            self._fault(f"{drive.name}: does not rest")

    def _has_left(self, motion: Motion, drive: Drive) -> None:
        """Off the switch of the home, which must be released by now: it is searched, or the home is where it was.

        A switch that is stuck shows no home, and then positions stay as they were.
        """
        motion.why = switch_problem(drive, self._axes.state(drive))
        if motion.why:
            motion.legs = []
        elif motion.legs:
            motion.home, motion.released = drive, None
        else:
            self._set_home(drive, motion.shift)

    def _set_home(self, drive: Drive, shift: float) -> None:
        """Shift the positions of an axis (counts), so that its home is where that was found."""
        try:
            self._axes.shift(drive, shift)
        except DriverError as error:
            self._unreachable(str(error))
