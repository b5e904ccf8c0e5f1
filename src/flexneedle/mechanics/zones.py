"""Distances of the needle from zones to avoid: primitives, and grids of distances (docs/theory.md section 14).

Zones are fixed in the needle's frame. A distance is from a point of the needle's axis to the surface of a zone,
negative inside. Of a zone that is farther than `far` along x no distance is computed.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.lanes import least, load, magnitude, most, root, row_of, select, some, whole
from flexneedle.mechanics.lateral import y_of, z_of
from flexneedle.mechanics.needle import NeedleState
from flexneedle.mechanics.work import CONTACT, KIND, Needles, X, Y

Floats = NDArray[np.float64]

CAPSULE, BOX, HALF_SPACE, GRID = range(4)
"""Shapes of a zone."""
SHAPE, LOW, HIGH, MORE, FIRST = 0, 1, 2, 3, 4
"""Columns of a zone: shape; x (mm) from which and up to which nodes can be near it; distance (mm) by which it is larger
than its shape; first of its numbers.

Numbers of a capsule: an end (3), the vector (3) to the other and 1/length² (0 for a sphere), radius. Of a box: centre
(3), half sizes (3), unit vectors of its axes (9), radius of its edges. Of a half-space: unit vector (3) out of it, and
the distance of its surface from the origin along it. Of a grid: first corner (3), 1/spacing (3), cells (3), first row.
"""
COLUMNS = FIRST + 16
"""Numbers of a zone."""


class Zones(NamedTuple):
    """Zones as arrays of numbers.

    fields: values (mm) at the corners of each cell of the grids, corner 4 i + 2 j + k at i, j, k along x, y, z.
    """

    rows: Floats  # (z, COLUMNS)
    fields: Floats  # (cells, 8)
    far: float  # distance (mm) up to which distances are exact


@inner
def _from_capsule(row: Floats, x: float, y: float, z: float) -> float:
    x, y, z = x - row[FIRST], y - row[FIRST + 1], z - row[FIRST + 2]
    along = (x * row[FIRST + 3] + y * row[FIRST + 4] + z * row[FIRST + 5]) * row[FIRST + 6]
    share = least(most(along, 0.0), 1.0)
    x, y, z = x - share * row[FIRST + 3], y - share * row[FIRST + 4], z - share * row[FIRST + 5]
    return root(x * x + y * y + z * z) - row[FIRST + 7]


@inner
def _from_box(row: Floats, x: float, y: float, z: float) -> float:
    x, y, z = x - row[FIRST], y - row[FIRST + 1], z - row[FIRST + 2]
    outside, inside = 0.0 * x, 0.0 * x - np.inf
    for k in range(3):
        axis = FIRST + 6 + 3 * k
        off = magnitude(x * row[axis] + y * row[axis + 1] + z * row[axis + 2]) - row[FIRST + 3 + k]
        beyond = most(off, 0.0)
        outside, inside = outside + beyond * beyond, most(inside, off)
    return root(outside) + least(inside, 0.0) - row[FIRST + 15]


@inner
def _from_half_space(row: Floats, x: float, y: float, z: float) -> float:
    return x * row[FIRST] + y * row[FIRST + 1] + z * row[FIRST + 2] - row[FIRST + 3]


@inner
def _place(row: Floats, k: int, value: float) -> tuple[float, float]:
    """Return the cell along an axis of a grid, and the place in it from 0 to 1; outside of the grid, at its edge."""
    cells = row[FIRST + 6 + k]
    at = least(most((value - row[FIRST + k]) * row[FIRST + 3 + k], 0.0), cells)
    cell = least(whole(at), cells - 1.0)
    return cell, at - cell


@inner
def _from_grid(row: Floats, fields: Floats, x: float, y: float, z: float) -> float:
    (i, s), (j, t), (k, u) = _place(row, 0, x), _place(row, 1, y), _place(row, 2, z)
    v = row_of(fields, row[FIRST + 9] + (i * row[FIRST + 7] + j) * row[FIRST + 8] + k)
    near = (v[0] + u * (v[1] - v[0])) * (1.0 - t) + (v[2] + u * (v[3] - v[2])) * t
    beyond = (v[4] + u * (v[5] - v[4])) * (1.0 - t) + (v[6] + u * (v[7] - v[6])) * t
    return near + s * (beyond - near)


@inner
def distance_from(row: Floats, fields: Floats, x: float, y: float, z: float) -> float:
    """Return the distances (mm) of points from a zone."""
    if row[SHAPE] == CAPSULE:
        return _from_capsule(row, x, y, z) - row[MORE]
    if row[SHAPE] == BOX:
        return _from_box(row, x, y, z) - row[MORE]
    if row[SHAPE] == HALF_SPACE:
        return _from_half_space(row, x, y, z) - row[MORE]
    return _from_grid(row, fields, x, y, z) - row[MORE]


@inner
def least_distance(w: Needles, zones: Zones, needle: NeedleState, count: int) -> float:
    """Return the least distance of the inserted needles' axes from all zones, at the contacts and the tip; ≤ far."""
    tip = needle.solution.tip
    found = zones.far + 0.0 * tip.x
    for k in range(zones.rows.shape[0]):
        row = zones.rows[k]
        for i in range(w.first, count + 1):
            x, y, near = tip.x, tip.y, tip.x > 0.0
            if i < count:
                x, y = load(w.mesh, i, X), load(w.laterals, i, Y)
                near = (x < tip.x) & (float(i) < needle.solution.behind) & (load(w.mesh, i, KIND) == CONTACT)
            near = near & (x > row[LOW]) & (x < row[HIGH])
            if some(near):
                here = distance_from(row, zones.fields, x, y_of(y), z_of(y))
                found = select(near, least(found, here), found)
    return found


