"""Conversion of records to plain JSON values and back, and readable JSON text.

Numbers keep all digits. NaN and infinity, which JSON does not have, become null.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import fields
from math import inf, isfinite, nan
from typing import Any

import numpy as np

from flexneedle.results import Plan
from flexneedle.types import COLUMNS

_ARRAYS = ("controls", "tips", "strain_energy", "least_stretch", "clearance", "guide", "shapes")
_STORED_ELSEWHERE = ("seconds", "scenario", "versions")


def plain(value: Any) -> Any:
    """Return a value in JSON types: dicts, lists, text, numbers, booleans, null."""
    if isinstance(value, np.ndarray | np.generic):
        numbers = value.tolist()
        is_finite = value.dtype.kind in "biu" or (value.dtype.kind == "f" and np.isfinite(value).all())
        return numbers if is_finite else plain(numbers)  # the check is much faster than a look at each number
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not isfinite(value):
        return None
    return value


def plan_values(plan: Plan) -> dict[str, Any]:
    """Return a plan by field, without its scenario and wall-clock time; arrays (mm, rad, mJ) come last."""
    names = [field.name for field in fields(plan) if field.name not in _STORED_ELSEWHERE]
    ordered = [name for name in names if name not in _ARRAYS] + list(_ARRAYS)
    return {name: getattr(plan, name) for name in ordered}


def plan_from_values(values: Mapping[str, Any]) -> Plan:
    """Return the plan of `plan_values`; raises KeyError, TypeError or ValueError for other values."""
    values = {"least_stretch": [nan], "clearance": [inf], **values}  # older files have none
    values["clearance"] = [inf if each is None else each for each in values["clearance"]]
    given = {**values, **{name: np.array(values[name], dtype=float) for name in _ARRAYS}}
    given["controls"] = given["controls"].reshape(-1, len(COLUMNS))
    x, y, z = values["target"]
    return Plan(**{**given, "target": (x, y, z), "history": tuple(values["history"])})


def to_text(values: Mapping[str, Any]) -> str:
    """Return JSON with one line per key and per row of an array."""
    return "".join(_lines(plain(values), "")) + "\n"


def _lines(value: Any, indent: str) -> Iterator[str]:
    deeper = indent + " "
    if isinstance(value, dict) and value:
        opened = [(f"{_dump(key)}: ", item) for key, item in value.items()]
        yield from _wrap_items("{}", opened, indent, deeper)
    elif isinstance(value, list) and any(isinstance(item, list | dict) for item in value) and len(indent) < 4:
        yield from _wrap_items("[]", [("", item) for item in value], indent, deeper)
    else:
        yield _dump(value)


def _wrap_items(brackets: str, items: list[tuple[str, Any]], indent: str, deeper: str) -> Iterator[str]:
    yield brackets[0]
    for number, (opening, item) in enumerate(items):
        yield f"{',' if number else ''}\n{deeper}{opening}"
        yield from _lines(item, deeper)
    yield f"\n{indent}{brackets[1]}"


def _dump(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
