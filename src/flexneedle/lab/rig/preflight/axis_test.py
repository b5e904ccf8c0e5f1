"""Test of the axes of a rig in air: each is moved there and back, and the tracker measures the tip."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from flexneedle.errors import DriverError, InputError, RunError
from flexneedle.geometry.quaternion import product
from flexneedle.lab.rig.preflight.moves import AxisMove, plan_jog
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.types import TIP, Floats, Measurement

SCALE_SD = 0.005
"""Standard deviation of a scale to which the travel and the time at rest are adapted: 1 to 2 % are then certain."""
PROBE = 0.25
"""First part of a travel, after which an axis that does not move as expected turns back."""
MOST_SCALE = 3.0
"""Scale beyond which an axis goes no further."""
_FIRST = 0.04  # part of a travel before the probe: in inches, an axis moves by a travel
_LEAST_MM, _MOST_MM = 2.0, 4.0  # travel of a linear axis
_TURN_DEG, _LEAST_TURN_DEG, _PROBE_DEG, _FIRST_DEG = 180.0, 45.0, 10.0, 1.0
_SEEN_DEG = 2.0  # more than the noise of a turn
_SDS = 4.0  # standard deviations beyond which a motion is seen
_LEAST_S, _MOST_S, _SETTLE_S = 1.0, 4.0, 0.4
_MOVES = 1e-3  # of the largest travel, in a tick
_LEAST_READINGS, _ENOUGH, _MOST_WAITS = 5, 0.8, 5


class Operator(Protocol):
    """A rig that is armed; `SupervisorClient`."""

    @property
    def rig(self) -> RigFile:
        """The rig."""
        ...

    @property
    def positions(self) -> Mapping[str, float]:
        """Positions of the axes, mm or rad."""
        ...

    def now(self) -> float:
        """Return the time of the run, s."""
        ...

    def read(self) -> tuple[Measurement, ...]:
        """Return the measurements since the last call."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait while nothing moves."""
        ...

    def move_to(self, axis: str, position: float, speed: float | None = None) -> object:
        """Move one axis to a position (mm or rad)."""
        ...


@dataclass
class MotorHistory:
    """Positions of the axes (mm or rad) with their times (s) and durations (s), of each tick of the supervisor."""

    times: list[float] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    positions: list[Mapping[str, float]] = field(default_factory=list)

    def add(self, report: TickReport) -> None:
        """Add the tick of a report."""
        self.times.append(report.time)
        self.durations.append(report.work)
        self.positions.append({name: axis.position for name, axis in report.axes.items()})

    def at(self, name: str, times: Floats) -> Floats:
        """Return the positions of an axis at times (s)."""
        return np.interp(times, self.times, [found[name] for found in self.positions])

    def lateness(self, times: Floats) -> Floats:
        """Return by how much (s) the ticks around times (s) are further apart, or longer, than usual.

        On a busy computer; positions between them, or in them, are as uncertain.
        """
        if len(self.times) < 2:
            return np.full(len(times), np.inf)
        apart = np.diff(self.times) + np.maximum(self.durations[:-1], self.durations[1:])
        index = np.clip(np.searchsorted(self.times, times) - 1, 0, len(apart) - 1)
        late: Floats = apart[index] - np.median(apart)
        return late

    def motions(self, name: str) -> list[tuple[float, float]]:
        """Return begin and end (s) of each motion of an axis between two rests."""
        at = np.array([found[name] for found in self.positions])
        moved = np.flatnonzero(np.abs(np.diff(at)) > _MOVES * np.ptp(at))
        parts = np.split(moved, np.flatnonzero(np.diff(np.array(self.times)[moved]) > _SETTLE_S) + 1)
        return [(self.times[part[0]], self.times[part[-1] + 1]) for part in parts if len(part)]


@dataclass(frozen=True, eq=False)
class Rest:
    """The rig at rest: positions of the axes, mean of the tip (3,) and its standard deviation (3,), mm.

    spread: standard deviation of a reading (3,), mm; rate: readings in a second; turn: mean orientation of the sensor
    (4,), None if it has none.
    """

    positions: Mapping[str, float]
    tip: Floats
    sd: Floats
    spread: Floats
    rate: float
    turn: Floats | None = None

    def turned_since(self, before: "Rest") -> float | None:
        """Return the rotation (rad) of the sensor about its own axis since another rest."""
        if self.turn is None or before.turn is None:
            return None
        inverse = before.turn * np.array([1.0, -1.0, -1.0, -1.0])
        w, _, _, z = product(inverse, self.turn).tolist()
        return math.remainder(2.0 * math.atan2(z, w), 2.0 * math.pi)


