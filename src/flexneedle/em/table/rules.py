"""What a row of measurements may hold: conditions in SQL on the view `samples`, each with its message."""

from collections.abc import Iterable
from typing import Any

from flexneedle.em.table.source import LABELS, Table
from flexneedle.errors import InputError

SAME_MM = 1e-3
"""True positions of a grid point that differ by no more are the same (a stage's read-back, rounding)."""
FARTHEST = 1e6
"""Largest number (mm). A tracker's code for "no value" is beyond (−3.7e28 in NDI's replies), a room is not."""
UNIT_TOLERANCE = 0.01  # devices round a quaternion to 4 digits

Rule = tuple[str, str]
"""A condition that a wrong row meets, and what is wrong then."""

_TRUE, _TURN = "true_x_mm, true_y_mm, true_z_mm", "qw, qx, qy, qz"
_MOVED = (
    f"the true position of a point_id changes by more than {SAME_MM:g} mm: each place needs an id of its own"
)


def _absent(columns: str) -> str:
    """Return SQL for how many of some columns are NULL in a row."""
    return " + ".join(f"({name} IS NULL)::INTEGER" for name in columns.split(", "))


EMPTY_LABELS: tuple[Rule, ...] = tuple((f"{name} = ''", f"{name} is empty") for name in LABELS)
POSITIONS: tuple[Rule, ...] = (
    (
        f"{_absent('x_mm, y_mm, z_mm')} IN (1, 2)",
        "x_mm, y_mm, z_mm: all three must be there, or none (a missing sample)",
    ),
    (
        f"greatest(abs(x_mm), abs(y_mm), abs(z_mm)) > {FARTHEST}",
        f"x_mm, y_mm, z_mm: must be finite and at most {FARTHEST:g} mm (a code for a missing place?)",
    ),
)
TRUE_POSITIONS: tuple[Rule, ...] = (
    (
        f"{_absent(_TRUE)} > 0 OR greatest(abs(true_x_mm), abs(true_y_mm), abs(true_z_mm)) > {FARTHEST}",
        f"{_TRUE}: must be there, and at most {FARTHEST:g} mm",
    ),
)
INDICATORS: tuple[Rule, ...] = (
    (
        f"indicator < 0 OR indicator > {FARTHEST}",
        f"indicator: must be from 0 to {FARTHEST:g}, or empty",
    ),
)
DISTANCES: tuple[Rule, ...] = (
    (
        f"distance_mm < 0 OR distance_mm > {FARTHEST}",
        f"distance_mm: must be from 0 to {FARTHEST:g} mm, or empty",
    ),
)
TURNS: tuple[Rule, ...] = (
    (f"{_absent(_TURN)} IN (1, 2, 3)", f"{_TURN}: all four must be there, or none"),
    (
        f"abs(sqrt(qw * qw + qx * qx + qy * qy + qz * qz) - 1) > {UNIT_TOLERANCE}",
        f"{_TURN}: must be a unit quaternion, to 1 %",
    ),
)


def broken(rules: Iterable[Rule]) -> str:
    """Return SQL for the number of the first rule that a row breaks, NULL if it breaks none."""
    cases = " ".join(f"WHEN {condition} THEN {number}" for number, (condition, _) in enumerate(rules))
    return f"CASE {cases} END"


def refuse_broken(table: Table, rules: tuple[Rule, ...], chosen: str = "true", **values: Any) -> None:
    """Raise InputError for the first row, of those that meet the condition `chosen`, that breaks a rule.

    Rows count from 1, below the header.
    """
    numbered = f"SELECT row_number() OVER () AS row, {broken(rules)} AS rule, {chosen} AS chosen FROM samples"
    query = f"SELECT row, rule FROM ({numbered}) WHERE chosen AND rule IS NOT NULL ORDER BY row LIMIT 1"
    found = table.arrays(query, **values)
    for row, rule in zip(found["row"], found["rule"], strict=True):
        raise InputError(f"row {row}: {rules[int(rule)][1]}")


def refuse_moved(table: Table, sensor: str, environment: str, point: str) -> None:
    """Raise InputError for the first row of a grid point whose true position is not that of its first row."""
    off = "greatest(" + ", ".join(f"abs({a} - first({a}) OVER ordered)" for a in _TRUE.split(", ")) + ")"
    own = "sensor = $sensor AND environment = $environment AND point_id = $point"
    query = f"""
        WITH numbered AS (SELECT row_number() OVER () AS row, * FROM samples),
             moved AS (SELECT row, {off} AS off FROM numbered WHERE {own} WINDOW ordered AS (ORDER BY row))
        SELECT row, off FROM moved WHERE off > {SAME_MM} / 2 ORDER BY off <= {SAME_MM}, row LIMIT 1
    """
    found = table.arrays(query, sensor=sensor, environment=environment, point=point)
    raise InputError(f"row {found['row'][0]}: {_MOVED} (here by {found['off'][0]:.4g} mm)")
