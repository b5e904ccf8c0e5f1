"""A motion under way: its legs one after the other, where its motors shall be, and what they really did."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from flexneedle.lab.rig.rig_file import LoopSettings
from flexneedle.lab.rig.supervisor.checks import arrived
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.measured import span
from flexneedle.lab.rig.supervisor.messages import Expectation
from flexneedle.lab.rig.supervisor.trajectory import Trajectory, between
from flexneedle.ports import MotorState

SETTLE_S = 0.5
"""Longest time (s) from the end of a trajectory until its motors have arrived."""
_STUCK_S = 0.3  # longest time that motors rest away from their targets
_MOST_WAITED = 10.0  # times its duration: slower motors do not do what they are commanded


@dataclass
class Leg:
    """Motors that move together. drives: by channel, as they are in this direction; begun: s on the run's clock.

    waited: how long (s) the trajectory has waited for its motors; sent: the last targets (counts by channel); share: of
    the way, there; marked: tolerances that the motors had gone in all at the time (s) when they last had gone on.
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
        """Where the motors shall go now (counts by channel). Kept as `sent`.

        They shall be there a queue later, but no target is further from its motor than the motor goes in that time at
        the speed of the motion: for motors that are behind the trajectory waits.
        """
        wanted = self.trajectory.share(now - self.begun - self.waited + loop.queue)
        most = self._most(loop, states)
        self.waited += max(0.0, wanted - most) * self.trajectory.cruise
        self.share = max(self.share, min(wanted, most))
        self.sent = self.trajectory.at(self.share)
        return self.sent

    def _most(self, loop: LoopSettings, states: Mapping[str, MotorState]) -> float:
        """Largest share of the way at which no target is too far from its motor."""
        speeds, shares = self.trajectory.speeds, [1.0]
        for name, drive in self.drives.items():
            if way := abs(self.way(name) / drive.axis.scale):
                free = loop.queue_of(drive.axis, speeds[name] / abs(drive.axis.scale))
                shares.append((self._gone(name, states) + free) / way)
        return min(shares)

    def _gone(self, channel: str, states: Mapping[str, MotorState]) -> float:
        """How far a motor has gone on its way (mm or rad)."""
        gone = (states[channel].position - self.trajectory.start[channel]) / abs(
            self.drives[channel].axis.scale
        )
        return gone if self.way(channel) > 0.0 else -gone

    def queued(self, states: Mapping[str, MotorState]) -> dict[str, float]:
        """How far each axis is from the target that was last sent (mm or rad): what it does without another one."""
        return {
            drive.name: abs((self.sent[name] - states[name].position) / drive.axis.scale)
            for name, drive in self.drives.items()
            if name in self.sent
        }

    def note(self, states: Mapping[str, MotorState], now: float) -> None:
        """Keep how much of the way is done, by the motor with the longest, and when the motors have gone on."""
        gone = sum(self._gone(name, states) / drive.axis.tolerance for name, drive in self.drives.items())
        if gone > self.marked[0] + 1.0:
            self.marked = gone, now
        channel = max(self.drives, key=self._seconds)
        if way := self.way(channel):
            self.samples.append((now, (states[channel].position - self.trajectory.start[channel]) / way))

    def way(self, channel: str) -> float:
        """A motor's way (counts, signed)."""
        return self.trajectory.goal[channel] - self.trajectory.start[channel]

    def _seconds(self, channel: str) -> float:
        """Duration (s) of a motor's way at its largest speed."""
        axis = self.drives[channel].axis
        return abs(self.way(channel) / axis.scale) / axis.speed

    def has_arrived(self, states: Mapping[str, MotorState], now: float) -> bool:
        """Whether the last target was sent, and every motor is at rest there."""
        if now < self.begun + self.waited + self.trajectory.duration or self.share < 1.0:
            return False
        return all(
            arrived(drive, states[name], self.trajectory.goal[name]) for name, drive in self.drives.items()
        )

    def overdue(self, states: Mapping[str, MotorState], now: float) -> bool:
        """Whether the motors should have arrived long ago, or rest away from their targets."""
        duration = self.trajectory.duration
        latest = self.begun + min(self.waited, _MOST_WAITED * duration) + duration
        stuck = now > max(self.begun, self.marked[1]) + _STUCK_S and any(
            abs((self.sent[name] - states[name].position) / drive.axis.scale) > drive.axis.tolerance
            for name, drive in self.drives.items()
        )
        return now > latest + SETTLE_S or stuck

    def missing(self, states: Mapping[str, MotorState]) -> str:
        """How far each motor is from its goal, for messages."""
        goal = self.trajectory.goal
        return ", ".join(
            f"{drive.name} {drive.shown(abs((goal[name] - states[name].position) / drive.axis.scale))}"
            for name, drive in self.drives.items()
        )

    def span(self, now: float, done: bool) -> tuple[float, float]:
        """When it began and ended, as measured (s). done: whether it reached its goal; else it ended by now."""
        ramp, duration = 0.5 * self.trajectory.ramp, self.trajectory.duration
        last = 1.0 if done or not self.samples else self.samples[-1][1]
        ending = self.begun + self.waited + duration - ramp
        begun, ended = span(self.samples, self.begun + ramp, ending, last)
        return min(begun, now), min(ended, now)