@dataclass(frozen=True)
class AxisPlan:
    """Planned motion of one axis: positions of the first part and the probe (mm or rad), rests as shares of its way.

    gain: motion of the tip (mm) for 1 mm of the axis; seconds: time at rest; readings: of it that suffice.
    """

    move: AxisMove
    gain: float
    first: float
    probe: float
    rests: tuple[float, ...]
    seconds: float
    readings: int


@dataclass(frozen=True, eq=False)
class AxisRun:
    """Measured motion of one axis: its rests, and all readings with the motor positions at their times.

    times: (n,), s; tips: (n, 3), mm.
    """

    plan: AxisPlan
    rests: tuple[Rest, ...]
    times: Floats
    tips: Floats

    @property
    def name(self) -> str:
        """Name of the axis."""
        return self.plan.move.name

    @property
    def complete(self) -> bool:
        """Whether the axis went beyond the probe."""
        return len(self.rests) > 3

    def travel(self, first: int, last: int) -> float:
        """Return the travel of the motor (mm or rad) between two rests."""
        return self.rests[last].positions[self.name] - self.rests[first].positions[self.name]

    def moved(self, first: int, last: int) -> Floats:
        """Return the motion of the tip (3,) between two rests, mm."""
        return self.rests[last].tip - self.rests[first].tip

    def noise(self, first: int, last: int) -> float:
        """Return the standard deviation (mm) of a coordinate of the motion between two rests."""
        return float(np.hypot(self.rests[first].sd, self.rests[last].sd).max())

    def least_seen(self, first: int, last: int) -> float:
        """Return the motion of the tip (mm) between two rests from which it is more than noise."""
        return _SDS * math.sqrt(3.0) * self.noise(first, last)

    @property
    def runs_away(self) -> bool:
        """Whether the axis moved much further than commanded until its second rest."""
        travel, turned = abs(self.travel(0, 1)), self.rests[1].turned_since(self.rests[0])
        if self.plan.move.axis.unit == "deg":
            return abs(turned or 0.0) > MOST_SCALE * travel + math.radians(_SEEN_DEG)
        most = MOST_SCALE * self.plan.gain * travel
        return float(np.linalg.norm(self.moved(0, 1))) > most + self.least_seen(0, 1)


def measure_rest(operator: Operator, seconds: float) -> Rest:
    """Return the rig at rest, measured for a time (s). Raises RunError if the tip is not measured."""
    operator.read()
    operator.wait(seconds)
    return _rest_of(dict(operator.positions), operator.read(), seconds)


def _rest_of(positions: Mapping[str, float], found: Sequence[Measurement], seconds: float) -> Rest:
    tips = np.array([row for row in map(tip_row, found) if row is not None])
    if len(tips) < _LEAST_READINGS:
        raise RunError(
            f"tip: measured in {len(tips)} frames of {seconds:g} s: must be {_LEAST_READINGS} or more"
        )
    spread = tips.std(axis=0, ddof=1) + 1e-4
    turns = [
        reading.orientation
        for one in found
        if one.frame is not None
        and (reading := one.frame.readings.get(TIP)) is not None
        and reading.orientation
    ]
    return Rest(
        positions,
        tips.mean(axis=0),
        spread / math.sqrt(len(tips)),
        spread,
        len(tips) / seconds,
        _mean_turn(np.array(turns)) if turns else None,
    )


def tip_row(one: Measurement) -> tuple[float, float, float] | None:
    """Return the position (mm) of a reading, z = 0 in the plane; None if it is not measured."""
    x, y, z = one.x, one.y, 0.0 if one.z is None else one.z
    return None if x is None or y is None or not all(map(math.isfinite, (x, y, z))) else (x, y, z)


def _mean_turn(turns: Floats) -> Floats:
    same = np.where(turns @ turns[0] < 0.0, -1.0, 1.0)  # q and −q are the same rotation
    mean: Floats = (same[:, None] * turns).mean(axis=0)
    return mean / np.linalg.norm(mean)


def plan_axis_test(
    rig: RigFile, positions: Mapping[str, float], rest: Rest, responses: Mapping[str, Floats]
) -> list[AxisPlan]:
    """Return the motions of all axes from their positions (mm or rad), in the order of the file.

    The travel and the time at rest follow from the noise of the tracker. Raises InputError for an axis without room.
    """
    return [_plan_axis(rig, name, positions[name], rest, responses) for name, _ in rig.axes.items()]