@kernel
def fill_distances(zones: Zones, points: Floats, distances: Floats) -> None:
    """Set the distances (z, n), mm, of points (n, 3) from each zone, at any distance."""
    for k in range(zones.rows.shape[0]):
        for i in range(points.shape[0]):
            distances[k, i] = distance_from(
                zones.rows[k], zones.fields, points[i, 0], points[i, 1], points[i, 2]
            )


@kernel
def fill_least_distances(zones: Zones, points: Floats, distances: Floats) -> None:
    """Set the least distances (n,), mm, of points (n, 3) from all zones; ≤ far."""
    for i in range(points.shape[0]):
        distances[i] = zones.far
        for k in range(zones.rows.shape[0]):
            row = zones.rows[k]
            if row[LOW] < points[i, 0] < row[HIGH]:
                here = distance_from(row, zones.fields, points[i, 0], points[i, 1], points[i, 2])
                distances[i] = min(distances[i], here)


# ---- making zones


class Zone(NamedTuple):
    """A zone to avoid: its row without the range of x, its extent along x (mm), and its field, for most of no cells."""

    row: Floats
    extent: tuple[float, float]
    field: Floats


def _zone(
    shape: int, numbers: Sequence[Any], extent: tuple[float, float], field: Floats | None = None
) -> Zone:
    row = np.zeros(COLUMNS)
    flat = np.concatenate([np.ravel(each) for each in numbers])
    row[SHAPE], row[FIRST : FIRST + len(flat)] = shape, flat
    return Zone(row, extent, np.empty((0, 8)) if field is None else field)


def capsule(first: ArrayLike, last: ArrayLike, radius: float) -> Zone:
    """Return all points within a radius (mm) of the line between two points (3,), mm; a sphere where they are equal."""
    a, b = np.asarray(first, dtype=float), np.asarray(last, dtype=float)
    square = float((b - a) @ (b - a))
    extent = min(a[0], b[0]) - radius, max(a[0], b[0]) + radius
    return _zone(CAPSULE, (a, b - a, 1.0 / square if square > 0.0 else 0.0, radius), extent)


def box(centre: ArrayLike, half: ArrayLike, axes: ArrayLike | None = None, radius: float = 0.0) -> Zone:
    """Return a box by centre and half sizes (3,), mm, along its axes, unit vectors (3, 3) in rows, with round edges."""
    middle, size = np.asarray(centre, dtype=float), np.asarray(half, dtype=float)
    turned = np.eye(3) if axes is None else np.asarray(axes, dtype=float)
    reach = float(np.abs(turned[:, 0]) @ size) + radius
    return _zone(BOX, (middle, size, turned, radius), (middle[0] - reach, middle[0] + reach))


def half_space(point: ArrayLike, normal: ArrayLike) -> Zone:
    """Return all points behind a plane through a point (3,), mm, with a normal (3,) out of the zone."""
    out = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    return _zone(HALF_SPACE, (out, out @ np.asarray(point, dtype=float)), (-np.inf, np.inf))


def grid(values: ArrayLike, first: ArrayLike, spacing: ArrayLike) -> Zone:
    """Return a zone by distances (a, b, c), mm, negative inside, on a grid from its first corner (3,), mm.

    Outside of the grid the distance is that at its edge.
    """
    field, corner, step = (np.asarray(each, dtype=float) for each in (values, first, spacing))
    ends = [(slice(None, -1), slice(1, None))] * 3
    corners = [field[i, j, k] for i in ends[0] for j in ends[1] for k in ends[2]]
    cells = np.array(field.shape) - 1
    extent = float(corner[0]), float(corner[0] + cells[0] * step[0])
    return _zone(GRID, (corner, 1.0 / step, cells, 0.0), extent, np.stack(corners, -1).reshape(-1, 8))


def pack(zones: Sequence[Zone], far: float, more: ArrayLike = 0.0) -> Zones:
    """Return zones as arrays, larger than their shapes by `more` (mm), for distances that are exact up to `far`."""
    rows = np.array([zone.row for zone in zones]).reshape(-1, COLUMNS)
    rows[:, MORE] = more
    for row, zone, first in zip(
        rows, zones, np.cumsum([0, *(len(each.field) for each in zones)]), strict=False
    ):
        near = far + row[MORE]
        row[LOW], row[HIGH] = zone.extent[0] - near, zone.extent[1] + near
        if row[SHAPE] == GRID:
            row[FIRST + 9] = first
    return Zones(rows, np.concatenate([np.empty((0, 8)), *(zone.field for zone in zones)]), far)


NO_ZONES = pack((), np.inf)
