"""Motions under way: legs one after another, the targets of their motors, and their measured progress; and stops."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.lab.rig.rig_file import LoopSettings
from flexneedle.lab.rig.supervisor.drives import Drive, has_arrived
from flexneedle.lab.rig.supervisor.protocol import Expectation
from flexneedle.lab.rig.supervisor.trajectory import Trajectory, fit_span, plan_trajectory
from flexneedle.ports import MotorState

SETTLE_S = 0.5
"""Longest time (s) from the end of a trajectory until its motors have arrived."""
_STUCK_S = 0.3  # longest time that motors rest away from their targets
_MOST_WAITED = 10.0  # times its duration: slower motors do not do what they are commanded


@dataclass
class Leg:
    """Motors that move together.

    drives: by channel, with the side of this direction; begun: start, s on the run's clock; samples: measured
    fractions of the travel as (time, fraction); waited: time (s) for which the trajectory has waited for its motors;
    sent: last targets (counts by channel); share: their fraction of the travel; marked: distance of all motors
    (tolerances) and time (s) at the last progress.
    """

    drives: Mapping[str, Drive]
    trajectory: Trajectory
    begun: float
    samples: list[tuple[float, float]] = field(default_factory=list)
    waited: float = 0.0
    sent: Mapping[str, float] = field(default_factory=dict)
    share: float = 0.0
    marked: tuple[float, float] = (0.0, -math.inf)

    def targets(
        self, now: float, loop: LoopSettings, states: Mapping[str, MotorState]
    ) -> Mapping[str, float]:
        """Return the present targets of the motors (counts by channel), kept as `sent`.

        Motors reach them one queue later. No target is further from its motor than the motor moves in that time at the
        speed of the motion: the trajectory waits for a late motor.
        """
        wanted = self.trajectory.share(now - self.begun - self.waited + loop.queue)
        most = self._largest_share(loop, states)
        self.waited += max(0.0, wanted - most) * self.trajectory.cruise
        self.share = max(self.share, min(wanted, most))
        self.sent = self.trajectory.at(self.share)
        return self.sent

    def _largest_share(self, loop: LoopSettings, states: Mapping[str, MotorState]) -> float:
        """Return the largest fraction of the travel at which no target is too far from its motor."""
        speeds, shares = self.trajectory.speeds, [1.0]
        for name, drive in self.drives.items():
            if way := abs(self.way(name) / drive.axis.scale):
                free = loop.queue_of(drive.axis, speeds[name] / abs(drive.axis.scale))
                shares.append((self._measure_travel(name, states) + free) / way)
        return min(shares)

    def _measure_travel(self, channel: str, states: Mapping[str, MotorState]) -> float:
        """Return the distance that a motor has moved towards its goal (mm or rad)."""
        gone = (states[channel].position - self.trajectory.start[channel]) / abs(
            self.drives[channel].axis.scale
        )
        return gone if self.way(channel) > 0.0 else -gone

    def queued_distances(self, states: Mapping[str, MotorState]) -> dict[str, float]:
        """Return the distance of each axis to its last target (mm or rad), to which it moves without a further one."""
        return {
            drive.name: abs((self.sent[name] - states[name].position) / drive.axis.scale)
            for name, drive in self.drives.items()
            if name in self.sent
        }

    def describe_queue(self, states: Mapping[str, MotorState]) -> str:
        """Return the distance of each axis to its last target and the time to come to rest there, for messages."""
        parts, speeds = [], self.trajectory.speeds
        for channel, drive in self.drives.items():
            speed = speeds[channel] / abs(drive.axis.scale)
            if (way := self.queued_distances(states).get(drive.name, 0.0)) and speed:
                seconds = way / speed + speed / drive.axis.acceleration
                parts.append(f"{drive.name} by {drive.to_text(way)} within {seconds:.2f} s")
        return ", ".join(parts)

    def record_progress(self, states: Mapping[str, MotorState], now: float) -> None:
        """Record the fraction of the travel that is done, and the time of the last progress.

        The motor with the longest travel measures it.
        """
        gone = sum(
            self._measure_travel(name, states) / drive.axis.tolerance for name, drive in self.drives.items()
        )
        if gone > self.marked[0] + 1.0:
            self.marked = gone, now
        channel = max(self.drives, key=self._seconds)
        if way := self.way(channel):
            self.samples.append((now, (states[channel].position - self.trajectory.start[channel]) / way))

    def way(self, channel: str) -> float:
        """Return a motor's travel (counts, signed)."""
        return self.trajectory.goal[channel] - self.trajectory.start[channel]

    def _seconds(self, channel: str) -> float:
        """Return the duration (s) of a motor's travel at its largest speed."""
        axis = self.drives[channel].axis
        return abs(self.way(channel) / axis.scale) / axis.speed

    def has_arrived(self, states: Mapping[str, MotorState], now: float) -> bool:
        """Return whether the last target was sent, and every motor is at rest there."""
        if now < self.begun + self.waited + self.trajectory.duration or self.share < 1.0:
            return False
        return all(
            has_arrived(drive, states[name], self.trajectory.goal[name])
            for name, drive in self.drives.items()
        )

    def is_overdue(self, states: Mapping[str, MotorState], now: float) -> bool:
        """Return whether the motors are far beyond the time of their arrival, or rest away from their targets."""
        duration = self.trajectory.duration
        latest = self.begun + min(self.waited, _MOST_WAITED * duration) + duration
        stuck = now > max(self.begun, self.marked[1]) + _STUCK_S and any(
            abs((self.sent[name] - states[name].position) / drive.axis.scale) > drive.axis.tolerance
            for name, drive in self.drives.items()
        )
        return now > latest + SETTLE_S or stuck

    def describe_missing(self, states: Mapping[str, MotorState]) -> str:
        """Return the distance of each motor from its goal, for messages."""
        goal = self.trajectory.goal
        return ", ".join(
            f"{drive.name} {drive.to_text(abs((goal[name] - states[name].position) / drive.axis.scale))}"
            for name, drive in self.drives.items()
        )

    def span(self, now: float, done: bool) -> tuple[float, float]:
        """Return the measured begin and end (s). done: it reached its goal; otherwise it ended by now."""
        ramp, duration = 0.5 * self.trajectory.ramp, self.trajectory.duration
        last = 1.0 if done or not self.samples else self.samples[-1][1]
        ending = self.begun + self.waited + duration - ramp
        begun, ended = fit_span(self.samples, self.begun + ramp, ending, last)
        return min(begun, now), min(ended, now)