def _plan_axis(
    rig: RigFile, name: str, position: float, rest: Rest, responses: Mapping[str, Floats]
) -> AxisPlan:
    axis = dict(rig.axes.items())[name]
    rests: tuple[float, ...] = (1.0,) if name == "insertion" else (0.5, 0.75, 1.0)
    gain = float(np.linalg.norm(responses[name])) if name in responses else 1.0
    if axis.unit == "deg":
        room = max(position - axis.limits[0], axis.limits[1] - position)
        wanted = min(_TURN_DEG * axis.size, max(room, _LEAST_TURN_DEG * axis.size))
        first, probe, rests, seconds = _FIRST_DEG * axis.size, _PROBE_DEG * axis.size, (0.5, 1.0), _LEAST_S
    else:
        noise = math.sqrt(2.0) * float(rest.spread.max()) / (SCALE_SD * gain * (1.0 - PROBE))
        wanted = min(max(_LEAST_MM, noise / math.sqrt(rest.rate * _LEAST_S)), _MOST_MM)
        first, probe = _FIRST * wanted, PROBE * wanted
        seconds = min(max(_LEAST_S, (noise / wanted) ** 2 / rest.rate), _MOST_S)
    low, high = axis.limits
    back, ahead = position - low, high - position
    sign = -1.0 if back >= wanted and (name == "insertion" or ahead < wanted) else 1.0  # away from the skin
    if (back if sign < 0.0 else ahead) < wanted:
        free = f"{axis.to_text(wanted)} {axis.unit} to a side are needed within range_{axis.unit}"
        raise InputError(
            f"{name}: at {axis.to_text(position)} {axis.unit}: {free}: "
            f"flexneedle rig jog {rig.source} {name} --to POSITION"
        )
    move = plan_jog(rig, name, axis.to_text(sign * wanted), position)
    if move is None:
        raise InputError(f"{name}: no motion")
    return AxisPlan(
        move,
        gain,
        position + sign * min(first, _largest_probe(rig, name)),
        position + sign * min(probe, _largest_probe(rig, name)),
        rests,
        seconds,
        int(_ENOUGH * rest.rate * seconds),
    )


def _largest_probe(rig: RigFile, name: str) -> float:
    """Return the largest probe (mm or rad) of an axis: swapped with a linear axis, it must not move that one far."""
    axes = dict(rig.axes.items())
    others = (abs(axis.scale) for other, axis in axes.items() if other != name and axis.unit == "mm")
    return _MOST_MM * min(others, default=math.inf) / abs(axes[name].scale)


def run_axis_tests(
    operator: Operator, plans: Sequence[AxisPlan], share_of: Callable[[AxisRun], float], runs: list[AxisRun]
) -> None:
    """Test the axes one after another, and append their motions to `runs`.

    share_of: as for `run_axis_test`. Raises DriverError after a fault, with the axis that did not come back.
    """
    for plan in plans:
        try:
            runs.append(run_axis_test(operator, plan, share_of))
        except DriverError as error:
            move = plan.move
            key, back = (
                f"axes.{move.name}.counts_per_{move.axis.unit}",
                f"flexneedle rig jog {operator.rig.source} {move.name} --to POSITION",
            )
            where = f"{move.name} was tested from {move.axis.to_text(move.start)} {move.axis.unit}"
            raise DriverError(
                f"{error}; {where}, and is not back: check {key}, direction, channel and home; {back}"
            ) from error


def run_axis_test(operator: Operator, plan: AxisPlan, share_of: Callable[[AxisRun], float]) -> AxisRun:
    """Move one axis a little, to the probe, on towards its goal and back to its start.

    It goes back at once if it runs away. share_of: returns the share of the way to the goal after the probe, 0 to go
    back from there.
    """
    move, rests, found = plan.move, list[Rest](), list[Measurement]()

    def rest() -> None:
        operator.wait(_SETTLE_S)
        found.extend(operator.read())  # late readings of the motion
        begun, new = operator.now(), list[Measurement]()
        for _ in range(_MOST_WAITS):  # a busy computer may have a part of the readings only later
            operator.wait(plan.seconds)
            new += [one for one in operator.read() if one.time >= begun]
            if len(new) >= plan.readings:
                break
        found.extend(new)
        rests.append(_rest_of(dict(operator.positions), new, plan.seconds))

    def run_so_far() -> AxisRun:
        return AxisRun(plan, tuple(rests), np.zeros(0), np.zeros((0, 3)))

    operator.read()
    rest()
    operator.move_to(move.name, plan.first, move.speed)
    rest()
    share = 0.0
    if not run_so_far().runs_away:
        rests.pop()
        operator.move_to(move.name, plan.probe, move.speed)
        rest()
        share = share_of(run_so_far())
    for part in plan.rests if share > 0.0 else ():
        operator.move_to(move.name, move.start + part * share * move.distance, move.speed)
        rest()
    operator.move_to(move.name, move.start, move.speed)
    rest()
    rows = [(one.time, *row) for one in found if (row := tip_row(one)) is not None]
    table = np.array(sorted(rows))
    return AxisRun(plan, tuple(rests), table[:, 0], table[:, 1:])
