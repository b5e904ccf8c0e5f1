"""What a report counts on in the files of a study: columns of the right kind, and a study of the right shape."""

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
    return value is None or value != value or _is_finite(value)


_WHOLE = (_is_whole, "a whole number")
_TEXT = (_is_text, "text")
_PLACE = (_is_finite, "a finite number (mm)")
_ERROR = (_is_finite_or_missing, "a finite number (mm), or missing")
_NEEDED: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "index": _WHOLE,
    "controller": _TEXT,
    "target_depth_mm": _PLACE,
    "target_lateral_mm": _PLACE,
    "seed": _WHOLE,
    "true_error_mm": _ERROR,
    "outcome": _TEXT,
}


def column_problems(rows: Rows) -> Iterator[str]:
    """Yield what is wrong with the columns that a report needs: those missing, else the first wrong value of each."""
    missing = [name for name in _NEEDED if name not in rows.columns]
    if missing:
        yield f"lacks the columns {', '.join(missing)}"
        return
    for name, (is_right, rule) in _NEEDED.items():
        values = enumerate(rows.columns[name].tolist(), 1)
        wrong = next(((row, value) for row, value in values if not is_right(value)), None)
        if wrong is not None:
            yield _told(f"{name} of row {wrong[0]}", wrong[1], rule)


def shape_problems(about: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the study in `study.json`, as far as a report reads it."""
    study = about.get("study", about)
    if not isinstance(study, dict):
        yield _told("study", study, "an object")
        return
    cases, axes, repeats = study.get("cases", {}), study.get("axes", {}), study.get("repeats", 1)
    if not _holds(cases, dict):
        yield _told("cases", cases, "an object with an object of settings for each case")
    if not _holds(axes, list):
        yield _told("axes", axes, "an object with a list of values for each key")
    if not _is_whole(repeats) or repeats < 1:
        yield _told("repeats", repeats, "a whole number, at least 1")


def _holds(values: Any, kind: type) -> bool:
    return isinstance(values, dict) and all(isinstance(value, kind) for value in values.values())


def _told(key: str, value: Any, rule: str) -> str:
    return f"{key} is {printable(reprlib.repr(value))}: must be {rule}"
