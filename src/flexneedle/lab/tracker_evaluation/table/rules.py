"""Rules for the rows of a table of measurements: SQL conditions on the view `samples`, each with its message."""

from collections.abc import Iterable
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.table.source import LABELS, Table

SAME_POSITION_MM = 1e-3
"""Largest difference between the true positions of a grid point (read-back of a stage, rounding)."""
LARGEST = 1e6
"""Largest accepted number (mm): beyond any room, below a tracker's code for "no value" (−3.7e28 in NDI's replies)."""
UNIT_TOLERANCE = 0.01  # devices round quaternions to 4 digits

Rule = tuple[str, str]
"""A condition that invalid rows meet, and the message."""

_TRUE, _QUATERNION = "true_x_mm, true_y_mm, true_z_mm", "qw, qx, qy, qz"
_MOVED = (
    f"the true position of a point_id changes by more than {SAME_POSITION_MM:g} mm: "
    "each position needs its own point_id"
)


def _absent(columns: str) -> str:
    """Return the SQL for the number of columns that are NULL in a row."""
    return " + ".join(f"({name} IS NULL)::INTEGER" for name in columns.split(", "))


EMPTY_LABELS: tuple[Rule, ...] = tuple(
    (f"{name} = ''", f"{name} is empty (in a CSV file, NA, None, null, nan and MISSING are empty)")
    for name in LABELS
)
POSITIONS: tuple[Rule, ...] = (
    (
        f"{_absent('x_mm, y_mm, z_mm')} IN (1, 2)",
        "x_mm, y_mm, z_mm: must all have values, or all be empty (a missing sample)",
    ),
    (
        f"greatest(abs(x_mm), abs(y_mm), abs(z_mm)) > {LARGEST}",
        f"x_mm, y_mm, z_mm: must be finite and at most {LARGEST:g} mm (a code for a missing position?)",
    ),
)
TRUE_POSITIONS: tuple[Rule, ...] = (
    (
        f"{_absent(_TRUE)} > 0 OR greatest(abs(true_x_mm), abs(true_y_mm), abs(true_z_mm)) > {LARGEST}",
        f"{_TRUE}: must all have values of at most {LARGEST:g} mm",
    ),
)
INDICATORS: tuple[Rule, ...] = (
    (
        f"indicator < 0 OR indicator > {LARGEST}",
        f"indicator: must be from 0 to {LARGEST:g}, or empty",
    ),
)
DISTANCES: tuple[Rule, ...] = (
    (
        f"distance_mm < 0 OR distance_mm > {LARGEST}",
        f"distance_mm: must be from 0 to {LARGEST:g} mm, or empty",
    ),
)
ORIENTATIONS: tuple[Rule, ...] = (
    (f"{_absent(_QUATERNION)} IN (1, 2, 3)", f"{_QUATERNION}: must all have values, or all be empty"),
    (
        f"abs(sqrt(qw * qw + qx * qx + qy * qy + qz * qz) - 1) > {UNIT_TOLERANCE}",
        f"{_QUATERNION}: must be a unit quaternion (norm within 1 %)",
    ),
)


def first_violation(rules: Iterable[Rule]) -> str:
    """Return the SQL for the index of the first rule that a row violates, NULL if it violates none."""
    cases = " ".join(f"WHEN {condition} THEN {number}" for number, (condition, _) in enumerate(rules))
    return f"CASE {cases} END"


def refuse_violations(table: Table, rules: tuple[Rule, ...], chosen: str = "true", **values: Any) -> None:
    """Raise InputError for the first row that meets the condition `chosen` and violates a rule.

    Rows count from 1, below the header.
    """
    numbered = f"SELECT row_number() OVER () AS row, {first_violation(rules)} AS rule, {chosen} AS chosen FROM samples"
    query = f"SELECT row, rule FROM ({numbered}) WHERE chosen AND rule IS NOT NULL ORDER BY row LIMIT 1"
    found = table.arrays(query, **values)
    for row, rule in zip(found["row"], found["rule"], strict=True):
        raise InputError(f"row {row}: {rules[int(rule)][1]}")


def refuse_moved(table: Table, sensor: str, environment: str, point: str) -> None:
    """Raise InputError for the first row of a grid point whose true position differs from that of its first row."""
    off = "greatest(" + ", ".join(f"abs({a} - first({a}) OVER ordered)" for a in _TRUE.split(", ")) + ")"
    own = "sensor = $sensor AND environment = $environment AND point_id = $point"
    query = f"""
        WITH numbered AS (SELECT row_number() OVER () AS row, * FROM samples),
             moved AS (SELECT row, {off} AS off FROM numbered WHERE {own} WINDOW ordered AS (ORDER BY row))
        SELECT row, off FROM moved WHERE off > {SAME_POSITION_MM} / 2 ORDER BY off <= {SAME_POSITION_MM}, row LIMIT 1
    """
    found = table.arrays(query, sensor=sensor, environment=environment, point=point)
    raise InputError(f"row {found['row'][0]}: {_MOVED} (here by {found['off'][0]:.4g} mm)")
