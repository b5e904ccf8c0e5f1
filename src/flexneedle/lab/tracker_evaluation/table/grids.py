"""Grids of a table: two aggregations by DuckDB, each in one pass over the file.

Lengths are rounded to multiples of 2⁻⁴⁰ mm, whose sums in 128-bit integers are exact: the result does not depend on the
order of rows or the number of threads, and no digits cancel far from the origin. The sums of squares do not overflow
for 10⁶ samples of a grid point at 10 m.
"""

from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.table.grid import BIN_WIDTH, Floats, Grid, Histogram, Moments
from flexneedle.lab.tracker_evaluation.table.rules import (
    DISTANCES,
    EMPTY_LABELS,
    INDICATORS,
    ORIENTATIONS,
    POSITIONS,
    SAME_POSITION_MM,
    TRUE_POSITIONS,
    Rule,
    first_violation,
    refuse_moved,
    refuse_violations,
)
from flexneedle.lab.tracker_evaluation.table.source import Table
from flexneedle.phantom.tracking.table import REFERENCE, TIP

_AXES = ("x", "y", "z")
_PAIRS = list(combinations_with_replacement("wxyz", 2))
_QUATERNION = ("qw", "qx", "qy", "qz")
_ORDER = (TIP, REFERENCE, "ideal", "noisy")
_STEPS, _FINE = 2**40, 2**56  # per mm; per unit of the indicator and of products of unit quaternions
_KEY = "sensor, environment, point_id"

_POSITIONS = ", ".join(
    f"sum(whole({a}_mm)) AS s_{a}, sum(whole({a}_mm)::HUGEINT * whole({a}_mm)) AS q_{a}, "
    f"min(true_{a}_mm) AS low_{a}, max(true_{a}_mm) AS high_{a}"
    for a in _AXES
)
# Scatter about the integer part of the mean: exact, and no number is larger than the sums themselves.
_MOMENTS = ", ".join(
    f"s_{a} / n / {_STEPS} AS mean_{a}, (low_{a} + high_{a}) / 2 AS true_{a}, high_{a} - low_{a} AS moved_{a}, "
    f"(q_{a} - (s_{a} // n) * s_{a} - (s_{a} // n) * (s_{a} % n)) / {float(_STEPS) ** 2} AS scatter_{a}"
    for a in _AXES
)
_ORIENTATIONS = ", ".join(f"avg_fine(q{a} * q{b} / norm) AS p_{a}{b}" for a, b in _PAIRS)
_NO_ORIENTATIONS = ", ".join(f"NULL::DOUBLE AS p_{a}{b}" for a, b in _PAIRS)
_MACROS = (
    f"whole(v) AS try_cast(v * {_STEPS} AS BIGINT)",
    f"avg_whole(v) AS sum(whole(v)) / count(v) / {_STEPS}",
    f"avg_fine(v) AS sum(try_cast(v * {_FINE} AS HUGEINT)) / count(v) / {_FINE}",
)
_HISTOGRAM = f"""
    SELECT sensor, environment, round(indicator / {BIN_WIDTH}) * {BIN_WIDTH} AS value, count(*) AS n,
        min(indicator) AS minimum, max(indicator) AS maximum
    FROM samples WHERE indicator IS NOT NULL AND x_mm IS NOT NULL GROUP BY ALL ORDER BY value
"""
Columns = dict[str, NDArray[Any]]


def read_grids(table: Table, bin_mm: float) -> tuple[list[Grid], int]:
    """Return a grid for each sensor and environment, and the number of rows.

    bin_mm: width of the distance bins. Raises InputError for rows that violate a rule, or if there are no rows.
    """
    if 0 < len(table.columns.intersection(_QUATERNION)) < len(_QUATERNION):
        raise InputError("qw, qx, qy, qz: the table must have all four columns or none")
    for macro in _MACROS:
        table.connection.execute(f"CREATE TEMP MACRO {macro}")
    rules = _rules(table)
    cells = table.arrays(_cells_query(table, rules), bin_mm=bin_mm)
    if not len(cells["n"]):
        raise InputError("has no rows")
    if cells["n_invalid"].any():
        refuse_violations(table, rules)
    _refuse_moved(table, cells)
    bins = table.arrays(_HISTOGRAM) if cells["n_indicator"].any() else None
    pairs = sorted({*zip(cells["sensor"], cells["environment"], strict=True)}, key=lambda p: [*map(_rank, p)])
    rows = int(cells["n_rows"][cells["pooled"] == 1].sum())
    return [_grid(cells, bins, sensor, environment) for sensor, environment in pairs], rows


