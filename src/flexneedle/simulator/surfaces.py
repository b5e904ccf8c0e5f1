"""Surfaces of zones and of their margins as triangles, for views in space."""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.zones import GRID, SHAPE
from flexneedle.simulator.zones import ZoneMap
from flexneedle.types import Floats

_SEARCH = 40  # points of the search for a surface, along the longest side of the workspace
_ACROSS, _ALONG = 24, 64  # cells of a surface across its shortest side; at most along its longest
_OUTSIDE = 1e9  # mm; a value beyond the corners
Indices = NDArray[np.int64]


class Surface(NamedTuple):
    """Points (v, 3), mm, and triangles (t, 3) of their indices, counterclockwise from outside."""

    points: Floats
    triangles: Indices


def zone_surface(zones: ZoneMap, number: int, low: Floats, high: Floats, distance: float = 0.0) -> Surface:
    """Return the surface of a zone, or at a distance (mm) from it, between two corners (3,), mm.

    It is closed, by these corners where the zone leaves them, and empty where the zone is not between them.
    """
    wide = float((high - low).max()) / _SEARCH
    values, corner = _sample(zones, number, low, high, wide)
    near = np.argwhere(values - distance <= wide * 3.0**0.5)
    if not len(near):
        return Surface(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    first = np.maximum(corner + wide * (near.min(axis=0) - 1.0), low)
    last = np.minimum(corner + wide * (near.max(axis=0) + 1.0), high)
    size = last - first
    has_details = zones.packed.rows[number, SHAPE] == GRID
    finest = float(size.max()) / _ALONG
    cell = finest if has_details else max(float(size.min()) / _ACROSS, finest)
    values, corner = _sample(zones, number, first, last, cell)
    net = surface_net(np.pad(values - distance, 1, constant_values=_OUTSIDE))
    return Surface(corner + cell * (net.points - 1.0), net.triangles)


def _sample(zones: ZoneMap, number: int, low: Floats, high: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Return distances (a, b, c), mm, from a zone on a grid between two corners, and its first point."""
    axes = [np.arange(begin, end + 0.5 * spacing, spacing) for begin, end in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return zones.distances(points)[number], np.array([axis[0] for axis in axes])


def surface_net(values: Floats) -> Surface:
    """Return the surface where values (a, b, c) on a grid are 0, negative inside; points in units of the grid.

    Surface nets (Gibson 1998): in each cell that the surface crosses, a point in the mean of its crossings of the
    cell's edges; about each crossed edge, a quad of the points in the four cells around it.
    """
    cells = tuple(np.array(values.shape) - 1)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    for axis in range(3):
        crossed, places = _crossings(values, axis)
        others = [k for k in range(3) if k != axis]
        for off in product((0, 1), repeat=2):
            part = [slice(None)] * 3
            for k, begin in zip(others, off, strict=True):
                part[k] = slice(begin, begin + cells[k])
            total += places[tuple(part)]
            count += crossed[tuple(part)]
    used = count > 0
    numbers = np.cumsum(used).reshape(cells) - 1
    quads = np.concatenate([_quads(values, numbers, axis) for axis in range(3)])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Surface(total[used] / count[used, None], triangles)


def _crossings(values: Floats, axis: int) -> tuple[NDArray[np.bool_], Floats]:
    """Return which edges along an axis the surface crosses, and where (…, 3); 0 for others."""
    turned = np.moveaxis(values, axis, 0)
    begin, end = (np.moveaxis(part, 0, axis) for part in (turned[:-1], turned[1:]))
    crossed = (begin < 0.0) != (end < 0.0)
    share = begin / np.where(crossed, begin - end, 1.0)
    places = np.moveaxis(np.indices(begin.shape), 0, -1).astype(float)
    places[..., axis] += share
    return crossed, places * crossed[..., None]


def _quads(values: Floats, numbers: Indices, axis: int) -> Indices:
    """Return quads (q, 4) about the crossed edges along an axis that have four cells."""
    turned = np.moveaxis(values, [axis, (axis + 1) % 3, (axis + 2) % 3], [0, 1, 2])
    cells = np.moveaxis(numbers, [axis, (axis + 1) % 3, (axis + 2) % 3], [0, 1, 2])
    begin, end = turned[:-1, 1:-1, 1:-1], turned[1:, 1:-1, 1:-1]
    crossed = (begin < 0.0) != (end < 0.0)
    around = (cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:])
    quads = np.stack([each[crossed] for each in around], axis=-1)
    return np.where((begin < 0.0)[crossed][:, None], quads, quads[:, ::-1])
