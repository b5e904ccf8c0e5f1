"""From the rows of a table to its grids, in one pass and in constant memory per grid point."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.checks import check_true, refuse, seen_rows, unit_quaternions
from flexneedle.em.evaluation.grid import Grid, Places, Sums, merged
from flexneedle.em.evaluation.histogram import Histogram, Singles
from flexneedle.em.evaluation.keys import MOST_BINS, Keys, Names
from flexneedle.em.evaluation.moments import Moments, add_counts, grown
from flexneedle.em.evaluation.reading import Batch
from flexneedle.errors import InputError
from flexneedle.rig.tracking.table import REFERENCE, TIP

MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}
SAME_MM = 1e-3
"""True positions of a grid point that differ by no more are the same (a stage's read-back, rounding)."""

_TRUE, _POSITION = ("true_x_mm", "true_y_mm", "true_z_mm"), ("x_mm", "y_mm", "z_mm")
_QUATERNION = ("qw", "qx", "qy", "qz")
_UPPER = np.triu_indices(4)
_ORDER = (TIP, REFERENCE, "ideal", "noisy")

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Columns = Sequence[Floats]
Mask = Any  # an array of booleans
Pair = tuple[int, int]


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
        self.orientation = Moments(len(_UPPER[0]), scattered=False)
        self._singles = Singles()

    def add(self, batch: Batch) -> None:
        """Take in a batch. Raises InputError for a row that breaks a rule."""
        start = self.rows + 1
        self.rows += batch.rows
        sensor, environment, point = (
            names.numbers(batch.labels[name], start) for name, names in self.names.items()
        )
        distance = batch.numbers.get("distance_mm")
        cell, pair = self.keys.cells(sensor, environment, point, self._bins(distance, start))
        true, position = self._lengths(batch, _TRUE), self._lengths(batch, _POSITION)
        check_true(true, start)
        seen = seen_rows(position, start)
        if seen is not None:
            self.missing = add_counts(self.missing, cell[~seen], len(self.keys))
        self._add(self.true, cell, true, None)
        self._add(self.position, cell, position, seen)
        self._check_moved(cell, true, start)
        if distance is not None:
            self._add(self.distance, cell, (distance * self._scale,), _both(seen, ~np.isnan(distance)))
        if any(name in batch.numbers for name in _QUATERNION):
            self._add_orientation(batch, cell, seen, start)
        if "indicator" in batch.numbers:
            self._add_indicator(batch.numbers["indicator"], cell, seen, pair, start)

    def _add(self, moments: Moments, cell: Indices, columns: Columns, there: Mask | None) -> None:
        if there is None:
            moments.add(cell, columns, len(self.keys))
        else:
            moments.add(cell[there], [column[there] for column in columns], len(self.keys))

    def _lengths(self, batch: Batch, names: tuple[str, ...]) -> Columns:
        columns = (batch.numbers[name] for name in names)
        return tuple(columns if self._scale == 1.0 else (column * self._scale for column in columns))

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

    def _check_moved(self, cell: Indices, true: Columns, start: int) -> None:
        for k, column in enumerate(true):
            off = column - self.true.pivot[:, k].take(cell)
            if max(off.max(), -off.min()) > SAME_MM:
                refuse(np.abs(off) > SAME_MM, start, f"{_MOVED} (here by {np.abs(off).max():.4g} mm)")

    def _add_orientation(self, batch: Batch, cell: Indices, seen: Mask | None, start: int) -> None:
        if any(name not in batch.numbers for name in _QUATERNION):
            raise InputError("qw, qx, qy, qz: all four columns must be there, or none")
        quaternion, there = unit_quaternions(np.stack([batch.numbers[name] for name in _QUATERNION]), start)
        products = [quaternion[i] * quaternion[j] for i, j in zip(*_UPPER, strict=True)]
        self._add(self.orientation, cell, products, _both(seen, there))

    def _add_indicator(
        self, values: Floats, cell: Indices, seen: Mask | None, pair: Indices, start: int
    ) -> None:
        refuse((values < 0.0) | np.isinf(values), start, "indicator: must be finite and at least 0, or empty")
        there = _both(seen, ~np.isnan(values))
        self._add(self.indicator, cell, (values,), there)
        some = slice(None) if there is None else there
        self._singles.add(pair[some], values[some])

    def singles_of(self, sensor: int, environment: int) -> tuple[Histogram, tuple[float, float]]:
        """Return single values of the indicator, see `Singles`."""
        return self._singles.of(self.keys.pairs[sensor, environment])


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


def _both(one: Mask | None, other: Mask) -> Mask | None:
    """Return the rows that are in both; None stands for all."""
    both = other if one is None else one & other
    return None if both.all() else both


def _grids(cells: _Cells) -> list[Grid]:
    sensor, environment, point, bins = cells.keys.columns()
    moments = (cells.true, cells.position, cells.distance, cells.indicator, cells.orientation)
    missing = grown(cells.missing, len(cells.keys))
    places = Places(point, bins, missing, *(_sums(entry, len(cells.keys)) for entry in moments))
    order = _order(cells.names["point_id"].names)
    names = cells.names["sensor"].names, cells.names["environment"].names
    return [
        _grid(cells, pair, places[(sensor == pair[0]) & (environment == pair[1])], order)
        for pair in sorted(
            cells.keys.pairs, key=lambda pair: (_rank(names[0][pair[0]]), _rank(names[1][pair[1]]))
        )
    ]


def _grid(cells: _Cells, pair: Pair, own: Places, order: Mapping[int, int]) -> Grid:
    chosen = np.array(sorted(set(own.point.tolist()), key=order.__getitem__), dtype=np.int64)
    points = merged(own, chosen)
    sensor, environment = (cells.names[name].names[number] for name, number in zip(_PAIR, pair, strict=True))
    _check_moved(own, points, chosen)
    names = tuple(cells.names["point_id"].names[number] for number in chosen.tolist())
    return Grid(sensor, environment, names, points, own, *cells.singles_of(*pair))


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
    numeric = all(name.removeprefix("-").isdecimal() for name in names)
    ranked = sorted(range(len(names)), key=lambda k: (int(names[k]) if numeric else 0, names[k]))
    return {number: rank for rank, number in enumerate(ranked)}


def _rank(name: str) -> tuple[int, str]:
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)
