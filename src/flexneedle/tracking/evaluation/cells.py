"""From the rows of a table to its grids, in one pass and in constant memory per grid point."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.tracking.evaluation.checks import refuse, seen_rows, unit_quaternions
from flexneedle.tracking.evaluation.grid import Grid, Places, Sums, merged
from flexneedle.tracking.evaluation.histogram import Histogram
from flexneedle.tracking.evaluation.keys import MOST_BINS, Keys, Names
from flexneedle.tracking.evaluation.moments import Moments, add_counts
from flexneedle.tracking.evaluation.reading import Batch
from flexneedle.tracking.table import REFERENCE, TIP

__all__ = ["MILLIMETRES_IN", "collect"]

MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}
SAME_MM = 1e-3
"""True positions of a grid point that differ by no more are the same (a stage's read-back, rounding)."""

_TRUE, _POSITION = ("true_x_mm", "true_y_mm", "true_z_mm"), ("x_mm", "y_mm", "z_mm")
_QUATERNION = ("qw", "qx", "qy", "qz")
_UPPER = np.triu_indices(4)
_ORDER = (TIP, REFERENCE, "ideal", "noisy")

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Pair = tuple[int, int]


@dataclass(eq=False)
class _Singles:
    """Single indicator values of a sensor in an environment."""

    histogram: Histogram = field(default_factory=Histogram.empty)
    low: float = np.inf
    high: float = -np.inf

    def add(self, values: Floats) -> None:
        self.histogram.add(values)
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))


class _Cells:
    """What the rows so far came to."""

    def __init__(self, bin_mm: float, scale: float) -> None:
        self._bin_mm, self._scale = bin_mm, scale
        self.rows = 0
        self.keys = Keys()
        self.names = {column: Names(column) for column in ("sensor", "environment", "point_id")}
        self.missing = np.zeros(0, dtype=np.int64)
        self.true, self.position = Moments(3), Moments(3)
        self.distance, self.indicator = Moments(1), Moments(1)
        self.orientation = Moments(len(_UPPER[0]))
        self.singles: dict[Pair, _Singles] = {}

    def add(self, batch: Batch) -> None:
        """Take in a batch. Raises InputError for a row that breaks a rule."""
        start = self.rows + 1
        self.rows += batch.rows
        sensor, environment, point = (
            names.numbers(batch.labels[name], start) for name, names in self.names.items()
        )
        distance = batch.numbers.get("distance_mm")
        cell = self.keys.cells(sensor, environment, point, self._bins(distance, start))
        true, position = self._lengths(batch, _TRUE), self._lengths(batch, _POSITION)
        refuse(
            ~np.isfinite(true).all(axis=0), start, "true_x_mm, true_y_mm, true_z_mm: must be finite numbers"
        )
        seen = seen_rows(position, start)
        groups = len(self.keys)
        self.missing = add_counts(self.missing, cell[~seen], groups)
        for moments, columns in ((self.true, true), (self.position, position)):
            _add(moments, cell, columns, seen, groups)
        if distance is not None:
            _add(self.distance, cell, distance[None] * self._scale, seen & ~np.isnan(distance), groups)
        if _QUATERNION[0] in batch.numbers:
            self._add_orientation(batch, cell, seen, start)
        self._add_indicator(batch, cell, seen, (sensor, environment), start)
        self._check_true(cell, true, start)

    def _lengths(self, batch: Batch, names: tuple[str, ...]) -> Floats:
        stacked = np.stack([batch.numbers[name] for name in names])
        return stacked if self._scale == 1.0 else stacked * self._scale

    def _bins(self, distance: Floats | None, start: int) -> Indices:
        if distance is None:
            return np.full(self.rows - start + 1, -1, dtype=np.int64)
        refuse(
            (distance < 0.0) | np.isinf(distance),
            start,
            "distance_mm: must be a distance, finite and at least 0",
        )
        bins = np.floor(distance * (self._scale / self._bin_mm) + 1e-9)
        refuse(
            bins >= MOST_BINS - 1,
            start,
            f"distance_mm: must be below {MOST_BINS - 1} bins of {self._bin_mm:g} mm",
        )
        numbers: Indices = np.where(np.isnan(bins), -1, bins).astype(np.int64)
        return numbers

    def _check_true(self, cell: Indices, true: Floats, start: int) -> None:
        off = np.abs(true - self.true.pivot[cell].T).max(axis=0)
        refuse(off > SAME_MM, start, f"{_MOVED} (here by {off.max():.4g} mm)")

    def _add_orientation(self, batch: Batch, cell: Indices, seen: NDArray[np.bool_], start: int) -> None:
        quaternion, there = unit_quaternions(np.stack([batch.numbers[name] for name in _QUATERNION]), start)
        products = np.stack([quaternion[i] * quaternion[j] for i, j in zip(*_UPPER, strict=True)])
        _add(self.orientation, cell, products, seen & there, len(self.keys))

    def _add_indicator(
        self, batch: Batch, cell: Indices, seen: NDArray[np.bool_], pair: tuple[Indices, Indices], start: int
    ) -> None:
        values = batch.numbers["indicator"]
        refuse((values < 0.0) | np.isinf(values), start, "indicator: must be finite and at least 0, or empty")
        there = seen & ~np.isnan(values)
        _add(self.indicator, cell, values[None], there, len(self.keys))
        code = pair[0] * (1 << 16) + pair[1]
        for number in np.flatnonzero(np.bincount(np.unique(code))) if there.any() else ():
            own = values[there & (code == number)]
            if len(own):
                self.singles.setdefault(divmod(int(number), 1 << 16), _Singles()).add(own)


