"""Moments of the samples at each grid point, for each sensor and environment of a table.

DuckDB groups the rows in two passes over the file. Means are Kahan sums (`favg`), and sums of squares are about a
running mean (`var_pop`, Welford), so no digits cancel far from the origin.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.registration import Rigid
from flexneedle.lab.tables.rules import (
    DISTANCES,
    INDICATORS,
    ORIENTATIONS,
    POSITIONS,
    SAME_POSITION_MM,
    TRUE_POSITIONS,
    require_text,
)
from flexneedle.lab.tables.table import EMPTY, Rule, SampleTable, first_violation
from flexneedle.phantom.tracking.table import REFERENCE, TIP

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
_INDICATORS = """
    SELECT sensor, environment, count(indicator) AS n, favg(indicator) AS mean, min(indicator) AS min,
        max(indicator) AS max, quantile_cont(indicator, 0.95) AS p95,
        count(*) FILTER (indicator > $threshold) / count(indicator) AS above
    FROM samples WHERE indicator IS NOT NULL AND x_mm IS NOT NULL GROUP BY ALL
"""


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of n groups of samples: by grid point, or by grid point and distance bin.

    bins (n,): distance bin, NaN if the distance is unknown or pooled. count, missing (n,): number of samples with and
    without a position. true, position (n, 3): true and mean measured position (mm); scatter (n, 3): sum of squares
    about the mean along each axis (mm²). distance (n,): mean distance to the field generator (mm). indicators,
    orientations (n,): number of samples with a position and an indicator or an orientation; indicator (n,): mean
    indicator; products (n, 4, 4): mean of q qᵀ with q = (w, x, y, z). NaN for groups without such samples.
    """

    bins: Floats
    count: Counts
    missing: Counts
    true: Floats
    position: Floats
    scatter: Floats
    distance: Floats
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
    """Statistics of single samples of the indicator; above: share above a threshold."""

    n_samples: int
    mean: float
    max: float
    min: float
    p95: float
    above: float


@dataclass(frozen=True, eq=False)
class MeasuredGrid:
    """The measurements of one sensor in one environment on a grid.

    names: of the grid points; points: moments by grid point, in the order of names; cells: moments by grid point and
    distance bin; samples: of the indicator, None if the sensor has none; rigid: transform applied to the positions.
    """

    sensor: str
    environment: str
    names: tuple[str, ...]
    points: Moments
    cells: Moments
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
        points, cells = (replace(p, position=rigid.apply(p.position)) for p in (self.points, self.cells))
        return replace(self, points=points, cells=cells, rigid=rigid)


_Arrays = dict[str, NDArray[Any]]


def read_grids(table: SampleTable, bin_mm: float, threshold: float) -> tuple[list[MeasuredGrid], int]:
    """Return a grid for each sensor and environment, and the number of rows.

    bin_mm: width of the distance bins; threshold: of the indicator. Raises InputError for rows that violate a rule, or
    if there are no rows.
    """
    if 0 < len(table.columns.intersection(_QUATERNION)) < len(_QUATERNION):
        raise InputError("qw, qx, qy, qz: the table must have all four columns or none")
    rules = _choose_rules(table)
    cells = table.arrays(_cells_query(table, rules), bin_mm=bin_mm)
    if not len(cells["n"]):
        raise InputError("has no rows")
    labels = {name.lower() for column in _LABELS for name in cells[column]}
    if cells["n_invalid"].any() or not labels.isdisjoint(EMPTY):
        table.refuse([*require_text(*_LABELS), *rules])
    _refuse_moved(table, cells)
    indicators = table.arrays(_INDICATORS, threshold=threshold) if cells["n_indicator"].any() else {}
    pairs = sorted({*zip(cells["sensor"], cells["environment"], strict=True)}, key=lambda p: [*map(_rank, p)])
    rows = int(cells["n_rows"][cells["pooled"] == 1].sum())
    return [_grid(cells, indicators, sensor, environment) for sensor, environment in pairs], rows


def _choose_rules(table: SampleTable) -> tuple[Rule, ...]:
    optional = {"indicator": INDICATORS, "distance_mm": DISTANCES, "qw": ORIENTATIONS}
    others = (rule for column, rules in optional.items() if column in table.columns for rule in rules)
    return (*TRUE_POSITIONS, *POSITIONS, *others)


def _cells_query(table: SampleTable, rules: tuple[Rule, ...]) -> str:
    """Return the SQL for the moments by grid point (pooled = 1) and by grid point and distance bin (pooled = 0).

    Indicator, distance and orientation of samples without a position are ignored.
    """
    orientations = _ORIENTATIONS if "qw" in table.columns else _NO_ORIENTATIONS
    with_bins = "distance_mm" in table.columns
    sets = f"({_KEY})" + (f", ({_KEY}, bin)" if with_bins else "")
    bins = "bin, grouping(bin) AS pooled" if with_bins else "NULL::DOUBLE AS bin, 1 AS pooled"
    return f"""
        WITH checked AS (
            SELECT * REPLACE (if(x_mm IS NULL, NULL, indicator) AS indicator),
                floor(distance_mm / $bin_mm + 1e-9) AS bin, {first_violation(rules)} AS rule,
                if(x_mm IS NULL, NULL, qw * qw + qx * qx + qy * qy + qz * qz) AS norm
            FROM samples
        ), grouped AS (
            SELECT {_KEY}, {bins}, count(*) AS n_rows, count(x_mm) AS n, {_POSITIONS}, {orientations},
                favg(if(x_mm IS NULL, NULL, distance_mm)) AS distance, favg(indicator) AS indicator,
                count(indicator) AS n_indicator, count(norm) AS n_orientation, count(rule) AS n_invalid
            FROM checked GROUP BY GROUPING SETS ({sets})
        )
        SELECT * FROM grouped ORDER BY pooled, bin,
            CASE WHEN bool_and(regexp_full_match(point_id, '{_NUMBER}')) OVER () THEN try_cast(point_id AS HUGEINT) END,
            point_id
    """


def _refuse_moved(table: SampleTable, cells: _Arrays) -> None:
    """Raise InputError for the first row of a grid point whose true position differs from the first one."""
    moved = np.max([cells[f"moved_{a}"] for a in _AXES], axis=0)
    if moved.max() <= SAME_POSITION_MM:
        return
    worst = int(moved.argmax())
    place = {name: str(cells[name][worst]) for name in ("sensor", "environment", "point_id")}
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


def _grid(cells: _Arrays, indicators: _Arrays, sensor: str, environment: str) -> MeasuredGrid:
    own = (cells["sensor"] == sensor) & (cells["environment"] == environment)
    pooled = own & (cells["pooled"] == 1)
    return MeasuredGrid(
        sensor,
        environment,
        tuple(cells["point_id"][pooled].tolist()),
        _moments(cells, pooled),
        _moments(cells, own & (cells["pooled"] == 0)),
        _samples(indicators, sensor, environment),
    )


def _moments(cells: _Arrays, chosen: NDArray[np.bool_]) -> Moments:
    def stack_axes(name: str) -> Floats:
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
        true=stack_axes("true"),
        position=stack_axes("mean"),
        scatter=stack_axes("scatter"),
        distance=own["distance"],
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
