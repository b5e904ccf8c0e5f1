"""Rules for the rows of a table: SQL conditions that invalid rows of `samples` meet, each with its message."""

from flexneedle.lab.tables.plain_copy import EMPTY
from flexneedle.lab.tables.sample_table import Rule

SAME_POSITION_MM = 1e-3
"""Largest difference between the true positions of a grid point (read-back of a stage, rounding)."""
LARGEST = 1e6
"""Largest accepted number (mm): beyond any room, below a tracker's code for "no value" (−3.7e28 in NDI's replies)."""
UNIT_TOLERANCE = 0.01  # devices round quaternions to 4 digits

_TRUE, _MEASURED, _QUATERNION = "true_x_mm, true_y_mm, true_z_mm", "x_mm, y_mm, z_mm", "qw, qx, qy, qz"


def require_text(*columns: str) -> tuple[Rule, ...]:
    """Return the rules that columns of text are not empty."""
    return tuple((f"lower({name}) IN {EMPTY}", f"{name} is empty") for name in columns)


def require_numbers(*columns: str) -> tuple[Rule, ...]:
    """Return the rules that columns of numbers have finite values."""
    return tuple((f"{name} IS NULL OR isinf({name})", f"{name}: must be a finite number") for name in columns)


def _count_absent(columns: str) -> str:
    """Return the SQL for the number of columns that are NULL in a row."""
    return " + ".join(f"({name} IS NULL)::INTEGER" for name in columns.split(", "))


def _at_most(columns: str) -> Rule:
    sizes = ", ".join(f"abs({name})" for name in columns.split(", "))
    return (
        f"greatest({sizes}) > {LARGEST}",
        f"{columns}: must be at most {LARGEST:g} mm (a code for a missing position?)",
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
    (f"indicator < 0 OR indicator > {LARGEST}", f"indicator: must be from 0 to {LARGEST:g}, or empty"),
)
ORIENTATIONS: tuple[Rule, ...] = (
    (f"{_count_absent(_QUATERNION)} IN (1, 2, 3)", f"{_QUATERNION}: must all have values, or all be empty"),
    (
        f"abs(sqrt(qw * qw + qx * qx + qy * qy + qz * qz) - 1) > {UNIT_TOLERANCE}",
        f"{_QUATERNION}: must be a unit quaternion (norm within 1 %)",
    ),
)
