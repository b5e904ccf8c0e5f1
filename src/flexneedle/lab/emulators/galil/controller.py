"""The emulated Galil DMC-4143: its reply to a line in a state. Pure functions, without I/O or time.

It has the commands that drive axes A to D: motor on and off, speeds, relative and absolute moves, position tracking,
jog, stop, abort, limits, and queries of positions, errors and reasons. A command is two capital letters, axes and
values as `PRA=100`, `PR 100,,50` or `BGAC`; a line may have several with `;` between them. Each is answered by its data
and `:`, or by `?`, after which `TC1` reports why. Facts are those of Galil's Command Reference for the DMC-4103, the
series of the DMC-4143; it was not compared with a controller.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from flexneedle.lab.emulators.galil import axis as one
from flexneedle.lab.emulators.galil.axis import Axis
from flexneedle.lab.emulators.galil.profile import SAMPLE_S, stopped

AXES = "ABCD"
REVISION = "DMC4143 Rev 1.3d"
SAMPLES_HZ = round(1.0 / SAMPLE_S)

ERRORS = {
    1: "Unrecognized command",
    4: "Operand error",
    6: "Number out of range",
    7: "Command not valid while running",
    13: "JG only valid when running in jog mode",
    20: "Begin not valid with motor off",
    21: "Begin not valid while running",
    22: "Begin not possible due to Limit Switch",
    50: "Not enough fields",
    51: "Question mark not valid",
}
"""Error codes that it may report, with their texts."""

_MOST = 2_147_483_647.0
_MOST_SPEED = 15_000_000.0  # of servo motors
_LEAST_ACCELERATION, _MOST_ACCELERATION = 1024.0, 1_073_740_800.0  # at 1000 samples a second (TM 1000)
_SPEED_STEP, _ACCELERATION_STEP = 2.0, 1024.0  # set values are rounded down to their multiples
_LONGEST_LINE = 80

_FORM = re.compile(r"(?P<name>[A-Z]{2})\s*(?P<rest>.*)")
_ASSIGNED = re.compile(r"(?P<axis>[A-D])\s*=\s*(?P<value>[^,]*)")
_OPERAND = re.compile(r"_(?P<name>[A-Z]{2})(?P<axis>[A-D])")
_GENERAL = {"_TM": 1000.0, "_CN0": -1.0, "_PF": 10.0, "_BV": float(len(AXES))}
"""Operands without an axis: sample time (µs), polarity of limit switches, format of positions, number of axes."""


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
    return replace(device, axes=tuple(_after(axis, samples) for axis in device.axes))


def _after(axis: Axis, samples: int) -> Axis:
    for _ in range(samples):
        if axis.idle:
            break
        axis = one.sampled(axis)
    return axis


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
    speed = _rounded_down(_within(abs(value), 0.0, _MOST_SPEED), _SPEED_STEP)
    return replace(axis, profile=replace(axis.profile, speed=speed))


def _rounded_down(value: float, step: float) -> float:
    return math.floor(value / step) * step


def _rate(value: float) -> float:
    return _rounded_down(_within(value, _LEAST_ACCELERATION, _MOST_ACCELERATION), _ACCELERATION_STEP)


def _acceleration(axis: Axis, value: float) -> Axis:
    return replace(axis, profile=replace(axis.profile, acceleration=_rate(value)))


def _deceleration(axis: Axis, value: float) -> Axis:
    """DC, which may change in a jog and after a stop, but not on the way to a position."""
    stopping = axis.profile.stopping
    if axis.running and axis.jog is None and not stopping and not axis.profile.at_rest:
        raise _RefusalError(7)
    rate = _rate(value)
    profile = replace(axis.profile, deceleration=rate) if axis.jog is not None or stopping else axis.profile
    return replace(axis, deceleration=rate, profile=profile)


def _relative(axis: Axis, value: float) -> Axis:
    _at_rest(axis)
    return replace(axis, relative=_counts(value), jog=None)


def _counts(value: float) -> float:
    return float(int(_within(value, -_MOST - 1.0, _MOST)))


def _absolute(axis: Axis, value: float) -> Axis:
    value = _counts(value)
    if axis.tracking:
        if axis.blocked(value - axis.profile.position) is not None:
            raise _RefusalError(22)
        return one.tracked(axis, value)
    _at_rest(axis)
    return replace(axis, absolute=value, relative=None, jog=None)


def _jogged(axis: Axis, value: float) -> Axis:
    value = math.copysign(_rounded_down(_within(abs(value), 0.0, _MOST_SPEED), _SPEED_STEP), value)
    if axis.running and axis.jog is not None:
        return replace(axis, jog=value, profile=replace(axis.profile, cruise=value))
    if axis.running:
        raise _RefusalError(13)
    return replace(axis, jog=value, relative=None)


def _position(axis: Axis, value: float) -> Axis:
    _at_rest(axis)
    return one.defined(axis, _counts(value))


def _track(axis: Axis, value: float) -> Axis:
    if value not in (0.0, 1.0):
        raise _RefusalError(6)
    if value == 0.0:
        return one.slowed(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)
    if not axis.servo:
        raise _RefusalError(20)
    if axis.tracking:
        return axis
    if axis.jog is not None and axis.running:
        return replace(axis, tracking=True, jog=None, profile=stopped(axis.profile))
    goal = axis.profile.goal if axis.running else axis.profile.position
    return replace(axis, tracking=True, jog=None, relative=None, absolute=goal or 0.0)


def _whole(value: float, least: float, most: float) -> float:
    if value != int(value):
        raise _RefusalError(6)
    return _within(value, least, most)


_SETTINGS: dict[str, tuple[Callable[[Axis], float], Callable[[Axis, float], Axis]]] = {
    "SP": (lambda axis: axis.profile.speed, _speed),
    "AC": (lambda axis: axis.profile.acceleration, _acceleration),
    "DC": (lambda axis: axis.deceleration, _deceleration),
    "SD": (
        lambda axis: axis.limit_deceleration,
        lambda axis, value: replace(axis, limit_deceleration=_rate(value)),
    ),
    "PR": (lambda axis: axis.goal - axis.profile.position, _relative),
    "PA": (lambda axis: axis.rested, _absolute),
    "JG": (lambda axis: axis.jog or 0.0, _jogged),
    "DP": (lambda axis: axis.encoder, _position),
    "PT": (lambda axis: float(axis.tracking), _track),
    "FL": (lambda axis: axis.forward, lambda axis, value: replace(axis, forward=_counts(value))),
    "BL": (lambda axis: axis.reverse, lambda axis, value: replace(axis, reverse=_counts(value))),
    "LD": (
        lambda axis: float(axis.disabled),
        lambda axis, value: replace(axis, disabled=int(_whole(value, 0.0, 3.0))),
    ),
    "ER": (
        lambda axis: axis.error_limit,
        lambda axis, value: replace(axis, error_limit=_whole(value, -1.0, _MOST)),
    ),
    "OE": (
        lambda axis: float(axis.off_on_error),
        lambda axis, value: replace(axis, off_on_error=int(_whole(value, 0.0, 3.0))),
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


def _motor_on(axis: Axis) -> Axis:
    _at_rest(axis)
    return one.on(axis)


_ACTIONS: dict[str, Callable[[Axis], Axis]] = {
    "SH": _motor_on,
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
_OPERANDS: dict[str, Callable[[Axis], float]] = {
    **_REPORTED,
    **{name: reported for name, (reported, _) in _SETTINGS.items()},
    "BG": lambda axis: float(axis.running),
    "MO": lambda axis: float(not axis.servo),
    "LF": lambda axis: float(not axis.at_switches[1]),
    "LR": lambda axis: float(not axis.at_switches[0]),
    "MT": lambda _: 1.0,
}


def _report_code(device: Device, rest: str) -> tuple[Device, str]:
    if rest not in ("", "0", "1", "?"):
        raise _RefusalError(4)
    text = f"{device.error} {ERRORS.get(device.error, '')}".strip() if rest == "1" else str(device.error)
    return replace(device, error=0), _line(text)


def _message(device: Device, rest: str) -> tuple[Device, str]:
    values = (_operand(device, text.strip()) for text in rest.split(","))
    return device, _line(" ".join(f"{value:.4f}" for value in values))


def _operand(device: Device, text: str) -> float:
    if text in _GENERAL:
        return _GENERAL[text]
    operand = _OPERAND.fullmatch(text)
    if operand is None or operand["name"] not in _OPERANDS:
        raise _RefusalError(1)
    return _OPERANDS[operand["name"]](device.axes[AXES.index(operand["axis"])])


def _abort(device: Device, rest: str) -> tuple[Device, str]:
    if rest not in ("", "0", "1"):  # 1: not the programs, of which it has none
        raise _RefusalError(6)
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
