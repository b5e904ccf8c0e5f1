"""Axes of a rig over their motors: the last readings, and the goals of the motors."""

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite

from flexneedle.errors import DriverError
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.checks import (
    Inspection,
    active_switches,
    is_at_home,
    is_at_rest,
    is_at_switch,
    is_misplaced,
)
from flexneedle.lab.rig.supervisor.drives import Drive, MotorReading
from flexneedle.lab.rig.supervisor.motion import CommandedMotion, Leg, make_leg
from flexneedle.lab.rig.supervisor.protocol import AxisState
from flexneedle.ports import Clock, MotorPaces, Motors, MotorState

_SLOWEST_SHARE, _FINE = 0.01, 5.0  # of the largest speed; steps of the speeds that a controller accepts
_REST_S = 0.02  # in which a servo that still follows has moved; readings after a late tick may be closer


class RigAxes:
    """Axes of a rig over their motors: drives by axis, readings, goals (counts by channel) and known limit switches.

    lost: the motors could not be reached, and do not count as resting until they are stopped. A switch is known if it
    was active when positions were taken, and still is. Calls of motors raise DriverError.
    """

    def __init__(self, rig: RigFile, motors: Motors, clock: Clock) -> None:
        self.drives = {name: Drive(name, axis) for name, axis in rig.axes.items()}
        self._motors, self._clock = motors, clock
        self._loop = rig.loop
        paces: MotorPaces | None = getattr(motors, "paces", None)
        self._finest = 0.0 if paces is None else paces.speeds[0]
        self.lost = False
        self.newest = self.before = self._read()
        self._past = deque([self.newest])
        self.goals = dict[str, float]()
        self.take_positions()

    @property
    def states(self) -> Mapping[str, MotorState]:
        """The states of the last reading."""
        return self.newest.states

    @property
    def at_rest(self) -> bool:
        """Whether all motors are known to rest."""
        return not self.lost and all(map(self.is_at_rest, self.drives.values()))

    def is_at_rest(self, drive: Drive) -> bool:
        """Return whether an axis rests, its servo included, by two readings that are long enough apart."""
        past, channel = self._past[0], drive.axis.channel
        apart = self.newest.asked - past.known >= _REST_S
        return apart and is_at_rest(drive, self.newest.states[channel], past.states[channel])

    @property
    def positions(self) -> dict[str, float]:
        """Measured positions (mm or rad) by axis."""
        return {name: drive.to_position(self.state(drive).position) for name, drive in self.drives.items()}

    @property
    def slowing(self) -> float:
        """Longest time (s) in which an axis slows down from its largest speed."""
        return max(drive.axis.speed / drive.axis.acceleration for drive in self.drives.values())

    def axis_states(self, leg: Leg | None) -> dict[str, AxisState]:
        """Return position, motor, and motion in the queue by axis, for reports. leg: under way."""
        at, queued = self.positions, {} if leg is None else leg.queued_distances(self.states)
        return {
            name: AxisState(at[name], self.state(drive), queued.get(name, 0.0))
            for name, drive in self.drives.items()
        }

    def state(self, drive: Drive) -> MotorState:
        """Return the state of an axis's motor."""
        return self.newest.states[drive.axis.channel]

    def is_at_home(self, drive: Drive) -> bool:
        """Return whether an axis is at the limit switch of its home, and rests there, its servo included."""
        return is_at_home(drive, self.state(drive)) and self.is_at_rest(drive)

    def is_at_switch(self, drive: Drive) -> bool:
        """Return whether the limit switch of an axis's home is active; the axis may not be at rest yet."""
        return is_at_switch(drive, self.state(drive))

    def first_problem(self, motion: CommandedMotion | None, *, stopping: bool) -> str:
        """Return the problem of the first axis that has one at this tick, or ""."""
        inspection = Inspection(motion, self.goals, stopping, self.newest, self.before, self.switches)
        return inspection.first_problem(self.drives)

    def goal(self, name: str) -> float:
        """Return the last goal of an axis, or its position when it was last stopped (mm or rad)."""
        drive = self.drives[name]
        return drive.to_position(self.goals[drive.axis.channel])

    def settle(self, *drives: Drive) -> None:
        """Set goals to current positions, for the given axes or all.

        A servo that lags still moves to its controller's commanded position.
        """
        for drive in drives or self.drives.values():
            state = self.state(drive)
            self.goals[drive.axis.channel] = state.commanded if state.on else state.position

    def take_positions(self) -> None:
        """Set goals and reported positions to current positions."""
        self.settle()
        self._reported = self.positions
        self.switches = {
            drive.axis.channel: active_switches(self.state(drive)) for drive in self.drives.values()
        }

    def take_travel(self) -> dict[str, float]:
        """Return the travel (mm or rad) by axis since the reported end of the motion before, settling included."""
        at, before = self.positions, self._reported
        self._reported = at
        return {name: at[name] - before[name] for name in at}

    # Calls of the motors

    def read(self) -> None:
        """Read the states of all motors."""
        with self._mark_lost_on_error():
            self.before, self.newest = self.newest, self._read()
        self._past.append(self.newest)
        while len(self._past) > 1 and self.newest.asked - self._past[1].known >= _REST_S:
            self._past.popleft()
        self.switches = {
            channel: active & active_switches(self.states[channel])
            for channel, active in self.switches.items()
        }

    def power_on(self) -> str:
        """Switch all motors on, and read them; return a note of further changes, or "".

        A motor that is on but rests away from its commanded position is switched off first, so that it is held where
        it is.
        """
        changed = []
        with self._mark_lost_on_error():
            for drive in self.drives.values():
                state, before = self.state(drive), self.before.states[drive.axis.channel]
                if state.on and is_at_rest(drive, state, before) and is_misplaced(drive, state):
                    self._motors.power(drive.axis.channel, False)
                    off = drive.to_text(abs(drive.error_of(state)))
                    changed.append(
                        f"{drive.name}: was {off} from its commanded position, now held where it is"
                    )
                self._motors.power(drive.axis.channel, True)
        self.read()
        return "; ".join(changed)

    def power_off(self) -> None:
        """Switch all motors off, also if one of them fails; raise DriverError with all problems."""
        problems = {}
        for name, drive in self.drives.items():
            try:
                self._motors.power(drive.axis.channel, False)
            except DriverError as error:
                problems[name] = f"{name}: {error}"
        self.read()
        on = (name for name, drive in self.drives.items() if self.state(drive).on)
        problems = {name: f"{name}: the motor is still on" for name in on} | problems
        if problems:
            raise DriverError("; ".join(problems.values()))

    def home_offset(self, drive: Drive) -> float:
        """Return the correction (counts) of a motor's position by which its axis is at its home now."""
        now = self.drives[drive.name]
        return now.to_counts(now.axis.at_home) - self.state(now).position

    def shift(self, drive: Drive, counts: float) -> None:
        """Shift the position of a motor at rest, and with it its goal and its reported position."""
        self.read()  # a servo may have settled since
        position = self.state(drive).position + counts
        if not isfinite(position):
            raise DriverError(f"{drive.name}: its home cannot be set at position {position:g}")
        with self._mark_lost_on_error():
            self._motors.define(drive.axis.channel, position)
        self.read()
        self.settle(drive)
        self._reported[drive.name] = self.positions[drive.name]

    def stop(self) -> None:
        """Stop all motors; those that were lost are connected again before."""
        with self._mark_lost_on_error():
            if self.lost:
                self._motors.reconnect()
            self._motors.stop()
            self.lost = False

    def leg(self, travel: Mapping[str, float], duration: float, now: float) -> Leg | None:
        """Return the leg of a travel (mm or rad by axis) from the present goals; None if nothing moves."""
        leg = make_leg(self.drives, self.goals, travel, duration, now)
        if leg is not None:
            self.drives |= {drive.name: drive for drive in leg.drives.values()}
        return leg

    def begin(self, leg: Leg, now: float) -> None:
        """Set the speeds of a leg, and send its first targets."""
        for channel, speed in leg.trajectory.speeds.items():
            axis = leg.drives[channel].axis
            fastest = axis.speed * abs(axis.scale)
            # Controllers round small speeds, to 0 as well; a motor that is faster waits for its next target.
            slowest = min(fastest, max(_SLOWEST_SHARE * fastest, _FINE * self._finest))
            self._motors.set_speed(channel, max(speed, slowest), axis.acceleration * abs(axis.scale))
        self.follow(leg, now)

    def follow(self, leg: Leg, now: float) -> None:
        """Send the targets of a leg, with no more motion than the queue."""
        self._motors.follow(leg.targets(now, self._loop, self.states))

    def keep_goal(self, leg: Leg) -> None:
        """Set the goals of motors to the end of a leg."""
        self.goals |= leg.trajectory.goal

    def _read(self) -> MotorReading:
        begun = self._clock.now()
        states = dict(self._motors.read())
        if missing := [
            drive.axis.channel for drive in self.drives.values() if drive.axis.channel not in states
        ]:
            raise DriverError(f"the driver reports no state for channel {', '.join(missing)}")
        return MotorReading(states, begun, self._clock.now())

    @contextmanager
    def _mark_lost_on_error(self) -> Iterator[None]:
        """Mark the motors as lost if the block raises DriverError."""
        try:
            yield
        except DriverError:
            self.lost = True
            raise
