"""The emulated Galil DMC-4143: its reply to a line in a state. Pure functions, without I/O or time.

It has the commands that drive axes A to D: motor on and off, speeds, relative and absolute moves, position tracking,
jog, stop, abort, limits, and queries of positions, errors and reasons. A command is two capital letters, axes and
values as `PRA=100`, `PR 100,,50` or `BGAC`; a line may have several with `;` between them. Each is answered by its data
and `:`, or by `?`, after which `TC1` reports why. Facts are those of the maker's published command reference; it
was not compared with a controller.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from flexneedle.rig.emulator.galil import axis as one
from flexneedle.rig.emulator.galil.axis import Axis
from flexneedle.rig.emulator.galil.profile import SAMPLE_S

AXES = "ABCD"
REVISION = "DMC4143 Rev 1.3d"
SAMPLES_HZ = round(1.0 / SAMPLE_S)

_ERRORS = {
    0: "",
    1: "Unrecognized command",
    4: "Operand error",
    6: "Number out of range",
    7: "Command not valid while running",
    20: "Begin not valid with motor off",
    21: "Begin not valid while running",
    22: "Begin not possible due to limit switch",
    50: "Not enough fields",
    51: "Question mark not valid",
}
_MOST = 2_147_483_647.0
_MOST_SPEED = 22_000_000.0
_MOST_ACCELERATION = 1_073_740_800.0
_LONGEST_LINE = 80

_FORM = re.compile(r"(?P<name>[A-Z]{2})\s*(?P<rest>.*)")
_ASSIGNED = re.compile(r"(?P<axis>[A-D])\s*=\s*(?P<value>[^,]*)")
_OPERAND = re.compile(r"_(?P<name>[A-Z]{2})(?P<axis>[A-D])")


@dataclass(frozen=True)
class Device:
    """The state of the controller: its axes and the code of the last error."""

    axes: tuple[Axis, ...] = (Axis(),) * len(AXES)
    error: int = 0


class _RefusalError(Exception):
    """A command that is answered by `?`, with its code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def advanced(device: Device, samples: int = 1) -> Device:
    """The controller after a number of its samples, 1 ms each."""
    for _ in range(samples):
        device = replace(device, axes=tuple(one.sampled(axis) for axis in device.axes))
    return device


def reply(device: Device, line: str) -> tuple[Device, str]:
    """Return the state after a line, without its end, and the complete reply."""
    parts = []
    for command in line[:_LONGEST_LINE].split(";"):
        try:
            device, data = _executed(device, command.strip())
        except _RefusalError as refusal:
            device, data = replace(device, error=refusal.code), None
        parts.append("?" if data is None else f"{data}:")
    return device, "".join(parts)


def _executed(device: Device, command: str) -> tuple[Device, str]:
    if not command:
        return device, ""
    if command == "\x12\x16":
        return device, _line(REVISION)
    form = _FORM.fullmatch(command)
    if form is None:
        raise _RefusalError(1)
    name, rest = form["name"], form["rest"].strip()
    if name in _WHOLE:
        return _WHOLE[name](device, rest)
    if name in _ACTIONS:
        return _acted(device, name, rest), ""
    if name in _REPORTED:
        which = _listed(rest)
        return device, _line(", ".join(_number(_REPORTED[name](device.axes[k])) for k in which))
    if name in _SETTINGS:
        return _set(device, name, rest)
    raise _RefusalError(1)


def _line(text: str) -> str:
    return f" {text}\r\n" if text else ""


def _number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else f"{value:.4f}"


def _listed(rest: str) -> list[int]:
    """The axes that a command names; all of them if none."""
    if not all(letter in AXES for letter in rest):
        raise _RefusalError(4)
    return [AXES.index(letter) for letter in rest] or list(range(len(AXES)))


