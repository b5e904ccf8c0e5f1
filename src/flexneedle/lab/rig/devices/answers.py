"""What a driver or tracker has to return: a rule for each part of its port, "" for what is as it should be.

A user's own may return anything, and what is not of its type would fail far from its cause. Pure functions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from numbers import Real
from typing import Any

import numpy as np

from flexneedle.ports import MotorSetup, MotorState
from flexneedle.scenario.own import a_kind_of
from flexneedle.types import Frame, SensorReading

Rule = Callable[[Any], str]
"""Returns what is wrong with a value, or ""."""

_UNIT = 0.01  # tolerance of the length of a quaternion; one with NaN is left to the monitor
_VECTORS = {"position": 3, "orientation": 4}


def text(value: object) -> str:
    """A text."""
    return "" if isinstance(value, str) else f"must be text, not {_kind(value)}"


def states(value: object) -> str:
    """The states of motors by channel."""
    return _by_name(value, MotorState, "channel", _state)


def setups(value: object) -> str:
    """How motors are set up, by channel."""
    return _by_name(value, MotorSetup, "channel", _setup)


def frames(value: object) -> str:
    """The frames of a tracker."""
    if not isinstance(value, tuple | list):
        return f"must be a tuple of Frame, not {_kind(value)}"
    return next(filter(None, map(_frame, value)), "")


@dataclass(frozen=True)
class Answers:
    """What a device has to return: its attributes, which are text, and the rules of what its methods return."""

    texts: tuple[str, ...]
    methods: Mapping[str, Rule]


MOTORS = Answers(("identity", "address"), {"read": states, "setup": setups})
"""Of a driver."""
TRACKER = Answers(("status",), {"read": frames})
"""Of a tracker."""


def _kind(value: object) -> str:
    return "None" if value is None else "a method" if callable(value) else a_kind_of(value)


def _by_name(value: object, wanted: type, key: str, rule: Callable[[Any], str]) -> str:
    """A mapping of texts to objects of a type, each of which a rule holds for."""
    if not isinstance(value, Mapping):
        return f"must be a mapping of each {key} to a {wanted.__name__}, not {_kind(value)}"
    for name, one in value.items():
        if not isinstance(name, str):
            return f"must have text as each {key}, not {_kind(name)}"
        if not isinstance(one, wanted):
            return f"must have a {wanted.__name__} for {key} {name}, not {_kind(one)}"
        if problem := rule(one):
            return f"{key} {name}: {problem}"
    return ""


def _state(state: MotorState) -> str:
    flags = ("moving", "on", "reverse_limit", "forward_limit", "repeated")
    return _numbers(state, "position", "commanded") or _flags(state, *flags) or _texts(state, "stopped")


def _setup(setup: MotorSetup) -> str:
    problem = _numbers(setup, "lowest", "highest", "most_error") or _flags(setup, "off_on_error")
    return problem or _texts(setup, "disabled")


def _frame(frame: object) -> str:
    if not isinstance(frame, Frame):
        return f"must be a tuple of Frame, but one is {_kind(frame)}"
    problem = _numbers(frame, "time", "number") or _by_name(frame.readings, SensorReading, "sensor", _reading)
    return problem and f"Frame: {problem}"


def _reading(reading: SensorReading) -> str:
    for name, count in _VECTORS.items():
        if not _is_vector(getattr(reading, name), count):
            return f"{name} must be {count} numbers or None"
    if reading.orientation is not None and abs((size := hypot(*reading.orientation)) - 1.0) > _UNIT:
        return f"orientation must be a unit quaternion w, x, y, z, not one of length {size:g}"
    if reading.indicator is not None and not _is_number(reading.indicator):
        return f"indicator must be a number or None, not {_kind(reading.indicator)}"
    return _texts(reading, "status")


def _is_vector(value: Any, count: int) -> bool:
    """Whether a value is as many numbers, or None."""
    if value is None:
        return True
    counted = isinstance(value, Sequence | np.ndarray) and len(value) == count
    return counted and all(map(_is_number, value))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _numbers(found: object, *names: str) -> str:
    return _first(found, names, _is_number, "a number")


def _flags(found: object, *names: str) -> str:
    return _first(found, names, lambda value: isinstance(value, Real | np.bool_), "True or False")


def _texts(found: object, *names: str) -> str:
    return _first(found, names, lambda value: isinstance(value, str), "text")


def _first(found: object, names: tuple[str, ...], good: Callable[[Any], bool], wanted: str) -> str:
    """The first of these attributes that is not as wanted."""
    bad = ((name, value) for name in names if not good(value := getattr(found, name)))
    return next((f"{name} must be {wanted}, not {_kind(value)}" for name, value in bad), "")