@dataclass
class CommandedMotion:
    """A motion of one request: legs still to come as (travel by axis, duration), the present leg, and what was done.

    expected: expected motion of the tip; roll: whether the first leg is a roll alone; spans: begin and end (s) of each
    completed leg; here: axis whose home is its present position; until: time (s) at which that axis must rest; home:
    axis whose home is searched; released: axis that leaves the switch of its home; shift: correction of its positions
    (counts); unlimited: soft limits have no meaning during homing; why: reason for an end before the goal, or "".
    """

    number: int
    legs: list[tuple[Mapping[str, float], float]]
    expected: Expectation | None = None
    roll: bool = False
    here: Drive | None = None
    until: float = math.inf
    home: Drive | None = None
    released: Drive | None = None
    shift: float = 0.0
    unlimited: bool = False
    leg: Leg | None = None
    spans: list[tuple[float, float]] = field(default_factory=list)
    why: str = ""

    @property
    def rolls(self) -> bool:
        """Whether the needle is rolled alone now, before the travel."""
        return self.roll and not self.spans

    def times(self, now: float) -> tuple[float, float, float | None]:
        """Return begin and end, and the begin of the travel after a roll (None: no roll) (s).

        `now` where nothing has moved.
        """
        if not self.spans:
            return now, now, None
        begun, ended = self.spans[0][0], self.spans[-1][1]
        if not self.roll:
            return begun, ended, None
        return begun, ended, self.spans[1][0] if len(self.spans) > 1 else ended


def make_leg(
    drives: Mapping[str, Drive],
    goals: Mapping[str, float],
    travel: Mapping[str, float],
    duration: float,
    now: float,
) -> Leg | None:
    """Return the leg of a travel (mm or rad by axis) from the present goals, None if nothing moves.

    drives: by axis, before the leg; goals: counts by channel. Positions are absolute, so that rounding does not add up.
    """
    moved = {name: drives[name].in_direction(way) for name, way in travel.items() if way != 0.0}
    if not moved:
        return None
    by_channel = {drive.axis.channel: drive for drive in moved.values()}
    start = {channel: goals[channel] for channel in by_channel}
    goal = {
        drive.axis.channel: drive.to_counts(
            drives[name].to_position(goals[drive.axis.channel]) + travel[name]
        )
        for name, drive in moved.items()
    }
    return Leg(by_channel, plan_trajectory(by_channel, start, goal, duration), now)


_UNSTOPPED = "no stop could be sent"


def warn_unstopped(
    why: str, leg: Leg | None, drives: Mapping[str, Drive], states: Mapping[str, MotorState]
) -> str:
    """Return the reason of a fault with what may still move since no stop could be sent, and what to do.

    leg: under way; drives: by axis; states: the last that are known. Targets are absolute: a controller that works ends
    each motion there, with any driver.
    """
    if _UNSTOPPED in why:
        return why
    queue = "" if leg is None else leg.describe_queue(states)
    moves = f"may still move to their last targets: {queue}" if queue else "nothing had a target ahead"
    homed = ", ".join(name for name, drive in drives.items() if drive.axis.home != "absolute")
    lost = "positions are wrong: withdraw the needle by hand"
    home = f"; after a restart of the controller {lost}, then home {homed} again" if homed else ""
    remedy = "press the emergency stop if an axis moves on, support a vertical axis, wait until all rest"
    return (
        f"{_UNSTOPPED}: {moves}; a controller that fails may do anything else: {remedy}{home}; cause: {why}"
    )


_AGAIN_S = 0.25  # after which motors that still move are stopped again, and a lost controller is called again
_RESTING_S = 0.5  # longest time from the first stop, in addition to the deceleration, until motors must rest


@dataclass
class StopUnderWay:
    """Stop under way: the times (s) of the first and of the next command."""

    since: float
    due: float

    def repeat(self, now: float) -> None:
        """Set the time of the next command, after one that is sent now."""
        self.due = now + _AGAIN_S

    def has_failed(self, now: float, slowing: float) -> bool:
        """Return whether motors should rest by now. slowing: longest deceleration (s) of a motor."""
        return now - self.since > _RESTING_S + slowing
