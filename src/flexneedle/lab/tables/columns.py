"""Columns of a table of repeated measurements: by the names of flexneedle, or by other names that are mapped to them.

A table has one row per sample and many samples per grid point. `flexneedle em simulate` and `em record` write it, `em
evaluate` reads it.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

from flexneedle.errors import InputError

REQUIRED = (
    "point_id",
    "true_x_mm",
    "true_y_mm",
    "true_z_mm",
    "x_mm",
    "y_mm",
    "z_mm",
    "indicator",
    "sensor",
    "environment",
)
"""Required columns: grid point and true position of the sensor (from the stage), measured position and indicator, name
of the sensor and of the environment. The indicator may be empty or omitted for sensors without one."""

OPTIONAL = ("qw", "qx", "qy", "qz")
"""Optional columns: orientation as a unit quaternion."""

COLUMNS = REQUIRED + OPTIONAL

STATUS = "status"
"""Optional column of tables from other programs, also written `Status` or `STATUS`: ok, empty, or why a row has no
position."""

_MAPPED = (*COLUMNS, STATUS)

REFERENCE = "reference"
"""Name in the column `sensor` of the 6-DOF sensor (paper, Table II); the 5-DOF sensor is `types.TIP` (Table I)."""

_OPTION = "--columns NAME=COLUMN"
_UNIT = re.compile(r"[\[(]\s*(mm|cm|m|in|inch|um|µm)\s*[\])]\s*$|_(cm|inch|um)$")


def map_columns(given: Iterable[str]) -> dict[str, str]:
    """Return the names in the table by column, from pairs "NAME=COLUMN".

    Raises InputError for an invalid pair, and for a column that is unknown or given twice.
    """
    names: dict[str, str] = {}
    for text in given:
        name, mark, column = (part.strip() for part in text.rpartition("="))
        if not mark or column not in _MAPPED:
            raise InputError(f"{_OPTION}: {text!r}: COLUMN must be one of {', '.join(_MAPPED)}")
        if column in names:
            raise InputError(f"{_OPTION}: {column} is given twice, as {names[column]!r} and {name!r}")
        names[column] = name
    return names


def check_units(mapping: Mapping[str, str], unit: str) -> None:
    """Raise InputError if the name of a mapped column of lengths has another unit, such as "x [cm]"."""
    for column, name in mapping.items():
        found = _UNIT.search(name)
        if found and column.endswith("_mm") and (found[1] or found[2]) != unit:
            raise InputError(f"{name!r}: all lengths must be in mm, or in m with --unit m (now: {unit})")


def choose_columns(
    header: Sequence[str],
    mapping: Mapping[str, str] | None,
    required: Iterable[str],
    optional: Iterable[str],
) -> dict[str, str]:
    """Return the columns to read with their names in the header; all others are ignored.

    mapping: names in the header by column, see `map_columns`; None if names cannot be mapped.
    Raises InputError if a column that is required or mapped is not in the header, or occurs twice.
    """
    mapped = mapping or {}
    names = {column: mapped.get(column, column) for column in (*required, *optional)}
    if names.get(STATUS) == STATUS and STATUS not in header:
        names[STATUS] = next((name for name in header if name.lower() == STATUS), STATUS)
    needed = {*required, *mapped}
    missing = [
        _describe(column, name) for column, name in names.items() if column in needed and name not in header
    ]
    if missing:
        remedy = "" if mapping is None else f": map other names with {_OPTION}{_label_options(missing)}"
        place = "" if {*names.values()} & {*header} else " in the first line that is no comment"
        raise InputError(f"no column {', '.join(missing)}{place} (found: {_list(header)}){remedy}")
    found = {column: name for column, name in names.items() if name in header}
    duplicates = [name for name in found.values() if header.count(name) > 1]
    if duplicates:
        raise InputError(f"two columns have the name {duplicates[0]!r}: names must differ")
    for name in found.values():
        shared = [column for column, other in found.items() if other == name]
        if len(shared) > 1:
            raise InputError(f"{_OPTION}: {name!r} would be both {' and '.join(shared)}: map both columns")
    return found


def _label_options(missing: Iterable[str]) -> str:
    labels = [name for name in ("sensor", "environment") if name in missing]
    options = " ".join(f"--{name} NAME" for name in labels)
    return f"; for a table of one {' and '.join(labels)}, use {options}" if labels else ""


def _describe(column: str, name: str) -> str:
    return column if column == name else f"{name!r} (for {column})"


def _list(header: Sequence[str], most: int = 20) -> str:
    shown = ", ".join(header[:most])
    return f"{shown} and {len(header) - most} more" if len(header) > most else shown or "none"
