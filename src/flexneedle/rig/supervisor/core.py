"""The supervisor without its process: requests, ticks, and what they make of motors and tracker.

Each tick reads motors and tracker, checks both, and either sends the next targets or stops. Motors get targets at most
`loop.queue_ms` ahead, so that they stop by themselves where ticks end. Nothing here waits.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from flexneedle.errors import DriverError
from flexneedle.rig.monitor.monitor import Monitor
from flexneedle.rig.ports import Clock, Motors, MotorState, Tracker
from flexneedle.rig.supervisor import messages as say
from flexneedle.rig.supervisor.checks import at_home, rests
from flexneedle.rig.supervisor.drives import Drive
from flexneedle.rig.supervisor.inspection import Inspection
from flexneedle.rig.supervisor.machine import Event, State, accepted, after
from flexneedle.rig.supervisor.motion import Leg, Motion, beyond, leg_of, positions
from flexneedle.rig.supervisor.room import Room
from flexneedle.rig.supervisor.trajectory import shortest
from flexneedle.rig.supervisor.watch import Watch
from flexneedle.rig.tracking.stage import tip_on_stage
from flexneedle.types import Measurement

HEARTBEAT_S = 0.5
"""Longest time (s) without a message of the client during a motion."""

_AGAIN_S = 0.25  # after which motors that still move are stopped again, and a lost controller is called again
_RESTING_S = 0.5  # longest time from the first stop, besides that of slowing down, until motors must rest
_STALL_S = 0.5  # without a tick, after which a motion under way is not taken up again
_BACK_OFF_SHARE = 0.02  # of the range an axis moves away from its limit switch
_HOMING_SHARE = 0.1  # of the largest speed
_SLOWEST_SHARE, _SLOWEST = 0.01, 10.0  # of the largest speed, and counts/s
_HOMING_REACH = 1.1  # of the range
_UNCHECKED = frozenset({State.IDLE, State.STOPPED, State.FAULT})
"""States in which motors may be off, and have been stopped: nothing more can be done about what they do."""


class Supervisor:
    """State of a rig, and what its motors are to do. send: called with each message to the client but reports."""

    def __init__(
        self, task: say.Task, motors: Motors, tracker: Tracker, clock: Clock, send: Callable[[Any], None]
    ) -> None:
        self._task, self._motors, self._tracker, self._clock, self._send = task, motors, tracker, clock, send
        self._drives = {name: Drive(name, axis) for name, axis in task.rig.axes.items()}
        self._loop = task.rig.loop
        self.state, self.why = State.IDLE, ""
        self._heard = self._ticked_at = now = clock.now()
        self._watch = Watch(Monitor(task.monitor, task.lateral_axes), task.stale_after, now)
        self._lost = False
        self._reported: Mapping[str, float] = {}
        self._states: Mapping[str, MotorState] = {}
        self._read()
        self._take_positions()
        self._motion: Motion | None = None
        self._deepest = 0.0
        self._stop_at: float | None = None  # when motors are stopped (again); None: they need not be
        self._stopped_at = now  # when they were first
        self._measurements: tuple[Measurement, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Whether all motors are known to rest."""
        return not self._lost and self._resting

    # Requests

    def request(self, request: say.Request) -> None:
        """Act on a message of the client."""
        self._heard = self._clock.now()
        match request:
            case say.Stop(who):
                self.stop(who)
            case say.Reset():
                self._reset()
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
        because = f": {self.why}" if self.why else ""
        if after(self.state, event) is None:
            choices = ", ".join(accepted(self.state))
            self._refuse(number, f"{event}: refused while {self.state}{because}; accepted: {choices}")
            return False
        if self._motion is not None or self._stop_at is not None:
            self._refuse(number, f"{event}: refused: motors have not come to rest yet{because}")
            return False
        return True

    @property
    def _room(self) -> Room:
        """Where the axes may go from here."""
        at = {name: self._goal(name) for name in self._drives}
        return Room(self._drives, at, self._deepest)

    def _refuse(self, number: int, why: str) -> None:
        self._send(say.Refused(number, why, self.state, self.why))

    def _reset(self) -> None:
        if self._allowed(Event.RESET):
            self._enter(Event.RESET)

    def _arm(self, deepest: float) -> None:
        if not self._allowed(Event.ARM):
            return
        try:
            for drive in self._drives.values():
                self._motors.power(drive.axis.channel, True)
            self._read()
        except DriverError as error:
            self._unreachable(str(error))
            return
        at = self._positions()
        if self._task.tracked and (problem := beyond(self._drives, list(at.items()))):
            self._refuse(0, f"arm: refused: {problem}")
            return
        self._take_positions()
        self._deepest = at["insertion"] + deepest
        self._enter(Event.ARM)

    def _step(self, step: say.Step) -> None:
        if self.state is State.HOLDING and self._stop_at is not None:
            self._nothing_done(step.number)
            return
        if not self._allowed(Event.STEP, step.number):
            return
        if problem := self._room.step_problem(step):
            self._refuse(step.number, problem)
            return
        now = self._clock.now()
        if step.expected is not None:  # until the travel begins the tip is where it is
            there = replace(step.expected, end=step.expected.begin)
            self._watch = self._watch.expecting(there, now, now).after((), now, self._tracker.status)
        if not self._watch.verdict.ok:  # still, or again: nothing moves
            self._nothing_done(step.number)
            return
        self._enter(Event.STEP)
        roll: list[tuple[Mapping[str, float], float]] = [({"rotation": step.roll}, 0.0)] if step.roll else []
        legs = [*roll, (step.travel, step.duration)]
        self._begin(Motion(step.number, legs, step.expected, roll=bool(step.roll)))

    def _nothing_done(self, number: int) -> None:
        now, why = self._clock.now(), str(self._watch.verdict) if not self._watch.verdict.ok else self.why
        self._send(say.Done(number, dict.fromkeys(self._drives, 0.0), now, now, self.state, why))

    def _go(self, go: say.Go) -> None:
        event = Event.RETRACT if go.retract else Event.JOG
        if not self._allowed(event, go.number):
            return
        if problem := self._room.go_problem(go):
            self._refuse(go.number, problem)
            return
        travel = go.position - self._goal(go.axis)
        duration = shortest(abs(travel), go.speed, self._drives[go.axis].axis.acceleration)
        self._enter(event)
        self._begin(Motion(go.number, [({go.axis: travel}, duration)]))

    def _home(self, home: say.Home) -> None:
        if not self._allowed(Event.HOME, home.number):
            return
        if problem := self._room.home_problem(home):
            self._refuse(home.number, problem)
            return
        drive = self._drives[home.axis]
        self._enter(Event.HOME)
        self._motion = motion = Motion(home.number, [], unlimited=True)
        if drive.axis.to_home and not at_home(drive, self._states[drive.axis.channel]):
            low, high = drive.axis.limits
            travel = drive.axis.to_home * _HOMING_REACH * (high - low)
            motion.legs, motion.home = [self._slowly(drive, travel)], drive
        else:  # where it is, or at the switch already
            self._set_home(motion, drive)
        self._next_leg(self._clock.now())

    def _slowly(self, drive: Drive, travel: float) -> tuple[Mapping[str, float], float]:
        """The leg of a travel (mm or rad) at the speed of homing."""
        axis = drive.axis
        return {drive.name: travel}, shortest(abs(travel), _HOMING_SHARE * axis.speed, axis.acceleration)

    def _begin(self, motion: Motion) -> None:
        """Begin a motion at once, not at the next tick."""
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
        if self._stop_at is not None:
            self._stop_motors(now)
        elif self._motion is not None and self._motion.leg is not None:
            self._go_on(self._motion, self._motion.leg, now)

    def report(self, late: float, work: float, missed: int) -> say.Report:
        """What the last tick found, with the measurements since the last report."""
        measurements, self._measurements = self._measurements, ()
        at = self._positions()
        leg = None if self._motion is None or self._stop_at is not None else self._motion.leg
        queued = {} if leg is None else leg.queued(self._states)
        axes = {
            name: say.AxisState(at[name], self._states[drive.axis.channel], queued.get(name, 0.0))
            for name, drive in self._drives.items()
        }
        times = late, work, missed
        head = self._ticked_at, self.state, self.why, axes, measurements, self._tracker.status
        return say.Report(*head, not self._lost, *times)

    def _check_ticks(self, seconds: float) -> None:
        """Ticks were late: the motors have stopped, and after long nothing goes on by itself."""
        if self._motion is not None and self._motion.leg is not None and seconds > _STALL_S:
            self.stop(f"no tick for {seconds:.2f} s, limit {_STALL_S:g} s")

    def _measure(self, now: float) -> None:
        task = self._task
        try:
            frames = self._tracker.read()
        except DriverError as error:
            self._fault(str(error))
            return
        found = tuple(tip_on_stage(frame, task.to_stage, task.tip_offset) for frame in frames)
        self._measurements += found
        self._watch = self._watch.after(found, now, self._tracker.status)
        if not self._watch.verdict.ok and self.state is State.INSERTING:
            self._hold(str(self._watch.verdict))

    def _hold(self, why: str) -> None:
        """Stop the insertion. A roll under way is completed: a bevel at any angle could not be steered."""
        self._enter(Event.HOLD, why)
        if self._motion is not None and self._motion.rolls:
            self._motion.why, self._motion.legs = why, []
        else:
            self._halt(why)

    def _check_motors(self) -> None:
        if self._lost:
            return
        before, read_at = self._states, self._read_at
        try:
            self._read()
        except DriverError as error:
            self._unreachable(str(error))
            return
        if self.state in _UNCHECKED:
            self._check_rest()
            return
        seconds, stopping = self._read_at - read_at, self._stop_at is not None
        inspection = Inspection(self._motion, self._goals, stopping, self._states, before, seconds)
        if problem := inspection.first_problem(self._drives):
            self._fault(problem)

    def _check_rest(self) -> None:
        """After a stop or a fault motors rest; one that is moved by somebody else is stopped again."""
        moving = any(state.moving for state in self._states.values())
        if moving and self._stop_at is None and self.state is not State.IDLE:
            self._halt(self.why)

    def _read(self) -> None:
        begun, before = self._clock.now(), self._states
        self._states = states = dict(self._motors.read())
        self._read_at = 0.5 * (begun + self._clock.now())
        self._resting = all(
            rests(
                drive, states[drive.axis.channel], before.get(drive.axis.channel, states[drive.axis.channel])
            )
            for drive in self._drives.values()
        )

    def _unreachable(self, why: str) -> None:
        """The motors cannot be read or commanded: a fault, and they are stopped as soon as they can be."""
        self._lost = True
        self._fault(why)
        if self._stop_at is None:
            self._stop_at = self._stopped_at = self._clock.now()

    def _check_client(self, now: float) -> None:
        silent, limit = now - self._heard, self._loop.decision_limit_s
        if self._motion is not None and silent > HEARTBEAT_S:
            self.stop(f"no heartbeat of the controller for {silent:.2f} s")
        elif self.state in (State.INSERTING, State.HOLDING) and silent > limit:
            self.stop(f"no command of the controller for {silent:.2f} s, limit {limit:g} s")

    def _fault(self, why: str) -> None:
        if self.state is not State.FAULT:
            self._enter(Event.FAULT, why)
            self._halt(why)

    def _halt(self, why: str) -> None:
        """Stop the motors now, and end the motion under way once they rest."""
        if self._motion is not None:
            self._motion.why = self._motion.why or why
        self._stop_at = self._stopped_at = self._clock.now()
        self._watch = self._watch.at_rest(self._stop_at)
        self._stop_motors(self._stop_at)

    def _stop_motors(self, now: float) -> None:
        """Stop motors, again while they move or cannot be reached; once they rest, end the motion under way."""
        if self._stop_at is None:
            return
        if now < self._stop_at:
            if self.at_rest:
                self._stop_at = None
                self._finish(now)
                self._goals = self._at()
            return
        self._stop_at = now + _AGAIN_S
        if now - self._stopped_at > _RESTING_S + self._slowing:
            self._fault("the motors do not stop")
            self._finish(now)
        try:
            if self._lost:
                self._motors.reconnect()
            self._motors.stop()
            self._lost = False
        except DriverError as error:
            self._lost = True
            self._fault(str(error))
            self._finish(now)

    @property
    def _slowing(self) -> float:
        """Longest time (s) in which an axis slows down from its largest speed."""
        return max(drive.axis.speed / drive.axis.acceleration for drive in self._drives.values())

    # Motions

    def _next_leg(self, now: float) -> None:
        """Begin the next leg that moves anything, or end the motion."""
        motion = self._motion
        if motion is None:
            return
        motion.leg = None
        while motion.legs and motion.leg is None:
            travel, duration = motion.legs.pop(0)
            motion.leg = leg_of(self._drives, self._goals, travel, duration, now)
        if motion.leg is None:
            self._finish(now)
            return
        leg = motion.leg
        self._drives |= {drive.name: drive for drive in leg.drives.values()}
        if motion.expected is not None and not motion.legs:
            self._watch = self._watch.expecting(motion.expected, now, now + leg.trajectory.duration)
        try:
            for channel, speed in leg.trajectory.speeds.items():
                axis = leg.drives[channel].axis
                fastest = axis.speed * abs(axis.scale)
                # Controllers round small speeds, to 0 as well; a motor that is faster waits for its next target.
                slowest = min(fastest, max(_SLOWEST_SHARE * fastest, _SLOWEST))
                self._motors.set_speed(channel, max(speed, slowest), axis.acceleration * abs(axis.scale))
            self._follow(leg, now)
        except DriverError as error:
            self._not_followed(motion, str(error))

    def _go_on(self, motion: Motion, leg: Leg, now: float) -> None:
        """Send the next targets, or go on to the next leg."""
        leg.note(self._states, self._read_at)
        if motion.home is not None and at_home(motion.home, self._states[motion.home.axis.channel]):
            self._set_home(motion, motion.home)
            motion.home, motion.leg = None, None
            self._next_leg(now)
        elif leg.has_arrived(self._states, now):
            if motion.home is not None:
                motion.why = f"{motion.home.name}: no limit switch within its range"
            self._end_leg(motion, leg, now)
        elif leg.overdue(self._states, now):
            self._fault(f"the motors have not arrived: {leg.missing(self._states)} from the goal")
        else:
            try:
                self._follow(leg, now)
            except DriverError as error:
                self._not_followed(motion, str(error))

    def _follow(self, leg: Leg, now: float) -> None:
        """Send the next targets. While the trajectory waits for its motors, so does what is expected of the tip."""
        before = leg.waited
        self._motors.follow(leg.targets(now, self._loop, self._states))
        self._watch = self._watch.waiting(now, leg.waited - before)

    def _not_followed(self, motion: Motion, why: str) -> None:
        """A target was refused: a fault, but not at the limit switch that is the home, which the next tick reads."""
        if motion.home is not None:
            self._check_motors()
            if at_home(motion.home, self._states[motion.home.axis.channel]):
                return
        self._fault(why)

    def _end_leg(self, motion: Motion, leg: Leg, now: float) -> None:
        motion.spans.append(leg.span(now, done=True))
        self._goals |= leg.trajectory.goal
        motion.leg = None
        self._next_leg(now)

    def _finish(self, now: float) -> None:
        """End the motion under way, and report what was done."""
        motion, self._motion = self._motion, None
        if motion is None:
            return
        if motion.leg is not None:
            motion.spans.append(motion.leg.span(now, done=False))
        # From where the motion before was reported to have ended, so that what motors settle since then counts, too.
        at = self._positions()
        travelled = {name: at[name] - self._reported[name] for name in at}
        self._reported = at
        if motion.released is not None and not motion.why:
            motion.why = self._still_at_switch(motion.released)
        if self.state in (State.HOMING, State.JOGGING, State.RETRACTING):
            self._enter(Event.ARRIVED)
        begun, ended, turned = motion.times(now)
        self._send(say.Done(motion.number, travelled, begun, ended, self.state, motion.why, turned))

    def _still_at_switch(self, drive: Drive) -> str:
        """A problem with a limit switch that is active away from it, or ""."""
        if at_home(drive, self._states[drive.axis.channel]):
            return f"{drive.name}: the {drive.axis.home} switch is still active away from it"
        return ""

    def _set_home(self, motion: Motion, drive: Drive) -> None:
        """Call the present position of an axis its home; from beyond its range it then moves into that."""
        drive, home = self._drives[drive.name], drive.axis.at_home
        try:
            self._motors.define(drive.axis.channel, drive.counts(home))
            self._read()
        except DriverError as error:
            self._unreachable(str(error))
            return
        self._take_positions()
        if drive.axis.to_home:
            low, high = drive.axis.limits
            into = min(max(home, low), high) - home - drive.axis.to_home * _BACK_OFF_SHARE * (high - low)
            motion.legs, motion.released = [self._slowly(drive, into)], drive

    def _take_positions(self) -> None:
        """Take where the motors are as where they were sent, and as reported."""
        self._goals, self._reported = self._at(), self._positions()

    def _at(self) -> dict[str, float]:
        """Where the motors rest (counts) by channel: a servo that lags still moves to where its controller has it."""
        return {
            channel: state.commanded if state.on else state.position
            for channel, state in self._states.items()
        }

    def _goal(self, name: str) -> float:
        """Where an axis was last sent, or where it was when it last was stopped (mm or rad)."""
        drive = self._drives[name]
        return drive.position(self._goals[drive.axis.channel])

    def _positions(self) -> dict[str, float]:
        return positions(self._drives, self._states)
