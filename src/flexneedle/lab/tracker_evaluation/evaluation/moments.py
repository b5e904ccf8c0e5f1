"""Moments of the samples at each grid point, for each sensor and environment of a table.

DuckDB groups the rows. Means are Kahan sums (`favg`), and sums of squares are about a
running mean (`var_pop`, Welford), so no digits cancel far from the origin.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.tables.columns import REFERENCE
from flexneedle.lab.tables.plain_copy import EMPTY
from flexneedle.lab.tables.row_rules import (
    CODE,
    CODED,
    INDICATORS,
    ORIENTATIONS,
    POSITIONS,
    SAME_POSITION_MM,
    TRUE_POSITIONS,
    require_text,
)
from flexneedle.lab.tables.sample_table import Rule, SampleTable, first_violation
from flexneedle.lab.tracker_evaluation.evaluation.published import THRESHOLD
from flexneedle.types import TIP

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

_AXES = ("x", "y", "z")
_PAIRS = list(combinations_with_replacement("wxyz", 2))
_QUATERNION = ("qw", "qx", "qy", "qz")
_ORDER = (TIP, REFERENCE, "ideal", "noisy")
_LABELS = ("sensor", "environment", "point_id")
_KEY = ", ".join(_LABELS)
_POSITIONS = ", ".join(
    f"favg({a}_mm) AS mean_{a}, var_pop({a}_mm) * count({a}_mm) AS scatter_{a}, "
    f"(min(true_{a}_mm) + max(true_{a}_mm)) / 2 AS true_{a}, max(true_{a}_mm) - min(true_{a}_mm) AS moved_{a}"
    for a in _AXES
)
_ORIENTATIONS = ", ".join(f"favg(q{a} * q{b} / norm) AS p_{a}{b}" for a, b in _PAIRS)
_NO_ORIENTATIONS = ", ".join(f"NULL::DOUBLE AS p_{a}{b}" for a, b in _PAIRS)
_NUMBER = "-?[0-9]+"
_INDICATORS = f"""
    SELECT sensor, environment, count(indicator) AS n, favg(indicator) AS mean, min(indicator) AS min,
        max(indicator) AS max, quantile_cont(indicator, 0.95) AS p95,
        count(*) FILTER (indicator > {THRESHOLD}) / count(indicator) AS above
    FROM samples WHERE indicator IS NOT NULL AND x_mm IS NOT NULL GROUP BY ALL
