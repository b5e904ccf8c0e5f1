"""Motion of several motors that start and end together, with one trapezoid of speed. Pure functions.

A motor that travels d in time T, with ramps of time h, has the largest speed d/(T − h) and the acceleration
d/((T − h) h). T and h are the smallest within the limits of all axes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from flexneedle.lab.rig.supervisor.drives import Drive

_SHORTEST_S = 1e-3
_ROUNDING = 1e-9
_ROUNDS = 50


@dataclass(frozen=True)
class Trajectory:
    """A motion: motor positions at start and goal by channel (counts), its duration and accelerating time (s)."""

    start: Mapping[str, float]
    goal: Mapping[str, float]
    duration: float
    ramp: float

    def share(self, time: float) -> float:
        """Return the fraction of the travel that is done `time` (s) after the start."""
        if time <= 0.0:
            return 0.0
        if time >= self.duration:
            return 1.0
        near = min(time, self.duration - time)
        cruise = self.cruise
        part = near**2 / (2.0 * self.ramp * cruise) if near < self.ramp else (near - 0.5 * self.ramp) / cruise
        return part if near == time else 1.0 - part

    def at(self, share: float) -> dict[str, float]:
        """Return the positions (counts) by channel at this fraction of the travel."""
        if share == 1.0:  # exactly, without rounding
            return dict(self.goal)
        return {name: begin + share * (self.goal[name] - begin) for name, begin in self.start.items()}

    @property
    def cruise(self) -> float:
        """Time (s) of the whole travel at its largest speed."""
        return self.duration - self.ramp

    @property
    def speeds(self) -> dict[str, float]:
        """Largest speed (counts/s) by channel."""
        return {name: abs(self.goal[name] - begin) / self.cruise for name, begin in self.start.items()}


def plan_trajectory(
    drives: Mapping[str, Drive], start: Mapping[str, float], goal: Mapping[str, float], duration: float
) -> Trajectory:
    """Return the motion from start to goal (counts by channel) within `duration` s, or longer if an axis needs it.

    drives: by channel, those that move.
    """
    travels = [
        (abs((goal[channel] - start[channel]) / drive.axis.scale), drive.axis)
        for channel, drive in drives.items()
    ]
    fastest = (shortest_duration(travel, axis.speed, axis.acceleration) for travel, axis in travels)
    total = max(duration, _SHORTEST_S, *fastest)
    ramp = 0.5 * total
    for _ in range(_ROUNDS):
        ramp = max(
            _SHORTEST_S / 4, *(_shortest_ramp(travel, axis.acceleration, total) for travel, axis in travels)
        )
        needed = max(travel / axis.speed for travel, axis in travels) + ramp
        if needed <= total * (1.0 + _ROUNDING):
            break
        total = needed
    return Trajectory(dict(start), dict(goal), total, ramp)


def shortest_duration(travel: float, speed: float, acceleration: float) -> float:
    """Return the shortest duration (s) of a travel with this largest speed and acceleration."""
    if travel > speed**2 / acceleration:
        return travel / speed + speed / acceleration
    return 2.0 * math.sqrt(travel / acceleration)


def _shortest_ramp(travel: float, acceleration: float, duration: float) -> float:
    """Return the smallest h with travel/((T − h) h) ≤ acceleration."""
    left = duration**2 - 4.0 * travel / acceleration
    return 0.5 * (duration - math.sqrt(max(0.0, left)))


_LOW, _HIGH, _FEWEST, _LEAST_SPREAD = 0.05, 0.95, 3, 0.2


def fit_span(
    samples: Sequence[tuple[float, float]], begun: float, ended: float, last: float = 1.0
) -> tuple[float, float]:
    """Return begin and end (s) of the motion at constant speed that fits samples best.

    samples: time (s) and fraction of the travel. A motor accelerates and slows down: a tip at constant speed from the
    command on would be ahead of it and then behind. last: fraction at the end; begun, ended: returned if too few
    samples are between start and end.
    """
    way = [(time, share) for time, share in samples if _LOW < share < _HIGH]
    if len(way) < _FEWEST or max(way)[1] - min(way)[1] < _LEAST_SPREAD:
        return begun, ended
    time, share = fmean(one for one, _ in way), fmean(one for _, one in way)
    varied = sum((one - share) ** 2 for _, one in way)
    slope = sum((at - time) * (one - share) for at, one in way) / varied  # s for the whole way
    first = time - slope * share
    return first, first + slope * last
