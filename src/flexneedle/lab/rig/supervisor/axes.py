"""The axes of a rig over their motors: what was read of them last, and where they were last sent."""

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import isfinite

from flexneedle.errors import DriverError
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.checks import at_home, at_switch, misplaced, rests, switches
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.messages import AxisState
from flexneedle.lab.rig.supervisor.motion import Leg, leg_of, positions
from flexneedle.ports import Clock, MotorPaces, Motors, MotorState

_SLOWEST_SHARE, _FINE = 0.01, 5.0  # of the largest speed; steps of the speeds that a controller takes
_REST_S = (
    0.02  # in which a servo that follows on shows it; two readings after a late tick may be closer together
)


@dataclass(frozen=True)
class Reading:
    """The states of the motors by channel, and when they were asked for and known (s): they are of a time between."""

    states: Mapping[str, MotorState]
    asked: float
    known: float

    @property
    def time(self) -> float:
        """When they most likely were (s)."""
        return 0.5 * (self.asked + self.known)


class RigAxes:
    """Drives by axis, their motors, the last reading and the one before it, where motors were last sent (counts by
    channel), and limit switches by channel that were active as positions were taken, and still are.

    lost: whether the motors could not be reached, so that they are not known to
    rest, until they are stopped. Calls of motors raise DriverError.
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
        return not self.lost and all(map(self.rests, self.drives.values()))

    def rests(self, drive: Drive) -> bool:
        """Whether an axis rests, its servo included, as far as readings show that are long enough apart."""
        past, channel = self._past[0], drive.axis.channel
        apart = self.newest.asked - past.known >= _REST_S
        return apart and rests(drive, self.newest.states[channel], past.states[channel])

    @property
    def positions(self) -> dict[str, float]:
        """Measured positions (mm or rad) by axis."""
        return positions(self.drives, self.states)

    @property
    def slowing(self) -> float:
        """Longest time (s) in which an axis slows down from its largest speed."""
        return max(drive.axis.speed / drive.axis.acceleration for drive in self.drives.values())

    def shown(self, leg: Leg | None) -> dict[str, AxisState]:
        """Position, motor, and motion in the queue by axis, for reports. leg: under way."""
        at, queued = self.positions, {} if leg is None else leg.queued(self.states)
        return {
            name: AxisState(at[name], self.state(drive), queued.get(name, 0.0))
            for name, drive in self.drives.items()
        }

    def state(self, drive: Drive) -> MotorState:
        """The state of an axis's motor."""
        return self.newest.states[drive.axis.channel]

    def at_home(self, drive: Drive) -> bool:
        """Whether an axis is at the limit switch of its home, and rests there, its servo included."""
        return at_home(drive, self.state(drive)) and self.rests(drive)

    def at_switch(self, drive: Drive) -> bool:
        """Whether the limit switch of an axis's home is active; the axis may not be at rest yet."""
        return at_switch(drive, self.state(drive))

    def goal(self, name: str) -> float:
        """Where an axis was last sent, or where it was when it last was stopped (mm or rad)."""
        drive = self.drives[name]
        return drive.position(self.goals[drive.axis.channel])

    # Where the axes are taken to be

    def settle(self, *drives: Drive) -> None:
        """Take where motors rest as where they were sent: those of axes, without any all.

        A servo that lags still moves to where its controller has it.
        """
        for drive in drives or self.drives.values():
            state = self.state(drive)
            self.goals[drive.axis.channel] = state.commanded if state.on else state.position

    def take_positions(self) -> None:
        """Take where the motors are as where they were sent, and as reported."""
        self.settle()
        self._reported = self.positions
        self.switches = {drive.axis.channel: switches(self.state(drive)) for drive in self.drives.values()}

    def take_travel(self) -> dict[str, float]:
        """The travel (mm or rad) by axis from where the motion before was reported to have ended, so that what motors
        settle since then counts, too."""
        at, before = self.positions, self._reported
        self._reported = at
        return {name: at[name] - before[name] for name in at}

    # Calls of the motors

    def read(self) -> None:
        """Read the states of all motors."""
        with self._reached():
            self.before, self.newest = self.newest, self._read()
        self._past.append(self.newest)
        while len(self._past) > 1 and self.newest.asked - self._past[1].known >= _REST_S:
            self._past.popleft()
        self.switches = {
            channel: active & switches(self.states[channel]) for channel, active in self.switches.items()
        }

    def power_on(self) -> str:
        """Switch all motors on, and read them; return what else was changed, or "".

        A motor that is on, and rests away from where its controller has it, is switched off before: switched on again,
        it is held where it is.
        """
        changed = []
        with self._reached():
            for drive in self.drives.values():
                if self._is_misplaced(drive):
                    self._motors.power(drive.axis.channel, False)
                    off = drive.shown(abs(drive.error(self.state(drive))))
                    changed.append(
                        f"{drive.name}: was {off} from its commanded position, now held where it is"
                    )
                self._motors.power(drive.axis.channel, True)
        self.read()
        return "; ".join(changed)

    def _is_misplaced(self, drive: Drive) -> bool:
        """Whether a motor is on, and rests too far from where its controller has it."""
        state, before = self.state(drive), self.before.states[drive.axis.channel]
        return state.on and rests(drive, state, before) and misplaced(drive, state)

    def power_off(self) -> None:
        """Switch all motors off, the others also where one cannot be; raise DriverError with all problems."""
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

    def from_home(self, drive: Drive) -> float:
        """What is missing in the position of a motor (counts) whose axis is at its home now."""
        now = self.drives[drive.name]
        return now.counts(now.axis.at_home) - self.state(now).position

    def shift(self, drive: Drive, counts: float) -> None:
        """Shift the position of a motor where it rests, and with it where it was sent, and what was reported."""
        self.read()  # a servo may have settled since
        position = self.state(drive).position + counts
        if not isfinite(position):
            raise DriverError(f"{drive.name}: its home cannot be set at position {position:g}")
        with self._reached():
            self._motors.define(drive.axis.channel, position)
        self.read()
        self.settle(drive)
        self._reported[drive.name] = self.positions[drive.name]

    def stop(self) -> None:
        """Stop all motors; those that were lost are connected again before."""
        with self._reached():
            if self.lost:
                self._motors.reconnect()
            self._motors.stop()
            self.lost = False

    def leg(self, travel: Mapping[str, float], duration: float, now: float) -> Leg | None:
        """The leg of a travel (mm or rad by axis) from where the axes were last sent; None where nothing moves."""
        leg = leg_of(self.drives, self.goals, travel, duration, now)
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
        """Take the goal of a leg as where its motors were sent."""
        self.goals |= leg.trajectory.goal

    def _read(self) -> Reading:
        begun = self._clock.now()
        states = dict(self._motors.read())
        if missing := [
            drive.axis.channel for drive in self.drives.values() if drive.axis.channel not in states
        ]:
            raise DriverError(f"the driver reports no state of channel {', '.join(missing)}")
        return Reading(states, begun, self._clock.now())

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """A call without which nothing is known of the motors."""
        try:
            yield
        except DriverError:
            self.lost = True
            raise
