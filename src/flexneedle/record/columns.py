"""A control period as one row of named scalars: the columns of the CSV and the keys of `/control/status`.

Names end in their unit; numbers are exact (`repr`), so that a period is restored from its row to the last bit.

A verdict is its kind, or `KIND: REASON`, divided at the first ": ", which no kind contains.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from flexneedle.record.planar import row_in_space
from flexneedle.types import COLUMNS as CONTROL
from flexneedle.types import (
    Action,
    CheckedMeasurement,
    Control,
    Floats,
    Measurement,
    Period,
    Pose,
    Verdict,
    VerdictKind,
)

_Scalar = Callable[[str], Any]


def verdict_of(text: str) -> Verdict:
    """Return the verdict of its text, `str(verdict)`. Raises ValueError for other texts."""
    kind, _, reason = text.partition(": ")
    return Verdict(VerdictKind(kind), reason)


def _flag(value: object) -> bool:
    return str(value) == "True"


def _command(name: str) -> tuple[tuple[str, _Scalar], ...]:
    angles = ("db_theta", "db_psi", "roll", "spin")
    return tuple((f"{name}_{column}_{'rad' if column in angles else 'mm'}", float) for column in CONTROL)


def _pose(name: str) -> tuple[tuple[str, _Scalar], ...]:
    return tuple((f"{name}_{part}", float) for part in ("x_mm", "y_mm", "z_mm", "theta_rad", "psi_rad"))


_TEXTS = (str, verdict_of, Action)

# Columns of each field of Period, with their parsers. A field of several columns is a tuple.
_FIELDS: dict[str, tuple[tuple[str, _Scalar], ...]] = {
    "index": (("index", int),),
    "time": (("time_s", float),),
    "command": _command("command"),
    "applied": _command("applied"),
    "measurement": tuple((f"measured_{part}", float) for part in ("time_s", "x_mm", "y_mm", "z_mm")),
    "verdict": (("verdict", verdict_of),),
    "innovation": tuple((f"innovation_{axis}_mm", float) for axis in "xyz"),
    "estimate": _pose("estimate"),
    "base": _pose("base"),
    "guide": (("guide_y_mm", float), ("guide_z_mm", float)),
    "roll": (("roll_rad", float),),
    "strain_energy": (("strain_energy_mj", float),),
    "tip_load": (("tip_load_y_n", float), ("tip_load_z_n", float)),
    "path": _pose("path"),
    "cost": (("cost", float),),
    "spread": (("spread_mm", float),),
    "action": (("action", Action),),
    "late": (("late", _flag),),
    "decision": (("decision", str),),
    "miss": (("miss_y_mm", float), ("miss_z_mm", float)),
    "miss_sd": (("miss_sd_mm", float),),
    "warning": (("warning", str),),
    "true_tip": _pose("true"),
    "true_strain_energy": (("true_strain_energy_mj", float),),
    "true_stretch": (("true_stretch", float),),
    "converged": (("converged", _flag),),
}

COLUMNS: tuple[str, ...] = tuple(name for columns in _FIELDS.values() for name, _ in columns)
"""Names of the columns, in order."""

_KINDS: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(("command", "applied"), Control),
    **dict.fromkeys(("estimate", "base", "path", "true_tip"), Pose),
    "measurement": Measurement,
}


def to_row(period: Period) -> dict[str, str]:
    """Return the scalars of a period as text by column; missing values are empty."""
    return {name: "" if value is None else _text(value) for name, value in _cells(period)}


def to_values(period: Period) -> dict[str, Any]:
    """Return the scalars of a period as numbers, flags and text by column; missing numbers are NaN."""
    return {name: math.nan if value is None else value for name, value in _cells(period)}


def from_row(
    row: Mapping[str, str],
    shape: Floats,
    durations: dict[str, float],
    readings: tuple[CheckedMeasurement, ...] = (),
) -> Period:
    """Return the period of a row and of the values not in it; raises KeyError or ValueError for other rows."""
    row = row_in_space(row)
    values = {field: _value(field, row) for field in _FIELDS}
    return Period(shape=shape, durations=durations, readings=readings, **values)


def _cells(period: Period) -> Iterator[tuple[str, Any]]:
    """Each column and its value, None if missing."""
    for field, columns in _FIELDS.items():
        value = getattr(period, field)
        if isinstance(value, Measurement):
            value = (value.time, value.x, value.y, value.z)
        parts = value if isinstance(value, tuple) else (value,) * len(columns)
        for (name, kind), part in zip(columns, parts, strict=True):
            yield name, None if part is None else str(part) if kind in _TEXTS else kind(part)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


def _value(field: str, row: Mapping[str, str]) -> Any:
    parts: Any = tuple(kind(row[name]) if row[name] or kind is str else None for name, kind in _FIELDS[field])
    if len(parts) == 1:
        return parts[0]
    if parts[0] is None:
        return None
    return _KINDS[field](*parts) if field in _KINDS else parts
