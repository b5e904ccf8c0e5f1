"""Motions that an operator commands, outside of an insertion, and their descriptions. Pure functions."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

from flexneedle.arguments import shorten as text_of
from flexneedle.errors import InputError, RefusedError
from flexneedle.lab.rig.preflight.speeds import attained_speed
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.checks import STILL
from flexneedle.lab.rig.supervisor.drives import homing_reach, homing_speed, position_after_homing
from flexneedle.scenario.model import Scenario

_SHARE = 0.2  # speed of a jog or a retraction as a share of the axis's largest, unless one is given

_ROUNDING = 1e-9
_DISTANCE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z°]*)")


@dataclass(frozen=True)
class AxisMove:
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
        at, unit = self.axis.to_text, self.axis.unit
        way = f"from {at(self.start)} to {at(self.goal)} {unit} ({at(self.distance)} {unit})"
        slack = f"; the start is {describe_uncertainty(self.axis)}" if self.axis.backlash else ""
        return f"{self.name}: {way}, at most at {at(self.speed)} {unit}/s{slack}"


def require_start(move: AxisMove, position: float) -> None:
    """Raise RefusedError if an axis has left the start of its motion, or is beyond its goal (position: mm, rad)."""
    axis, turns = move.axis, (move.goal - position) * move.distance <= 0.0
    if turns or not abs(position - move.start) <= STILL * axis.tolerance:
        now, then = (_with_unit(axis, at) for at in (position, move.start))
        raise RefusedError(f"{move.name}: is at {now}, no longer at {then}: nothing was moved; try again")


@dataclass(frozen=True)
class AxisHoming:
    """Search of the home of one axis."""

    name: str
    axis: Axis

    def __str__(self) -> str:
        axis = self.axis
        home = _with_unit(axis, axis.at_home)
        if axis.to_home == 0:
            return f"{self.name}: does not move; its position is set to {home}"
        reach, back = homing_reach(axis), position_after_homing(axis) - axis.at_home
        speed = f"at {_with_unit(axis, homing_speed(axis))}/s"
        search = f"in its {_name_direction(reach)} direction to the {_name_switch(axis)}"
        there = f"by at most {_with_unit(axis, abs(reach))} {speed}; the position there is set to {home}"
        off = f"in its {_name_direction(back)} direction by {_with_unit(axis, abs(back))} {speed}"
        to = f"off the switch to {_with_unit(axis, position_after_homing(axis))}"
        return f"{self.name}: {search}, {there}; then {off}, {to}. If the switch is active now, first {off}"


def _name_direction(travel: float) -> str:
    return "positive" if travel > 0.0 else "negative"


def _name_switch(axis: Axis) -> str:
    return f"{axis.home.replace('-', ' ')} switch"


def _with_unit(axis: Axis, value: float) -> str:
    return f"{axis.to_text(value)} {axis.unit}"


def describe_uncertainty(axis: Axis) -> str:
    """Return the uncertainty of the position of an axis with backlash before its first motion, in words."""
    return f"uncertain by {_with_unit(axis, 0.5 * axis.backlash)} (half of backlash_{axis.unit})"


def describe_axes(rig: RigFile, positions: Mapping[str, float]) -> list[str]:
    """Return one line for each axis: its position (mm or rad, by name), and the largest speed that it attains."""
    return [
        f"{name}: at {_with_unit(axis, positions[name])}, moves at most at {_describe_speed(rig, axis)}"
        + (f"; the start is {describe_uncertainty(axis)}" if axis.backlash else "")
        for name, axis in rig.axes.items()
    ]


def _describe_speed(rig: RigFile, axis: Axis) -> str:
    speed = f"{attained_speed(axis, rig.loop, axis.speed) / axis.size:.3g}"
    return f"{float(speed):g} {axis.unit}/s"  # no exponent


def describe_insertion(rig: RigFile, scenario: Scenario, positions: Mapping[str, float]) -> list[str]:
    """Return a line for the needle, and one for each axis with its position (mm or rad) and its speed."""
    depth, *lateral = scenario.target.position[: 1 + scenario.setup.axes]
    to = f"{depth:g} mm deep, {', '.join(f'{value:g}' for value in lateral)} mm to the side"
    first = f"{rig.name}: the needle will be inserted from its present position to a target {to}."
    return [first, *describe_axes(rig, positions)]


def describe_power_off(rig: RigFile, positions: Mapping[str, float]) -> list[str]:
    """Return one line for each axis whose motor is switched off, with its position (mm or rad, by name)."""
    return [
        f"{name}: at {axis.to_text(positions[name])} {axis.unit}, its motor will be switched off"
        for name, axis in rig.axes.items()
    ]


def find_axis(rig: RigFile, name: str) -> Axis:
    """Return an axis by its name. Raises InputError, with the axes of the rig, for another name."""
    axes = dict(rig.axes.items())
    if name not in axes:
        raise InputError(f"axis {text_of(name)}: must be one of {', '.join(axes)}")
    return axes[name]


def parse_distance(text: str, name: str, axis: Axis, what: str = "distance") -> float:
    """Return the distance (mm or rad) of a text such as "5", "-2.5mm" or "90deg". Raises InputError, for `what`."""
    found = _DISTANCE.fullmatch(text.strip())
    units = (axis.unit, "°") if axis.unit == "deg" else (axis.unit,)
    if found is None or not isfinite(float(found[1])):
        raise InputError(f"{what} {text_of(text)}: must be a number, such as 5 or -5{axis.unit}")
    if found[2] not in ("", *units):
        raise InputError(f"{what} {text_of(text)}: the unit of {name} is {axis.unit}")
    return float(found[1]) * axis.size


def plan_jog(
    rig: RigFile, name: str, text: str, position: float, speed: float | None = None, *, to: bool = False
) -> AxisMove | None:
    """Return the motion of one axis by a distance from its position (mm or rad), or to a position; None if it is there.

    text: the distance, or with `to` the position, such as "-2.5mm"; speed: in the unit of the axis, per s. Raises
    InputError for another axis or unit, no distance, a goal beyond the soft limits, a speed above the axis's.
    """
    axis = find_axis(rig, name)
    given = parse_distance(text, name, axis, "position" if to else "distance")
    move = _check_move(
        AxisMove(name, axis, position, given if to else position + given, _parse_speed(name, axis, speed))
    )
    # Counts that are no steps of an encoder, such as m, have a finer resolution.
    if abs(move.distance) >= min(1.0 / abs(axis.scale), axis.tolerance):
        return move
    if not to:
        raise InputError(f"distance {text_of(text)}: must be at least one count of {name}")
    return None


def withdrawn_position(rig: RigFile) -> float:
    """Return the end of a retraction (mm): off a home switch behind the base, otherwise the lowest position."""
    axis = rig.axes.insertion
    return position_after_homing(axis) if axis.to_home < 0 else axis.limits[0]


def describe_withdrawn(rig: RigFile, position: float) -> str:
    """Return why there is nothing to retract from a position (mm)."""
    at, end = map(rig.axes.insertion.to_text, (position, withdrawn_position(rig)))
    found = f"insertion is at {at} mm, a retraction ends at {end} mm: nothing to retract"
    lost = "if the needle is in tissue, the position is wrong, as after a restart of the controller"
    return f"{found}; {lost}: withdraw it by hand, then flexneedle rig home {rig.source}"


def plan_retraction(
    rig: RigFile, position: float, to_mm: float | None = None, speed: float | None = None
) -> AxisMove | None:
    """Return the motion of the base back to `to_mm` (default: withdrawn position); None if the base is there.

    speed: mm/s. Raises InputError if that is not backwards, beyond the soft limits or at the limit switch of the home,
    or for a speed above the axis's.
    """
    axis = rig.axes.insertion
    if to_mm is None and position - withdrawn_position(rig) < 1.0 / abs(axis.scale):
        return None
    goal = withdrawn_position(rig) if to_mm is None else to_mm
    move = _check_move(AxisMove("insertion", axis, position, goal, _parse_speed("insertion", axis, speed)))
    _check_switch(axis, goal)
    if move.distance > -1.0 / abs(axis.scale):
        at = axis.to_text(position)
        raise InputError(
            f"to {axis.to_text(goal)} mm: must be below {at} mm, the present position: the axis only retracts"
        )
    return move


def _check_switch(axis: Axis, goal: float) -> None:
    """Raise InputError for a goal (mm) at which an axis may be at the limit switch behind it, its home."""
    least = axis.at_home + axis.max_error
    if axis.to_home < 0 and goal < least - _ROUNDING:
        at = axis.to_text
        why = (
            f"the {_name_switch(axis)} is at {at(axis.at_home)} mm, and max_error_mm is {at(axis.max_error)}"
        )
        raise InputError(f"to {at(goal)} mm: must be at least {at(least)} mm: {why}")


def plan_homings(rig: RigFile, names: Iterable[str]) -> list[AxisHoming]:
    """Return the searches of homes, in the order of the file, the insertion first (default: all axes that need it).

    Raises InputError for another axis, or one with an absolute encoder.
    """
    chosen = list(names)
    for name in chosen:
        if find_axis(rig, name).home == "absolute":
            raise InputError(f'axis {name}: has home = "absolute": its encoder needs no homing')
    wanted = [AxisHoming(name, axis) for name, axis in rig.axes.items() if name in chosen or not chosen]
    return [homing for homing in wanted if homing.axis.home != "absolute"]


def _parse_speed(name: str, axis: Axis, given: float | None) -> float:
    if given is None:
        return _SHARE * axis.speed
    speed = given * axis.size
    if not 0.0 < speed <= axis.speed * (1.0 + _ROUNDING):
        rule = f"must be above 0 and at most {axis.to_text(axis.speed)}, speed_{axis.unit}_s of {name}"
        raise InputError(f"speed {given:g}: {rule}")
    return speed


def _check_move(move: AxisMove) -> AxisMove:
    """Return the motion. Raises InputError if it leaves the soft limits; from beyond them it may return."""
    axis, (low, high) = move.axis, move.axis.limits
    if not (isfinite(move.start) and isfinite(move.goal)):
        raise InputError(f"{move.name}: its position is not a number")
    if not min(low, move.start) - _ROUNDING <= move.goal <= max(high, move.start) + _ROUNDING:
        limits = f"{axis.to_text(low)} to {axis.to_text(high)} {axis.unit}"
        rule = f"beyond the soft limits, {limits}; it is at {axis.to_text(move.start)} {axis.unit}"
        raise InputError(f"{move.name} to {axis.to_text(move.goal)} {axis.unit}: {rule}")
    return move
