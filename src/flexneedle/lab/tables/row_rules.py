"""Rules for the rows of a table: SQL conditions that invalid rows of `samples` meet, each with its message."""

from collections.abc import Iterable

from flexneedle.lab.tables.plain_copy import EMPTY
from flexneedle.lab.tables.sample_table import Rule
from flexneedle.types import FARTHEST_MM

SAME_POSITION_MM = 1e-3
"""Largest difference between the true positions of a grid point (read-back of a stage, rounding)."""
_LARGEST_INDICATOR = 1e6
UNIT_TOLERANCE = 0.01  # devices round quaternions to 4 digits

CODED = "x_mm = y_mm AND y_mm = z_mm AND (x_mm IN (0, -1, 99, -99) OR abs(x_mm) >= 999)"
"""SQL condition of positions that may be codes for missing, such as (0, 0, 0) or (-999, -999, -999)."""
CODE = f"any_value(x_mm) FILTER ({CODED})"
"""SQL for the coordinate of such a position in a group."""
_TRUE, _MEASURED, _QUATERNION = "true_x_mm, true_y_mm, true_z_mm", "x_mm, y_mm, z_mm", "qw, qx, qy, qz"


def require_text(*columns: str) -> tuple[Rule, ...]:
    """Return the rules that columns of text are not empty."""
    return tuple((f"lower({name}) IN {EMPTY}", f"{name} is empty") for name in columns)


def require_numbers(*columns: str) -> tuple[Rule, ...]:
    """Return the rules that columns of numbers have finite values."""
    return tuple((f"{name} IS NULL OR isinf({name})", f"{name}: must be a finite number") for name in columns)


def note_codes(count: int, total: int, codes: Iterable[float]) -> str | None:
    """Return one line on `count` of `total` positions with coordinates that are codes, None without any."""
    if not count:
        return None
    values = sorted({code + 0.0 for code in codes}, key=abs)  # 0, not -0
    found = " or ".join(f"({code:g}, {code:g}, {code:g})" for code in values)
    return (
        f"{count} of {total} positions are exactly {found}, a code for missing? They count as measured: if they are "
        "missing, leave them empty"
    )


def _count_absent(columns: str) -> str:
    """Return the SQL for the number of columns that are NULL in a row."""
    return " + ".join(f"({name} IS NULL)::INTEGER" for name in columns.split(", "))


def _at_most(columns: str) -> Rule:
    sizes = ", ".join(f"abs({name})" for name in columns.split(", "))
    return (
        f"greatest({sizes}) > {FARTHEST_MM}",
        f"{columns}: must be at most {FARTHEST_MM:g} mm: is the unit right? A code for a missing "
        "position must be left empty",
    )


POSITIONS: tuple[Rule, ...] = (
    (
        f"{_count_absent(_MEASURED)} IN (1, 2)",
        f"{_MEASURED}: must all have values, or all be empty (a missing sample)",
    ),
    _at_most(_MEASURED),
)
TRUE_POSITIONS: tuple[Rule, ...] = (
    (f"{_count_absent(_TRUE)} > 0", f"{_TRUE}: must have values"),
    _at_most(_TRUE),
)
INDICATORS: tuple[Rule, ...] = (
    (
        f"indicator < 0 OR indicator > {_LARGEST_INDICATOR}",
        f"indicator: must be from 0 to {_LARGEST_INDICATOR:g}, or empty",
    ),
)
ORIENTATIONS: tuple[Rule, ...] = (
    (f"{_count_absent(_QUATERNION)} IN (1, 2, 3)", f"{_QUATERNION}: must all have values, or all be empty"),
    (
        f"abs(sqrt(qw * qw + qx * qx + qy * qy + qz * qz) - 1) > {UNIT_TOLERANCE}",
        f"{_QUATERNION}: must be a unit quaternion (norm within 1 %), or empty",
    ),
)
