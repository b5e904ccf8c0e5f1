"""What a report needs in the rows of a study: columns of the right kind."""

import reprlib
from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from typing import Any

from flexneedle.scenario.problems import printable
from flexneedle.study.report.rows import Rows


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _is_finite_or_missing(value: Any) -> bool:
    return value is None or _is_finite(value)


_POSITION = (_is_finite, "a finite number (mm)")
_NEEDED: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "index": (_is_whole, "a whole number"),
    "controller": (_is_text, "text"),
    "target_depth_mm": _POSITION,
    "target_lateral_mm": _POSITION,
    "seed": (_is_whole, "a whole number"),
    "true_error_mm": (_is_finite_or_missing, "a finite number (mm), or missing"),
    "outcome": (_is_text, "text"),
}


def column_problems(rows: Rows) -> Iterator[str]:
    """Yield the columns that a report needs and the rows lack, else the first wrong value of each."""
    missing = [name for name in _NEEDED if name not in rows.names]
    if missing:
        yield f"lacks the columns {', '.join(missing)}"
        return
    for name, (is_right, rule) in _NEEDED.items():
        wrong = ((row, value) for row, value in enumerate(rows.values(name), 1) if not is_right(value))
        for row, value in wrong:
            yield f"{name} of row {row} is {printable(reprlib.repr(value))}: must be {rule}"
            break
