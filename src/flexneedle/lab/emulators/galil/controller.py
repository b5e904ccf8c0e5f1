"""Replies of the emulated Galil DMC-4143 to lines, as a function of its state. Pure functions, without I/O or time.

It has the commands that drive axes A to D: motor on and off, speeds, relative and absolute moves, position tracking,
stop, abort, limits, and queries of positions, errors and reasons. A command is two capital letters, axes and
values as `PRA=100`, `PR 100,,50` or `BGAC`; a line may have several with `;` between them. Each is answered by its data
and `:`, or by `?`, after which `TC1` reports why. Facts are from Galil's Command Reference for the DMC-4103, the
series of the DMC-4143; it was not compared with a controller.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from flexneedle.lab.emulators.galil import motor_axis as one
from flexneedle.lab.emulators.galil.axis_commands import (
    ACTIONS,
    ERRORS,
    OPERANDS,
    REPORTED,
    SETTINGS,
    CommandRefusal,
)
from flexneedle.lab.emulators.galil.motor_axis import MotorAxis
from flexneedle.lab.emulators.galil.profile import SAMPLE_S

AXES = "ABCD"
REVISION = "DMC4143 Rev 1.3d"
SAMPLES_HZ = round(1.0 / SAMPLE_S)

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
        except CommandRefusal as refusal:
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
        raise CommandRefusal(1)
    name, rest = form["name"], form["rest"].strip()
    if name in _WHOLE:
        return _WHOLE[name](device, rest)
    if name in ACTIONS:
        changed = {k: ACTIONS[name](device.axes[k]) for k in _parse_axes(rest)}
        return _with_axes(device, changed), ""
    if name in REPORTED:
        which = _parse_axes(rest)
        return device, _format_line(", ".join(_format_number(REPORTED[name](device.axes[k])) for k in which))
    if name in SETTINGS:
        return _apply_setting(device, name, rest)
    raise CommandRefusal(1)


def _format_line(text: str) -> str:
    return f" {text}\r\n" if text else ""


def _format_number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else f"{value:.4f}"


def _parse_axes(rest: str) -> list[int]:
    """Return the axes that a command names; all of them if none."""
    if not all(letter in AXES for letter in rest):
        raise CommandRefusal(4)
    return [AXES.index(letter) for letter in rest] or list(range(len(AXES)))


def _parse_value(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise CommandRefusal(4) from None
    if not math.isfinite(value):
        raise CommandRefusal(4)
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
        raise CommandRefusal(50 if not fields else 4)
    reported, change = SETTINGS[name]
    if any(text == "?" for text in fields.values()):
        if not all(text == "?" for text in fields.values()):
            raise CommandRefusal(51)
        return device, _format_line(
            ", ".join(_format_number(reported(device.axes[k])) for k in sorted(fields))
        )
    # All values are checked before one is set.
    return _with_axes(
        device, {k: change(device.axes[k], _parse_value(text)) for k, text in fields.items()}
    ), ""


# Queries


def _report_code(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("", "0", "1", "?"):
        raise CommandRefusal(4)
    text = f"{device.error} {ERRORS.get(device.error, '')}".strip() if rest == "1" else str(device.error)
    return replace(device, error=0), _format_line(text)


def _report_values(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    values = (_value_of(device, text.strip()) for text in rest.split(","))
    return device, _format_line(" ".join(f"{value:.4f}" for value in values))


def _value_of(device: ControllerState, text: str) -> float:
    if text in _GENERAL:
        return _GENERAL[text]
    operand = _OPERAND.fullmatch(text)
    if operand is None or operand["name"] not in OPERANDS:
        raise CommandRefusal(1)
    return OPERANDS[operand["name"]](device.axes[AXES.index(operand["axis"])])


def _abort(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("", "0", "1"):  # 1 spares the programs, and it has none
        raise CommandRefusal(6)
    return replace(device, axes=tuple(one.abort_motion(axis) for axis in device.axes)), ""


def _echo(device: ControllerState, rest: str) -> tuple[ControllerState, str]:
    if rest not in ("0", "1"):
        raise CommandRefusal(6)
    return device, ""


_WHOLE: dict[str, Callable[[ControllerState, str], tuple[ControllerState, str]]] = {
    "TC": _report_code,
    "MG": _report_values,
    "AB": _abort,
    "EO": _echo,
}
