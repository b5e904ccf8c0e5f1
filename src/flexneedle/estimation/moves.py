"""The moves of an insertion, and the readings taken during each."""

import cmath
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import nan
from statistics import fmean
from typing import NamedTuple

from flexneedle.estimation.sensors import SENSORS, Sensor
from flexneedle.types import STILL, Control, Floats, Measurement, Motion, Point, Pose

_KEPT = 100  # readings of a move at rest that are kept one by one
_ROUNDING_S = 1e-9


class Means(NamedTuple):
    """Means over the readings of a move."""

    part: float  # share of the move that is done
    x: float  # x of the tip (mm)
    y: float  # y of the measured quantity
    z: float  # z of the measured quantity
    facing_y: float  # y of the bevel's direction, relative to its direction after the move
    facing_z: float  # z of the bevel's direction
    number: float
    across: float  # variance of the mean of y or z where all readings report it, else NaN
    ahead: float  # variance of the mean of x where all readings report it, else NaN

    def join(self, other: "Means") -> "Means":
        """Return the means over the readings of both."""
        number = self.number + other.number
        mine, theirs = self.number / number, other.number / number
        last = Means._fields.index("number")
        means = [mine * a + theirs * b for a, b in zip(self[:last], other[:last], strict=True)]
        variances = [
            mine**2 * a + theirs**2 * b for a, b in zip(self[last + 1 :], other[last + 1 :], strict=True)
        ]
        return Means._make([*means, number, *variances])


@dataclass(frozen=True)
class Move:
    """A motion as applied by the driver, and the good readings taken during it."""

    motion: Motion  # the motion; `turned` is None if the roll took no time, or there was none
    measurements: tuple[Measurement, ...] = ()
    # means over readings of a needle at rest that are no longer kept one by one
    earlier: Mapping[str, Means] = field(default_factory=dict)

    @cached_property
    def means(self) -> Mapping[str, Means]:
        """Means over its readings by sensor; sensors without readings are left out."""
        means = ((sensor.name, self._mean(sensor)) for sensor in SENSORS.values())
        newer = {name: mean for name, mean in means if mean is not None}
        both = {name: self.earlier[name].join(newer[name]) for name in self.earlier.keys() & newer.keys()}
        return {**self.earlier, **newer, **both}

    def _mean(self, sensor: Sensor) -> Means | None:
        read = [(one, sensor.read(one)) for one in self.measurements]
        known = [(one, value) for one, value in read if value is not None]
        if not known:
            return None
        times = [one.time for one, _ in known]
        facing = sum(cmath.exp(-1j * self.left_to_turn(time)) for time in times) / len(times)
        across = _variance_of_mean([sensor.variance(one) for one, _ in known])
        ahead = _variance_of_mean([one.covariance[0][0] if one.covariance else None for one, _ in known])
        part, x = fmean(map(self.part, times)), fmean(tip_of(one)[0] for one, _ in known)
        y, z = (fmean(column) for column in zip(*(value for _, value in known), strict=True))
        return Means(part, x, y, z, facing.real, facing.imag, float(len(known)), across, ahead)

    @property
    def is_roll(self) -> bool:
        """True for a roll alone, which turns evenly."""
        return self.applied.roll != 0.0 and self.applied._replace(roll=0.0) == STILL

    @property
    def applied(self) -> Control:
        """The control."""
        return self.motion.control

    def extend(self, ended: float) -> "Move":
        """Return the move with a later end (s)."""
        return replace(self, motion=self.motion._replace(ended=ended))

    def left_to_turn(self, time: float) -> float:
        """Return the angle (rad) left to turn at `time`; a roll before a travel is done at its start."""
        if self.is_roll:
            return self.applied.roll * (1.0 - self.part(time))
        before = self.applied.roll if time <= self.motion.travel_begun else 0.0
        return before + self.applied.spin * (1.0 - self.part(time))

    def part(self, time: float) -> float:
        """Return the share of the travel that is done at `time`."""
        begun, ended = self.motion.travel_begun, self.motion.ended
        return 1.0 if ended <= begun else min(1.0, max(0.0, (time - begun) / (ended - begun)))

    def with_readings(self, new: tuple[Measurement, ...]) -> "Move":
        """Return the move with further readings; at rest the newest are kept, and the means of the others."""
        every = self.measurements + new
        count = len(every) - _KEPT if self.applied == STILL else 0
        if count <= 0:
            return replace(self, measurements=every)
        older = replace(self, measurements=every[:count])
        return replace(self, measurements=every[count:], earlier=older.means)

    @staticmethod
    def of(motion: Motion) -> "Move":
        """Return a motion without readings."""
        return Move(motion if motion.control.roll != 0.0 else motion._replace(turned=None))

    @staticmethod
    def parts_of(motion: Motion) -> "tuple[Move, ...]":
        """Return the roll and the travel of a motion as separate moves, if the roll took time."""
        if motion.turned is None or motion.control.roll == 0.0:
            return (Move.of(motion),)
        roll, travel = Control(roll=motion.control.roll), motion.control._replace(roll=0.0)
        parts = Motion(roll, motion.begun, motion.turned), Motion(travel, motion.turned, motion.ended)
        return Move(parts[0]), Move(parts[1])


def assign_readings(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> tuple[Move, ...]:
    """Assign each measurement to the last move that had begun, and earlier ones to the first.

    Between moves the tip rests.
    """
    given: dict[int, list[Measurement]] = {}
    for one, k in zip(measurements, _owners(moves, measurements), strict=True):
        given.setdefault(k, []).append(one)
    return tuple(done.with_readings(tuple(given[k])) if k in given else done for k, done in enumerate(moves))


def drop_roll_readings(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements without those during a roll, when the tip is between two sides of the needle's axis."""
    if not moves:
        return list(measurements)
    owned = zip(measurements, _owners(moves, measurements), strict=True)
    return [
        one
        for one, k in owned
        if moves[k].motion.turned is None or one.time > moves[k].motion.travel_begun - _ROUNDING_S
    ]


def _owners(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> list[int]:
    """Return the number of the last move that had begun before each measurement, 0 for earlier ones."""
    starts = [done.motion.begun for done in moves[1:]]
    return [bisect_left(starts, one.time - _ROUNDING_S) for one in measurements]


def position_along(moves: tuple[Move, ...], tips: Floats, time: float, lead: Floats | None = None) -> Point:
    """Return the position (mm) at `time` on the path through tips (k + 1, 5), at the ends of k moves.

    Between moves the tip rests. lead (k,): axial distance (mm) ahead of the path in each move (default: 0).
    """
    last = bisect_right(moves, time, key=lambda done: done.motion.travel_begun) - 1
    if last < 0:
        return Pose.of(tips[0]).point
    part = moves[last].part(time)
    x, y, z, *_ = ((1.0 - part) * tips[last] + part * tips[last + 1]).tolist()
    return x + (0.0 if lead is None else float(lead[last])), y, z


def _variance_of_mean(variances: Sequence[float | None]) -> float:
    """Return the variance of the mean of readings with these variances; NaN unless all are known."""
    known = [value for value in variances if value is not None]
    return sum(known) / len(known) ** 2 if len(known) == len(variances) else nan


def tip_of(measurement: Measurement) -> Point:
    """Return the tip (mm) of a good measurement, z = 0 if it is not measured. Raises ValueError for an empty one."""
    if measurement.x is None or measurement.y is None:
        raise ValueError("an empty measurement was not removed")
    return measurement.x, measurement.y, measurement.z or 0.0