@dataclass
class Motion:
    """A motion of one request: legs still to come as (travel by axis, duration), the present leg, and what was done.

    expected: of the tip; roll: whether the first leg is a roll alone; spans: begin and end of each leg that is done;
    here: the axis whose home is where it is, or None; until: when it must rest (s); home: the axis whose home is
    searched, or None; released: the axis that leaves the switch of its home, or None; shift: of its positions, so that
    the home is where that was found (counts);
    unlimited: positions count from nowhere yet, or the axis comes from its home beyond its range; why: why it ends
    before its goal, or "".
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
        """When it began and ended, and when the travel began after a roll (None: no roll) (s).

        `now` where nothing has moved.
        """
        if not self.spans:
            return now, now, None
        begun, ended = self.spans[0][0], self.spans[-1][1]
        if not self.roll:
            return begun, ended, None
        return begun, ended, self.spans[1][0] if len(self.spans) > 1 else ended


def leg_of(
    drives: Mapping[str, Drive],
    goals: Mapping[str, float],
    travel: Mapping[str, float],
    duration: float,
    now: float,
) -> Leg | None:
    """The leg of a travel (mm or rad by axis) from the present goals (counts by channel); None where nothing moves.

    drives: by axis, as they are before. Positions are absolute, so that rounding does not add up.
    """
    moved = {name: drives[name].towards(way) for name, way in travel.items() if way != 0.0}
    if not moved:
        return None
    by_channel = {drive.axis.channel: drive for drive in moved.values()}
    start = {channel: goals[channel] for channel in by_channel}
    goal = {
        drive.axis.channel: drive.counts(drives[name].position(goals[drive.axis.channel]) + travel[name])
        for name, drive in moved.items()
    }
    return Leg(by_channel, between(by_channel, start, goal, duration), now)


def positions(drives: Mapping[str, Drive], states: Mapping[str, MotorState]) -> dict[str, float]:
    """Measured positions (mm or rad) by axis."""
    return {name: drive.position(states[drive.axis.channel].position) for name, drive in drives.items()}


def beyond(drives: Mapping[str, Drive], ends: Sequence[tuple[str, float]], *, resting: bool = False) -> str:
    """A problem with the first of these positions by axis that is outside the axis's range, or "".

    By less than the tolerance of a goal it is not: a motor may rest there. resting: nor by what the lost motion adds,
    for positions of motors that were sent within the range.
    """
    for name, position in ends:
        axis = drives[name].axis
        (low, high), slack = axis.limits, axis.uncertainty if resting else axis.tolerance
        if not low - slack <= position <= high + slack:
            shown = drives[name].shown
            return f"{name} = {shown(position)}: must be within {shown(low)} and {shown(high)}"
    return ""
