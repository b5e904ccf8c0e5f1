"""Checks of arguments. The error of an invalid argument is one line with value, rule and remedy."""

import os
import reprlib
from collections.abc import Mapping
from importlib.util import find_spec
from math import inf, isfinite
from numbers import Real
from operator import index
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from flexneedle.errors import InputError

_Kind = TypeVar("_Kind")
NARROWEST_MM, WIDEST_MM = 60.0, 600.0
"""Widths of a figure that can be read."""
_LONGEST = 60  # characters of a value in a message
_ROUNDING = 1e-6  # of the largest entry: rounding of a product of matrices in single precision


def check_whole(name: str, value: Any, least: int, remedy: str = "") -> int:
    """Return an integer. Raises InputError, with the name of the argument, for any other value or one below `least`."""
    try:
        number = least - 1 if isinstance(value, bool) else index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise make_refusal(name, value, f"must be a whole number, at least {least}", remedy)
    return number


def check_point(name: str, value: Any, parts: str) -> tuple[float, float, float]:
    """Return a point of three numbers; the third is 0 if only two are given.

    Raises InputError, with the name of the argument and its `parts`, for any other value.
    """
    try:
        given = [] if isinstance(value, str | Mapping) else list(value)
        numbers = [] if any(isinstance(part, bool | str) for part in given) else list(map(float, given))
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in (2, 3):
        raise make_refusal(name, value, f"must be two or three numbers, {parts}")
    x, y, z = (*numbers, 0.0)[:3]
    return x, y, z


def read_numbers(value: Any, count: int) -> tuple[float, ...] | None:
    """Return a row of `count` numbers as floats, finite or not; None for any other value."""
    try:
        row = tuple(value)
    except TypeError:
        return None
    if len(row) != count or any(isinstance(part, bool) or not isinstance(part, Real) for part in row):
        return None
    return tuple(map(float, row))


def read_rows(value: Any, count: int) -> tuple[tuple[float, ...], ...] | None:
    """Return rows of `count` numbers as floats, finite or not; None for any other value."""
    try:
        rows = [read_numbers(row, count) for row in value]
    except TypeError:
        return None
    known = tuple(row for row in rows if row is not None)
    return known if len(known) == len(rows) else None


def check_covariance(name: str, value: Any, size: int) -> tuple[tuple[float, ...], ...]:
    """Return a covariance by rows, (size, size). Entries that are not finite are not checked.

    Raises InputError if the value has another shape, is not symmetric up to rounding, or has a negative variance.
    """
    rows = read_rows(value, size)
    if rows is None or len(rows) != size:
        raise make_refusal(name, value, f"must be {size} rows of {size} numbers")
    rounding = _ROUNDING * max((abs(part) for row in rows for part in row if isfinite(part)), default=0.0)
    for i, row in enumerate(rows):
        if -inf < row[i] < 0.0:
            raise make_refusal(f"{name}[{i}][{i}]", row[i], "must be at least 0, a variance")
        for j in range(i + 1, size):
            if rounding < abs(row[j] - rows[j][i]) < inf:
                rule = f"must equal {name}[{j}][{i}], here {rows[j][i]!r}, up to rounding"
                raise make_refusal(f"{name}[{i}][{j}]", row[j], rule)
    return rows


def check_instance(name: str, value: Any, kind: type[_Kind], remedy: str) -> _Kind:
    """Return a value of the class `kind`. Raises InputError with the remedy for any other value."""
    if not isinstance(value, kind):
        rule = f"must be {'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}"
        raise make_refusal(name, value, rule, remedy)
    return value


def check_path(name: str, value: Any) -> Path:
    """Return the path of a file or folder. Raises InputError unless the value is a text or a path."""
    if not isinstance(value, str | PathLike):
        raise make_refusal(name, value, "must be a path")
    return expand_home(value)


def expand_home(path: str | PathLike[str]) -> Path:
    """Return a path with `~` and `~user` replaced by the home. Raises InputError for `~` where there is no home."""
    given = Path(path)
    whole = Path(os.path.expanduser(given))  # noqa: PTH111  pathlib's raises for a file called ~name
    if whole.parts[:1] == ("~",):
        raise InputError(f"{given}: no home folder is known: give the whole path")
    return whole


def shorten(value: object) -> str:
    """Return a value as short text in one line."""
    text = " ".join(reprlib.repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def make_refusal(name: str, value: object, rule: str, remedy: str = "") -> InputError:
    """Return the error for a value that violates a rule."""
    return InputError(f"{name} = {shorten(value)}: {rule}{remedy and f'; {remedy}'}")


def require_extra(extra: str, *modules: str) -> None:
    """Raise InputError, with the command to install the extra, if one of its modules is not installed."""
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise InputError(f"{' and '.join(missing)}: not installed: pip install 'flexneedle[{extra}]'")
