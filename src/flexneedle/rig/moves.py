"""Motions that an operator commands, outside of an insertion: what would move, from where to where. Pure functions."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

from flexneedle.arguments import shown as text_of
from flexneedle.errors import InputError
from flexneedle.scenario.rig import Axis, RigFile

JOG_SHARE = 0.2
"""Speed of a jog as a share of the axis's largest (default)."""

_ROUNDING = 1e-9
_DISTANCE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z°]*)")


@dataclass(frozen=True)
class Move:
    """A motion of one axis from `start` to `goal` (mm or rad), at most at `speed` (mm/s or rad/s)."""

    name: str
    axis: Axis
    start: float
    goal: float
    speed: float

    @property
    def distance(self) -> float:
        """Distance with its sign, mm or rad."""
        return self.goal - self.start

    def __str__(self) -> str:
        at, unit = self.axis.shown, self.axis.unit
        return f"{self.name}: from {at(self.start)} to {at(self.goal)} {unit}, at most at {at(self.speed)} {unit}/s"


@dataclass(frozen=True)
class Homing:
    """Finding the home of one axis."""

    name: str
    axis: Axis

    def __str__(self) -> str:
        axis, at = self.axis, f"{self.axis.shown(self.axis.at_home)} {self.axis.unit}"
        if axis.to_home == 0:
            return f"{self.name}: stays where it is, and its position is called {at}"
        way = "positive" if axis.to_home > 0 else "negative"
        switch = f"in its {way} direction to the {axis.home.replace('-', ' ')} switch"
        most = f"at most at {axis.shown(axis.speed)} {axis.unit}/s"
        return f"{self.name}: {switch}, {most}; the position there is called {at}"


def resting(rig: RigFile, positions: Mapping[str, float]) -> list[str]:
    """Return one line for each axis: where it is (mm or rad, by name), and how fast it moves at most."""
    return [
        f"{name}: at {axis.shown(positions[name])} {axis.unit}, moves at most at {axis.shown(axis.speed)} {axis.unit}/s"
        for name, axis in rig.axes.items()
    ]


def switched_off(rig: RigFile, positions: Mapping[str, float]) -> list[str]:
    """Return one line for each axis whose motor is switched off: where it is (mm or rad, by name)."""
    return [
        f"{name}: at {axis.shown(positions[name])} {axis.unit}, its motor will be switched off"
        for name, axis in rig.axes.items()
    ]


def axis_of(rig: RigFile, name: str) -> Axis:
    """Return an axis by its name. Raises InputError, with the axes of the rig, for another name."""
    axes = dict(rig.axes.items())
    if name not in axes:
        raise InputError(f"axis {text_of(name)}: must be one of {', '.join(axes)}")
    return axes[name]


def distance_of(text: str, name: str, axis: Axis) -> float:
    """Return the distance (mm or rad) of a text such as "5", "-2.5mm" or "90deg". Raises InputError."""
    found = _DISTANCE.fullmatch(text.strip())
    units = (axis.unit, "°") if axis.unit == "deg" else (axis.unit,)
    if found is None or not isfinite(float(found[1])):
        raise InputError(f"distance {text_of(text)}: must be a number, such as 5 or -5{axis.unit}")
    if found[2] not in ("", *units):
        raise InputError(f"distance {text_of(text)}: the unit of {name} is {axis.unit}")
    return float(found[1]) * axis.size


def jog(rig: RigFile, name: str, distance: str, position: float, speed: float | None = None) -> Move:
    """Return the motion of one axis by a distance from its position (mm or rad). speed: in the unit of the axis, per s.

    Raises InputError for another axis or unit, no distance, a goal beyond the soft limits, a speed above the axis's.
    """
    axis = axis_of(rig, name)
    move = _checked(
        Move(name, axis, position, position + distance_of(distance, name, axis), _speed(name, axis, speed))
    )
    # A driver whose counts are no steps of an encoder, such as m, has a finer resolution.
    if abs(move.distance) < min(1.0 / abs(axis.scale), axis.tolerance):
        raise InputError(f"distance {text_of(distance)}: must be at least one count of {name}")
    return move


def retraction(rig: RigFile, position: float, to_mm: float | None = None) -> Move | None:
    """Return the motion of the base back to `to_mm`; without it to the lowest position, None if it is there.

    Raises InputError if that is not backwards or beyond the soft limits.
    """
    axis = rig.axes.insertion
    if to_mm is None and position - axis.limits[0] < 1.0 / abs(axis.scale):
        return None
    goal = axis.limits[0] if to_mm is None else to_mm
    move = _checked(Move("insertion", axis, position, goal, axis.speed))
    if move.distance > -1.0 / abs(axis.scale):
        at = axis.shown(position)
        raise InputError(
            f"to {axis.shown(goal)} mm: must be below {at} mm, where the insertion axis is: it only retracts"
        )
    return move


def homings(rig: RigFile, names: Iterable[str]) -> list[Homing]:
    """Return how axes find their homes, in the order of the file, the insertion first; all that need it, without names.

    Raises InputError for another axis, or one with an absolute encoder.
    """
    chosen = list(names)
    for name in chosen:
        if axis_of(rig, name).home == "absolute":
            raise InputError(f'axis {name}: has home = "absolute": its encoder needs no homing')
    wanted = [Homing(name, axis) for name, axis in rig.axes.items() if name in chosen or not chosen]
    return [homing for homing in wanted if homing.axis.home != "absolute"]


def _speed(name: str, axis: Axis, given: float | None) -> float:
    if given is None:
        return JOG_SHARE * axis.speed
    speed = given * axis.size
    if not 0.0 < speed <= axis.speed * (1.0 + _ROUNDING):
        rule = f"must be above 0 and at most {axis.shown(axis.speed)}, speed_{axis.unit}_s of {name}"
        raise InputError(f"speed {given:g}: {rule}")
    return speed


def _checked(move: Move) -> Move:
    """The move. Raises InputError if it leaves the soft limits; from beyond them it may return."""
    axis, (low, high) = move.axis, move.axis.limits
    if not (isfinite(move.start) and isfinite(move.goal)):
        raise InputError(f"{move.name}: its position is not a number")
    if not min(low, move.start) - _ROUNDING <= move.goal <= max(high, move.start) + _ROUNDING:
        limits = f"{axis.shown(low)} to {axis.shown(high)} {axis.unit}"
        rule = f"beyond the soft limits, {limits}; it is at {axis.shown(move.start)} {axis.unit}"
        raise InputError(f"{move.name} to {axis.shown(move.goal)} {axis.unit}: {rule}")
    return move