def _rules(table: Table) -> tuple[Rule, ...]:
    optional = {"indicator": INDICATORS, "distance_mm": DISTANCES, "qw": ORIENTATIONS}
    others = (rule for column, rules in optional.items() if column in table.columns for rule in rules)
    return (*EMPTY_LABELS, *TRUE_POSITIONS, *POSITIONS, *others)


def _cells_query(table: Table, rules: tuple[Rule, ...]) -> str:
    """Return the SQL for the sums by grid point (pooled = 1) and by grid point and distance bin (pooled = 0).

    Indicator, distance and orientation of samples without a position are ignored.
    """
    orientations = _ORIENTATIONS if "qw" in table.columns else _NO_ORIENTATIONS
    sets = f"({_KEY})" + (f", ({_KEY}, bin)" if "distance_mm" in table.columns else "")
    bins = (
        "bin, grouping(bin) AS pooled,"
        if "distance_mm" in table.columns
        else "NULL::DOUBLE AS bin, 1 AS pooled,"
    )
    return f"""
        WITH checked AS (
            SELECT * REPLACE (if(x_mm IS NULL, NULL, indicator) AS indicator),
                floor(distance_mm / $bin_mm + 1e-9) AS bin, {first_violation(rules)} AS rule,
                if(x_mm IS NULL, NULL, qw * qw + qx * qx + qy * qy + qz * qz) AS norm
            FROM samples
        ), sums AS (
            SELECT {_KEY}, {bins} count(*) AS n_rows, count(x_mm) AS n, {_POSITIONS}, {orientations},
                avg_whole(if(x_mm IS NULL, NULL, distance_mm)) AS distance, avg_fine(indicator) AS indicator,
                count(indicator) AS n_indicator, count(norm) AS n_orientation, count(rule) AS n_invalid
            FROM checked GROUP BY GROUPING SETS ({sets})
        )
        SELECT *, {_MOMENTS} FROM sums
        ORDER BY pooled, bin,
            CASE WHEN bool_and(regexp_full_match(point_id, '-?[0-9]+')) OVER () THEN try_cast(point_id AS HUGEINT) END,
            point_id
    """


def _refuse_moved(table: Table, cells: Columns) -> None:
    moved = np.max([cells[f"moved_{a}"] for a in _AXES], axis=0)
    if moved.max() > SAME_POSITION_MM:
        worst = int(moved.argmax())
        refuse_moved(table, *(str(cells[name][worst]) for name in ("sensor", "environment", "point_id")))


def _grid(cells: Columns, bins: Columns | None, sensor: str, environment: str) -> Grid:
    own = (cells["sensor"] == sensor) & (cells["environment"] == environment)
    pooled = own & (cells["pooled"] == 1)
    names = tuple(cells["point_id"][pooled].tolist())
    histogram = _histogram(bins, sensor, environment)
    return Grid(
        sensor,
        environment,
        names,
        _moments(cells, pooled),
        _moments(cells, own & (cells["pooled"] == 0)),
        histogram,
    )


def _moments(cells: Columns, chosen: NDArray[np.bool_]) -> Moments:
    def axes(name: str) -> Floats:
        return np.stack([cells[f"{name}_{a}"][chosen] for a in _AXES], axis=1).astype(float)

    own = {name: column[chosen] for name, column in cells.items()}
    products = np.zeros((len(own["n"]), 4, 4))
    for a, b in _PAIRS:
        i, j = "wxyz".index(a), "wxyz".index(b)
        products[:, i, j] = products[:, j, i] = own[f"p_{a}{b}"]
    return Moments(
        bins=own["bin"],
        count=own["n"],
        missing=own["n_rows"] - own["n"],
        true=axes("true"),
        position=axes("mean"),
        scatter=axes("scatter"),
        distance=own["distance"],
        indicators=own["n_indicator"],
        indicator=own["indicator"],
        orientations=own["n_orientation"],
        products=products,
    )


def _histogram(bins: Columns | None, sensor: str, environment: str) -> Histogram:
    if bins is None:
        return Histogram(np.empty(0), np.empty(0, dtype=np.int64), np.inf, -np.inf)
    own = (bins["sensor"] == sensor) & (bins["environment"] == environment)
    value, count, low, high = (bins[name][own] for name in ("value", "n", "minimum", "maximum"))
    return Histogram(value, count, float(low.min(initial=np.inf)), float(high.max(initial=-np.inf)))


def _rank(name: str) -> tuple[int, str]:
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)
