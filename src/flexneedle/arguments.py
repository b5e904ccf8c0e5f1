"""Checks of arguments: one line with value, rule and remedy for an invalid one."""

import reprlib
from collections.abc import Mapping
from operator import index
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from flexneedle.errors import InputError

_Kind = TypeVar("_Kind")
_LONGEST = 60  # characters of a value in a message


def whole(name: str, value: Any, least: int, remedy: str = "") -> int:
    """Return an integer. Raises InputError for anything else, and for values below `least`."""
    try:
        number = least - 1 if isinstance(value, bool) else index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise refusal(name, value, f"must be a whole number, at least {least}", remedy)
    return number


def point(name: str, value: Any, parts: str) -> tuple[float, float, float]:
    """Return three numbers, the last 0 if only two are given; `parts` describes them. Raises InputError for others."""
    try:
        given = [] if isinstance(value, str | Mapping) else list(value)
        numbers = [] if any(isinstance(part, bool | str) for part in given) else list(map(float, given))
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in (2, 3):
        raise refusal(name, value, f"must be two or three numbers, {parts}")
    x, y, z = (*numbers, 0.0)[:3]
    return x, y, z


def instance(name: str, value: Any, kind: type[_Kind], remedy: str) -> _Kind:
    """Return a value of the class `kind`. Raises InputError, with the remedy, for another."""
    if not isinstance(value, kind):
        rule = f"must be {'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}"
        raise refusal(name, value, rule, remedy)
    return value


def path(name: str, value: Any) -> Path:
    """Return the path of a file or folder. Raises InputError for anything but text and paths."""
    if not isinstance(value, str | PathLike):
        raise refusal(name, value, "must be a path")
    return Path(value)


def shown(value: object) -> str:
    """Return any value as short text in one line."""
    text = " ".join(reprlib.repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def refusal(name: str, value: object, rule: str, remedy: str = "") -> InputError:
    """Return the error for a value that violates a rule."""
    return InputError(f"{name} = {shown(value)}: {rule}{remedy and f'; {remedy}'}")