"""


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of the samples at n grid points.

    count, missing (n,): number of samples with and without a position; coded (n,): with a position that may be
    a code for missing; code (n,): the coordinates of such a position. true, position
    (n, 3): true and mean measured position (mm); scatter (n, 3): sum of squares about the mean along each axis (mm²).
    indicators, orientations (n,): number of samples with a position and an indicator or an orientation; indicator (n,):
    mean indicator; products (n, 4, 4): mean of q qᵀ with q = (w, x, y, z). NaN for points without such samples.
    """

    count: Counts
    missing: Counts
    coded: Counts
    code: Floats
    true: Floats
    position: Floats
    scatter: Floats
    indicators: Counts
    indicator: Floats
    orientations: Counts
    products: Floats

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "Moments":
        return Moments(*(value[chosen] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True)
class IndicatorSamples:
    """Statistics of single samples of the indicator; above: share above the paper's threshold."""

    n_samples: int
    mean: float
    max: float
    min: float
    p95: float
    above: float


@dataclass(frozen=True, eq=False)
class MeasuredGrid:
    """The measurements of one sensor in one environment on a grid.

    names: of the grid points; points: moments in the order of names; samples: of the indicator, None if the sensor has
    none; rigid: transform applied to the positions.
    """

    sensor: str
    environment: str
    names: tuple[str, ...]
    points: Moments
    samples: IndicatorSamples | None
    rigid: Rigid | None = None

    @property
    def title(self) -> str:
        """Sensor and environment in one text."""
        return f"{self.sensor}, {self.environment}"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (n,) of the grid points that have a sample with a position."""
        known: NDArray[np.bool_] = self.points.count > 0
        return known

    @property
    def measured(self) -> Moments:
        """The grid points that have a sample with a position."""
        return self.points[self.known]

    def name_of(self, measured: Any) -> str:
        """Return the name of a grid point from its index among the measured ones."""
        return self.names[int(np.flatnonzero(self.known)[measured])]

    def transform(self, rigid: Rigid) -> "MeasuredGrid":
        """Return the grid with all mean positions transformed; the scatter remains along the tracker's axes."""
        points = replace(self.points, position=rigid.apply(self.points.position))
        return replace(self, points=points, rigid=rigid)


_Arrays = dict[str, NDArray[Any]]


def read_grids(table: SampleTable) -> tuple[list[MeasuredGrid], int]:
    """Return a grid for each sensor and environment, and the number of rows.

    Raises InputError for rows that violate a rule, or if there are no rows.
    """
    if 0 < len(table.fields.keys() & {*_QUATERNION}) < len(_QUATERNION):
        raise InputError("qw, qx, qy, qz: the table must have all four columns or none")
    rules = _choose_rules(table)
    points = table.arrays(_points_query(table, rules))
    if not len(points["n"]):
        raise InputError("has no rows")
    labels = {name.lower() for column in _LABELS for name in points[column]}
    if points["n_invalid"].any() or not labels.isdisjoint(EMPTY):
        table.refuse([*require_text(*_LABELS), *rules])
    _refuse_moved(table, points)
    indicators = table.arrays(_INDICATORS) if points["n_indicator"].any() else {}
    pairs = sorted(
        {*zip(points["sensor"], points["environment"], strict=True)}, key=lambda p: [*map(_rank, p)]
    )
    return [_grid(points, indicators, *pair) for pair in pairs], int(points["n_rows"].sum())


def _choose_rules(table: SampleTable) -> tuple[Rule, ...]:
    optional = {"indicator": INDICATORS, "qw": ORIENTATIONS}
    others = (rule for column, rules in optional.items() if column in table.fields for rule in rules)
    return (*TRUE_POSITIONS, *POSITIONS, *others)


def _points_query(table: SampleTable, rules: tuple[Rule, ...]) -> str:
    """Return the SQL for the moments by grid point; indicator and orientation without a position are ignored."""
    orientations = _ORIENTATIONS if "qw" in table.fields else _NO_ORIENTATIONS
    return f"""
        WITH checked AS (
            SELECT * REPLACE (if(x_mm IS NULL, NULL, indicator) AS indicator),
                {first_violation(rules)} AS rule,
                if(x_mm IS NULL, NULL, qw * qw + qx * qx + qy * qy + qz * qz) AS norm
            FROM samples
        ), grouped AS (
            SELECT {_KEY}, count(*) AS n_rows, count(x_mm) AS n, count(*) FILTER ({CODED}) AS n_coded,
                {CODE} AS code,
                {_POSITIONS}, {orientations},
                favg(indicator) AS indicator, count(indicator) AS n_indicator, count(norm) AS n_orientation,
                count(rule) AS n_invalid
            FROM checked GROUP BY {_KEY}
        )
        SELECT * FROM grouped ORDER BY
            CASE WHEN bool_and(regexp_full_match(point_id, '{_NUMBER}')) OVER () THEN try_cast(point_id AS HUGEINT) END,
            point_id
    """


def _refuse_moved(table: SampleTable, points: _Arrays) -> None:
    """Raise InputError for the first row of a grid point whose true position differs from the first one."""
    moved = np.max([points[f"moved_{a}"] for a in _AXES], axis=0)
    if moved.max() <= SAME_POSITION_MM:
        return
    worst = int(moved.argmax())
    place = {name: str(points[name][worst]) for name in ("sensor", "environment", "point_id")}
    own = " AND ".join(f"{name} = ${name}" for name in place)
    query = f"SELECT true_x_mm AS x, true_y_mm AS y, true_z_mm AS z FROM samples WHERE {own} LIMIT 1"
    first = table.arrays(query, **place)
    off = ", ".join(f"abs(true_{axis}_mm - {float(first[axis][0])!r})" for axis in _AXES)
    message = (
        f"the true position of a point_id changes by more than {SAME_POSITION_MM:g} mm: "
        "each position needs its own point_id"
    )
    for limit in (SAME_POSITION_MM, SAME_POSITION_MM / 2):
        table.refuse([(f"greatest({off}) > {limit}", message)], own, **place)


def _grid(points: _Arrays, indicators: _Arrays, sensor: str, environment: str) -> MeasuredGrid:
    chosen = (points["sensor"] == sensor) & (points["environment"] == environment)
    own = {name: column[chosen] for name, column in points.items()}
    samples = _samples(indicators, sensor, environment)
    return MeasuredGrid(sensor, environment, tuple(own["point_id"].tolist()), _moments(own), samples)


def _moments(own: _Arrays) -> Moments:
    def stack_axes(name: str) -> Floats:
        return np.stack([own[f"{name}_{a}"] for a in _AXES], axis=1).astype(float)

    products = np.zeros((len(own["n"]), 4, 4))
    for a, b in _PAIRS:
        i, j = "wxyz".index(a), "wxyz".index(b)
        products[:, i, j] = products[:, j, i] = own[f"p_{a}{b}"]
    return Moments(
        count=own["n"],
        missing=own["n_rows"] - own["n"],
        coded=own["n_coded"],
        code=own["code"],
        true=stack_axes("true"),
        position=stack_axes("mean"),
        scatter=stack_axes("scatter"),
        indicators=own["n_indicator"],
        indicator=own["indicator"],
        orientations=own["n_orientation"],
        products=products,
    )


def _samples(indicators: _Arrays, sensor: str, environment: str) -> IndicatorSamples | None:
    if not indicators:
        return None
    (own,) = np.nonzero((indicators["sensor"] == sensor) & (indicators["environment"] == environment))
    if not len(own):
        return None
    n, *statistics = (indicators[name][own[0]] for name in ("n", "mean", "max", "min", "p95", "above"))
    return IndicatorSamples(int(n), *map(float, statistics))


def _rank(name: str) -> tuple[int, str]:
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)