def _value(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise _RefusalError(4) from None
    if not math.isfinite(value):
        raise _RefusalError(4)
    return value


def _with(device: Device, changed: Mapping[int, Axis]) -> Device:
    return replace(device, axes=tuple(changed.get(k, axis) for k, axis in enumerate(device.axes)))


# Settings: NAME A=value, or NAME value,value; `?` in place of a value asks for it


def _set(device: Device, name: str, rest: str) -> tuple[Device, str]:
    assigned = _ASSIGNED.fullmatch(rest)
    if assigned:
        fields = {AXES.index(assigned["axis"]): assigned["value"].strip()}
    else:
        fields = {k: text.strip() for k, text in enumerate(rest.split(",")) if text.strip()}
    if not fields or max(fields) >= len(AXES):
        raise _RefusalError(50 if not fields else 4)
    reported, change = _SETTINGS[name]
    if any(text == "?" for text in fields.values()):
        if not all(text == "?" for text in fields.values()):
            raise _RefusalError(51)
        return device, _line(", ".join(_number(reported(device.axes[k])) for k in sorted(fields)))
    # All values are checked before one is set.
    return _with(device, {k: change(device.axes[k], _value(text)) for k, text in fields.items()}), ""


def _within(value: float, least: float, most: float) -> float:
    if not least <= value <= most:
        raise _RefusalError(6)
    return value


def _at_rest(axis: Axis) -> None:
    if axis.running:
        raise _RefusalError(7)


def _speed(axis: Axis, value: float) -> Axis:
    return replace(axis, profile=replace(axis.profile, speed=_within(value, 0.0, _MOST_SPEED)))


def _acceleration(axis: Axis, value: float) -> Axis:
    return replace(
        axis, profile=replace(axis.profile, acceleration=_within(value, 1024.0, _MOST_ACCELERATION))
    )


def _deceleration(axis: Axis, value: float) -> Axis:
    return replace(
        axis, profile=replace(axis.profile, deceleration=_within(value, 1024.0, _MOST_ACCELERATION))
    )


def _relative(axis: Axis, value: float) -> Axis:
    _at_rest(axis)
    return replace(axis, relative=_within(value, -_MOST, _MOST), jog=None)


def _absolute(axis: Axis, value: float) -> Axis:
    value = _within(value, -_MOST, _MOST)
    if axis.tracking:
        if axis.blocked(value - axis.profile.position) is not None:
            raise _RefusalError(22)
        return one.tracked(axis, value)
    _at_rest(axis)
    return replace(axis, absolute=value, relative=None, jog=None)


def _jogged(axis: Axis, value: float) -> Axis:
    value = _within(value, -_MOST_SPEED, _MOST_SPEED)
    if axis.running and axis.jog is not None:
        return replace(axis, jog=value, profile=replace(axis.profile, cruise=value))
    _at_rest(axis)
    return replace(axis, jog=value, relative=None)


def _position(axis: Axis, value: float) -> Axis:
    _at_rest(axis)
    return one.defined(axis, _within(value, -_MOST, _MOST))


def _track(axis: Axis, value: float) -> Axis:
    if value not in (0.0, 1.0):
        raise _RefusalError(6)
    if value == 1.0:
        _at_rest(axis)
        if not axis.servo:
            raise _RefusalError(20)
        return replace(axis, tracking=True, jog=None, relative=None, absolute=axis.profile.position)
    return one.slowed(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)


_SETTINGS: dict[str, tuple[Callable[[Axis], float], Callable[[Axis, float], Axis]]] = {
    "SP": (lambda axis: axis.profile.speed, _speed),
    "AC": (lambda axis: axis.profile.acceleration, _acceleration),
    "DC": (lambda axis: axis.profile.deceleration, _deceleration),
    "PR": (lambda axis: axis.relative or 0.0, _relative),
    "PA": (lambda axis: axis.absolute, _absolute),
    "JG": (lambda axis: axis.jog or 0.0, _jogged),
    "DP": (lambda axis: axis.encoder, _position),
    "PT": (lambda axis: float(axis.tracking), _track),
    "FL": (
        lambda axis: axis.forward,
        lambda axis, value: replace(axis, forward=_within(value, -_MOST, _MOST)),
    ),
    "BL": (
        lambda axis: axis.reverse,
        lambda axis, value: replace(axis, reverse=_within(value, -_MOST - 1.0, _MOST)),
    ),
    "ER": (
        lambda axis: axis.error_limit,
        lambda axis, value: replace(axis, error_limit=_within(value, -1.0, _MOST)),
    ),
    "OE": (
        lambda axis: float(axis.off_on_error),
        lambda axis, value: replace(axis, off_on_error=_within(value, 0.0, 3.0) > 0.0),
    ),
}


# Actions: NAMEABC, or NAME for all axes


def _acted(device: Device, name: str, rest: str) -> Device:
    return _with(device, {k: _ACTIONS[name](device.axes[k]) for k in _listed(rest)})


def _begin(axis: Axis) -> Axis:
    if not axis.servo:
        raise _RefusalError(20)
    if axis.running:
        raise _RefusalError(21)
    direction = axis.jog if axis.jog is not None else axis.goal - axis.profile.position
    if axis.blocked(direction) is not None:
        raise _RefusalError(22)
    return one.begun(axis)


def _motor_off(axis: Axis) -> Axis:
    _at_rest(axis)
    return one.off(axis)


def _stop(axis: Axis) -> Axis:
    return one.slowed(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)


_ACTIONS: dict[str, Callable[[Axis], Axis]] = {
    "SH": one.on,
    "MO": _motor_off,
    "BG": _begin,
    "ST": _stop,
}


# Queries


def _switches(axis: Axis) -> float:
    """Bits of TS: 7 in motion, 6 position error beyond its limit, 5 motor off, 3 and 2 forward and reverse limit not
    active."""
    reverse, forward = axis.at_switches
    bits = (
        (7, axis.running),
        (6, abs(axis.error) > axis.error_limit),
        (5, not axis.servo),
        (3, not forward),
        (2, not reverse),
    )
    return float(sum(1 << bit for bit, holds in bits if holds))


_REPORTED: dict[str, Callable[[Axis], float]] = {
    "TP": lambda axis: round(axis.encoder),
    "RP": lambda axis: round(axis.profile.position),
    "TE": lambda axis: round(axis.profile.position) - round(axis.encoder),
    "TV": lambda axis: round(axis.profile.velocity),
    "TS": _switches,
    "SC": lambda axis: axis.stop,
}
_OPERANDS: dict[str, Callable[[Axis], float]] = _REPORTED | {
    "BG": lambda axis: float(axis.running),
    "MO": lambda axis: float(not axis.servo),
    "LF": lambda axis: float(not axis.at_switches[1]),
    "LR": lambda axis: float(not axis.at_switches[0]),
}


def _report_code(device: Device, rest: str) -> tuple[Device, str]:
    if rest not in ("", "0", "1"):
        raise _RefusalError(4)
    text = f"{device.error} {_ERRORS[device.error]}".strip() if rest == "1" else str(device.error)
    return replace(device, error=0), _line(text)


def _message(device: Device, rest: str) -> tuple[Device, str]:
    values = []
    for text in rest.split(","):
        operand = _OPERAND.fullmatch(text.strip())
        if operand is None or operand["name"] not in _OPERANDS:
            raise _RefusalError(1)
        values.append(_OPERANDS[operand["name"]](device.axes[AXES.index(operand["axis"])]))
    return device, _line(" ".join(f"{value:.4f}" for value in values))


def _abort(device: Device, rest: str) -> tuple[Device, str]:
    if rest:
        raise _RefusalError(4)
    return replace(device, axes=tuple(one.aborted(axis) for axis in device.axes)), ""


def _echo(device: Device, rest: str) -> tuple[Device, str]:
    if rest not in ("0", "1"):
        raise _RefusalError(6)
    return device, ""


_WHOLE: dict[str, Callable[[Device, str], tuple[Device, str]]] = {
    "TC": _report_code,
    "MG": _message,
    "AB": _abort,
    "EO": _echo,
}
