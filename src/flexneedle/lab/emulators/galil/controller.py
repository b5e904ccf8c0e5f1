"""Replies of the emulated Galil DMC-4143 to lines, as a function of its state. Pure functions, without I/O or time.

It has the commands that drive axes A to D: motor on and off, speeds, relative and absolute moves, position tracking,
jog, stop, abort, limits, and queries of positions, errors and reasons. A command is two capital letters, axes and
values as `PRA=100`, `PR 100,,50` or `BGAC`; a line may have several with `;` between them. Each is answered by its data
and `:`, or by `?`, after which `TC1` reports why. Facts are from Galil's Command Reference for the DMC-4103, the
series of the DMC-4143; it was not compared with a controller.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from flexneedle.lab.emulators.galil import motor_axis as one
from flexneedle.lab.emulators.galil.motor_axis import MotorAxis
from flexneedle.lab.emulators.galil.profile import SAMPLE_S, slow_to_rest

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
class ControllerState:
    """The state of the controller: its axes and the code of the last error."""

    axes: tuple[MotorAxis, ...] = (MotorAxis(),) * len(AXES)
    error: int = 0


class _RefusalError(Exception):
    """A command that is answered by `?`, with its code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def advance_controller(device: ControllerState, samples: int = 1) -> ControllerState:
    """Return the controller after a number of its samples, 1 ms each."""
    return replace(device, axes=tuple(_advance_axis(axis, samples) for axis in device.axes))


def _advance_axis(axis: MotorAxis, samples: int) -> MotorAxis:
    for _ in range(samples):
        if axis.idle:
            break
        axis = one.advance_axis(axis)
    return axis


def reply(device: ControllerState, line: str) -> tuple[ControllerState, str]:
    """Return the state after a line, without its end, and the complete reply."""
    parts = []
    for command in line[:_LONGEST_LINE].split(";"):
        try:
            device, data = _execute(device, command.strip())
        except _RefusalError as refusal:
            device, data = replace(device, error=refusal.code), None
        parts.append("?" if data is None else f"{data}:")
    return device, "".join(parts)


def _execute(device: ControllerState, command: str) -> tuple[ControllerState, str]:
    if not command:
        return device, ""
    if command == "\x12\x16":
        return device, _format_line(REVISION)
    form = _FORM.fullmatch(command)
    if form is None:
        raise _RefusalError(1)
    name, rest = form["name"], form["rest"].strip()
    if name in _WHOLE:
        return _WHOLE[name](device, rest)
    if name in _ACTIONS:
        return _act(device, name, rest), ""
    if name in _REPORTED:
        which = _parse_axes(rest)
        return device, _format_line(", ".join(_format_number(_REPORTED[name](device.axes[k])) for k in which))
    if name in _SETTINGS:
        return _apply_setting(device, name, rest)
    raise _RefusalError(1)


def _format_line(text: str) -> str:
    return f" {text}\r\n" if text else ""


def _format_number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else f"{value:.4f}"


def _parse_axes(rest: str) -> list[int]:
    """Return the axes that a command names; all of them if none."""
    if not all(letter in AXES for letter in rest):
        raise _RefusalError(4)
    return [AXES.index(letter) for letter in rest] or list(range(len(AXES)))


