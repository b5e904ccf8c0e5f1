"""Columns of a table by name: places, numbers, times."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime, time
from difflib import get_close_matches
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.tables.plain_copy import EMPTY
from flexneedle.types import BAD_FLOAT, BAD_FLOAT_TOLERANCE, Floats

Table = Mapping[str, Any]
"""Columns (r,) by name."""
_SHOWN = 12  # names in a message


def locate(names: Collection[str], found: Sequence[str]) -> dict[str, int]:
    """Return the place of each column among the columns found; `NAME[2]` is the second of the columns NAME.

    Raises InputError for a column that is missing, or one of several with the same name.
    """
    counts, seen, places = Counter(found), Counter[str](), dict[str, int]()
    for k, name in enumerate(found):
        seen[name] += 1
        places[name if counts[name] == 1 else f"{name}[{seen[name]}]"] = k
    for name in names:
        if name not in places:
            raise _refusal(name, counts[name], list(places))
    return {name: places[name] for name in names}


def _refusal(name: str, count: int, found: Sequence[str]) -> InputError:
    if count:
        return InputError(f"has {count} columns {name!r}: choose one as '{name}[1]' to '{name}[{count}]'")
    small = {each.lower(): each for each in found}
    close = get_close_matches(name.lower(), small, n=1)
    hint = f"did you mean {small[close[0]]!r}? " if close else ""
    return InputError(f"has no column {name!r}; {hint}it has {list_names(found)}")


def list_names(names: Collection[str]) -> str:
    """Return the first names of a list, and the number of others."""
    shown = [repr(name) for name in names][:_SHOWN]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (", ".join(shown) or "none") + more


def to_numbers(name: str, values: Any, largest: float = 1e12) -> Floats:
    """Return a column (r,) of numbers, NaN where one is missing. Raises InputError for text and larger numbers."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise InputError(f"column {name!r} must have one number in each row")
    numbers = array.astype(float) if array.dtype.kind in "fiub" else _parse(name, array.tolist(), float)
    coded = np.abs(numbers - BAD_FLOAT) < -BAD_FLOAT_TOLERANCE * BAD_FLOAT
    numbers = np.where(coded, np.nan, numbers)
    if (wrong := np.abs(numbers) > largest).any():
        row = int(wrong.argmax())
        raise InputError(
            f"column {name!r}, row {row + 1}: {numbers[row]:g} must be a finite number up to {largest:g}"
        )
    return numbers


def to_seconds(name: str, values: Any, factor: float) -> Floats:
    """Return a column (r,) of times in s: numbers times a factor, dates, or times of day.

    Raises InputError for other text.
    """
    array = np.asarray(values)
    if array.dtype.kind == "m":
        return array / np.timedelta64(1, "s")
    if array.dtype.kind == "M":
        unknown = np.isnat(array)
        whole = array.astype("M8[ns]").astype(np.int64) * 1e-9
        return np.where(unknown, np.nan, whole)
    if array.dtype.kind in "fiub":
        return factor * to_numbers(name, array, largest=1e20)
    return _parse(name, array.tolist(), lambda value: _second(value, factor))


def _second(value: Any, factor: float) -> float:
    if isinstance(value, time):
        return value.hour * 3600.0 + value.minute * 60.0 + value.second + 1e-6 * value.microsecond
    text = str(value).strip()
    if "-" in text[1:] and "e" not in text.lower():
        date = datetime.fromisoformat(text)
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    if ":" in text:
        hours, minutes, seconds = (*text.split(":"), "0")[:3]
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
    return factor * float(value)


def _parse(name: str, values: Sequence[Any], parse: Any) -> Floats:
    found = np.full(len(values), np.nan)
    for row, value in enumerate(values):
        if value is not None and str(value).strip().lower() not in EMPTY:
            try:
                found[row] = parse(value)
            except (TypeError, ValueError):
                kind = "a number" if parse is float else "a number, a date (ISO 8601) or a time of day"
                raise InputError(f"column {name!r}, row {row + 1}: {value!r} is not {kind}") from None
    return found