_MOVED = (
    f"the true position of a point_id changes by more than {SAME_MM:g} mm: each place needs an id of its own"
)


def collect(batches: Iterable[Batch], bin_mm: float, unit: str = "mm") -> tuple[list[Grid], int]:
    """Return a grid for each sensor and environment, and how many rows there were.

    bin_mm: width of the bins of distance; unit: that of all lengths, "mm" or "m". Raises InputError for rows that break
    a rule, or if there is none.
    """
    cells = _Cells(bin_mm, MILLIMETRES_IN[unit])
    for batch in batches:
        if batch.rows:
            cells.add(batch)
    if not cells.rows:
        raise InputError("there are no rows")
    return _grids(cells), cells.rows


def _add(moments: Moments, cell: Indices, columns: Floats, there: NDArray[np.bool_], groups: int) -> None:
    if there.all():
        moments.add(cell, columns, groups)
    else:
        moments.add(cell[there], columns[:, there], groups)


def _grids(cells: _Cells) -> list[Grid]:
    sensor, environment, point, bins = cells.keys.columns()
    moments = (cells.true, cells.position, cells.distance, cells.indicator, cells.orientation)
    places = Places(point, bins, cells.missing, *(_sums(entry, len(cells.keys)) for entry in moments))
    pairs = {(int(s), int(e)) for s, e in zip(sensor, environment, strict=True)}
    order = _order(cells.names["point_id"].names)
    names = cells.names["sensor"].names, cells.names["environment"].names
    return [
        _grid(cells, pair, places[(sensor == pair[0]) & (environment == pair[1])], order)
        for pair in sorted(pairs, key=lambda pair: (_rank(names[0][pair[0]]), _rank(names[1][pair[1]])))
    ]


def _grid(cells: _Cells, pair: Pair, own: Places, order: Mapping[int, int]) -> Grid:
    chosen = np.array(sorted(set(own.point.tolist()), key=order.__getitem__), dtype=np.int64)
    singles = cells.singles.get(pair, _Singles())
    points = merged(own, chosen)
    sensor, environment = (cells.names[name].names[number] for name, number in zip(_PAIR, pair, strict=True))
    _check_moved(own, points, chosen)
    names = tuple(cells.names["point_id"].names[number] for number in chosen.tolist())
    return Grid(sensor, environment, names, points, own, singles.histogram, (singles.low, singles.high))


_PAIR = ("sensor", "environment")


def _check_moved(cells: Places, points: Places, chosen: Indices) -> None:
    """Hold the distances of a grid point against each other, as its rows were before."""
    rank = {number: k for k, number in enumerate(chosen.tolist())}
    group = np.array([rank[number] for number in cells.point.tolist()], dtype=np.int64)
    off = np.abs(cells.true.mean - points.true.mean[group])
    if np.nanmax(off, initial=0.0) > SAME_MM:
        raise InputError(_MOVED)


def _sums(moments: Moments, cells: int) -> Sums:
    moments.add(np.zeros(0, dtype=np.int64), [np.zeros(0)] * moments.width, cells)
    return Sums(moments.count, moments.mean, moments.scatter)


def _order(names: list[str]) -> dict[int, int]:
    """Return the rank of each grid point: by number where all are numbers, else by name."""
    numeric = all(name.lstrip("-").isdigit() for name in names)
    ranked = sorted(range(len(names)), key=lambda k: (int(names[k]) if numeric else 0, names[k]))
    return {number: rank for rank, number in enumerate(ranked)}


def _rank(name: str) -> tuple[int, str]:
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)