def _parse_value(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise _RefusalError(4) from None
    if not math.isfinite(value):
        raise _RefusalError(4)
    return value


def _with_axes(device: ControllerState, changed: Mapping[int, MotorAxis]) -> ControllerState:
    return replace(device, axes=tuple(changed.get(k, axis) for k, axis in enumerate(device.axes)))


# Settings: NAME A=value, or NAME value,value; `?` in place of a value asks for it


def _apply_setting(device: ControllerState, name: str, rest: str) -> tuple[ControllerState, str]:
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
        return device, _format_line(
            ", ".join(_format_number(reported(device.axes[k])) for k in sorted(fields))
        )
    # All values are checked before one is set.
    return _with_axes(
        device, {k: change(device.axes[k], _parse_value(text)) for k, text in fields.items()}
    ), ""


def _require_within(value: float, least: float, most: float) -> float:
    if not least <= value <= most:
        raise _RefusalError(6)
    return value


def _require_rest(axis: MotorAxis) -> None:
    if axis.running:
        raise _RefusalError(7)


def _set_speed(axis: MotorAxis, value: float) -> MotorAxis:
    speed = _round_down(_require_within(abs(value), 0.0, _MOST_SPEED), _SPEED_STEP)
    return replace(axis, profile=replace(axis.profile, speed=speed))


def _round_down(value: float, step: float) -> float:
    return math.floor(value / step) * step


def _round_rate(value: float) -> float:
    return _round_down(_require_within(value, _LEAST_ACCELERATION, _MOST_ACCELERATION), _ACCELERATION_STEP)


def _set_acceleration(axis: MotorAxis, value: float) -> MotorAxis:
    return replace(axis, profile=replace(axis.profile, acceleration=_round_rate(value)))


def _set_deceleration(axis: MotorAxis, value: float) -> MotorAxis:
    """Set DC, which may change in a jog and after a stop, but not on the way to a position."""
    stopping = axis.profile.stopping
    if axis.running and axis.jog is None and not stopping and not axis.profile.at_rest:
        raise _RefusalError(7)
    rate = _round_rate(value)
    profile = replace(axis.profile, deceleration=rate) if axis.jog is not None or stopping else axis.profile
    return replace(axis, deceleration=rate, profile=profile)


def _set_relative(axis: MotorAxis, value: float) -> MotorAxis:
    _require_rest(axis)
    return replace(axis, relative=_round_counts(value), jog=None)


def _round_counts(value: float) -> float:
    return float(int(_require_within(value, -_MOST - 1.0, _MOST)))


def _set_absolute(axis: MotorAxis, value: float) -> MotorAxis:
    value = _round_counts(value)
    if axis.tracking:
        if axis.limit_in(value - axis.profile.position) is not None:
            raise _RefusalError(22)
        return one.follow_position(axis, value)
    _require_rest(axis)
    return replace(axis, absolute=value, relative=None, jog=None)


def _set_jog(axis: MotorAxis, value: float) -> MotorAxis:
    value = math.copysign(_round_down(_require_within(abs(value), 0.0, _MOST_SPEED), _SPEED_STEP), value)
    if axis.running and axis.jog is not None:
        return replace(axis, jog=value, profile=replace(axis.profile, cruise=value))
    if axis.running:
        raise _RefusalError(13)
    return replace(axis, jog=value, relative=None)


def _set_position(axis: MotorAxis, value: float) -> MotorAxis:
    _require_rest(axis)
    return one.define_position(axis, _round_counts(value))


def _set_tracking(axis: MotorAxis, value: float) -> MotorAxis:
    if value not in (0.0, 1.0):
        raise _RefusalError(6)
    if value == 0.0:
        return one.slow_down(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)
    if not axis.servo:
        raise _RefusalError(20)
    if axis.tracking:
        return axis
    if axis.jog is not None and axis.running:
        return replace(axis, tracking=True, jog=None, profile=slow_to_rest(axis.profile))
    goal = axis.profile.goal if axis.running else axis.profile.position
    return replace(axis, tracking=True, jog=None, relative=None, absolute=goal or 0.0)


def _require_whole(value: float, least: float, most: float) -> float:
    if value != int(value):
        raise _RefusalError(6)
    return _require_within(value, least, most)


_SETTINGS: dict[str, tuple[Callable[[MotorAxis], float], Callable[[MotorAxis, float], MotorAxis]]] = {
    "SP": (lambda axis: axis.profile.speed, _set_speed),
    "AC": (lambda axis: axis.profile.acceleration, _set_acceleration),
    "DC": (lambda axis: axis.deceleration, _set_deceleration),
    "SD": (
        lambda axis: axis.limit_deceleration,
        lambda axis, value: replace(axis, limit_deceleration=_round_rate(value)),
    ),
    "PR": (lambda axis: axis.goal - axis.profile.position, _set_relative),
    "PA": (lambda axis: axis.rested, _set_absolute),
    "JG": (lambda axis: axis.jog or 0.0, _set_jog),
    "DP": (lambda axis: axis.encoder, _set_position),
    "PT": (lambda axis: float(axis.tracking), _set_tracking),
    "FL": (lambda axis: axis.forward, lambda axis, value: replace(axis, forward=_round_counts(value))),
    "BL": (lambda axis: axis.reverse, lambda axis, value: replace(axis, reverse=_round_counts(value))),
    "LD": (
        lambda axis: float(axis.disabled),
        lambda axis, value: replace(axis, disabled=int(_require_whole(value, 0.0, 3.0))),
    ),
    "ER": (
        lambda axis: axis.error_limit,
        lambda axis, value: replace(axis, error_limit=_require_whole(value, -1.0, _MOST)),
    ),
    "OE": (
        lambda axis: float(axis.off_on_error),
        lambda axis, value: replace(axis, off_on_error=int(_require_whole(value, 0.0, 3.0))),
    ),
}


# Actions: NAMEABC, or NAME for all axes


def _act(device: ControllerState, name: str, rest: str) -> ControllerState:
    return _with_axes(device, {k: _ACTIONS[name](device.axes[k]) for k in _parse_axes(rest)})


def _begin(axis: MotorAxis) -> MotorAxis:
    if not axis.servo:
        raise _RefusalError(20)
    if axis.running:
        raise _RefusalError(21)
    direction = axis.jog if axis.jog is not None else axis.goal - axis.profile.position
    if axis.limit_in(direction) is not None:
        raise _RefusalError(22)
    return one.begin_motion(axis)


def _motor_off(axis: MotorAxis) -> MotorAxis:
    _require_rest(axis)
    return one.switch_off(axis)


def _stop(axis: MotorAxis) -> MotorAxis:
    return one.slow_down(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)


def _motor_on(axis: MotorAxis) -> MotorAxis:
    _require_rest(axis)
    return one.switch_on(axis)


_ACTIONS: dict[str, Callable[[MotorAxis], MotorAxis]] = {
    "SH": _motor_on,
    "MO": _motor_off,
    "BG": _begin,
    "ST": _stop,
}


# Queries


def _status_bits(axis: MotorAxis) -> float:
    """Return the bits of TS.

    7: in motion; 6: position error beyond its limit; 5: motor off; 3, 2: forward, reverse limit not active.
    """
    reverse, forward = axis.at_switches
    bits = (
        (7, axis.running),
        (6, abs(axis.error) > axis.error_limit),
        (5, not axis.servo),
        (3, not forward),
        (2, not reverse),
    )
    return float(sum(1 << bit for bit, holds in bits if holds))


_REPORTED: dict[str, Callable[[MotorAxis], float]] = {
    "TP": lambda axis: round(axis.encoder),
    "RP": lambda axis: round(axis.profile.position),
    "TE": lambda axis: round(axis.profile.position) - round(axis.encoder),
    "TV": lambda axis: round(axis.profile.velocity),
    "TS": _status_bits,
    "SC": lambda axis: axis.stop,
}
_OPERANDS: dict[str, Callable[[MotorAxis], float]] = {
    **_REPORTED,
    **{name: reported for name, (reported, _) in _SETTINGS.items()},
    "BG": lambda axis: float(axis.running),
    "MO": lambda axis: float(not axis.servo),
    "LF": lambda axis: float(not axis.at_switches[1]),
    "LR": lambda axis: float(not axis.at_switches[0]),
    "MT": lambda _: 1.0,
}


def _report_code(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("", "0", "1", "?"):
        raise _RefusalError(4)
    text = f"{device.error} {ERRORS.get(device.error, '')}".strip() if rest == "1" else str(device.error)
    return replace(device, error=0), _format_line(text)


def _report_values(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    values = (_value_of(device, text.strip()) for text in rest.split(","))
    return device, _format_line(" ".join(f"{value:.4f}" for value in values))


def _value_of(device: ControllerState, text: str) -> float:
    if text in _GENERAL:
        return _GENERAL[text]
    operand = _OPERAND.fullmatch(text)
    if operand is None or operand["name"] not in _OPERANDS:
        raise _RefusalError(1)
    return _OPERANDS[operand["name"]](device.axes[AXES.index(operand["axis"])])


def _abort(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("", "0", "1"):  # 1: not the programs, of which it has none
        raise _RefusalError(6)
    return replace(device, axes=tuple(one.abort_motion(axis) for axis in device.axes)), ""


def _echo(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("0", "1"):
        raise _RefusalError(6)
    return device, ""


_WHOLE: dict[str, Callable[[ControllerState, str], tuple[ControllerState, str]]] = {
    "TC": _report_code,
    "MG": _report_values,
    "AB": _abort,
    "EO": _echo,
}
