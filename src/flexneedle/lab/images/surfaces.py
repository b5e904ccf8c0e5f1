"""Surfaces as triangles: a tube around a line, and where a field on a grid is zero."""

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.images.meshes import Mesh
from flexneedle.types import Floats

_SIDES = 16
_FAR_MM = 1e9


def make_tube(points: Floats, radius: float) -> Mesh:
    """Return a closed tube of a radius (mm) around a line through points (n, 3), mm; n ≥ 2."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.eye(3)[np.abs(along[0]).argmin()]
    rings = []
    for point, direction in zip(points, along, strict=True):
        across = across - (across @ direction) * direction  # turns no more than the line does
        across /= np.linalg.norm(across)
        turn = 2.0 * np.pi * np.arange(_SIDES)[:, None] / _SIDES
        rings.append(point + radius * (np.cos(turn) * across + np.sin(turn) * np.cross(direction, across)))
    corners = np.concatenate([*rings, points[[0, -1]]])
    first = _SIDES * np.arange(len(points) - 1)[:, None]
    here, after = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    a, b, c, d = (first + here, first + after, first + _SIDES + here, first + _SIDES + after)
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    start, last = len(corners) - 2, _SIDES * (len(points) - 1)
    low = np.stack([np.full(_SIDES, start), after, here], -1)
    high = np.stack([np.full(_SIDES, start + 1), last + here, last + after], -1)
    return Mesh(corners, np.concatenate([sides, low, high]))


def find_surface(field: Floats, first: Floats, spacing: float) -> Mesh | None:
    """Return the closed surface around a field's values (a, b, c) below 0 on a grid, None if there are none.

    Naive surface nets (Gibson, MICCAI 1998): one point in each cell that the surface crosses, at the mean of its
    crossings of the cell's edges; it is within √3 spacings of the surface, which is closed at the grid's faces. An edge
    has two triangles, or four where two parts of the surface touch.
    """
    closed = np.pad(field, 1, constant_values=_FAR_MM)  # the surface is at the face
    below = closed < 0.0
    if not below.any():
        return None
    points, number = _cell_points(closed, below)
    quads = [_quads(below, number, axis) for axis in range(3)]
    a, b, c, d = np.concatenate(quads).T
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return Mesh(first + spacing * (points - 1.0), triangles)


_CORNERS = list(np.ndindex(2, 2, 2))
_EDGES = [
    (one, other)
    for one in _CORNERS
    for other in _CORNERS
    if one < other and sum(np.abs(np.subtract(one, other))) == 1
]


def _cell_points(field: Floats, below: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.int64]]:
    """Return a point (n, 3) for each cell that the surface crosses, in cells, and its number for each cell, or −1."""
    shape = np.array(field.shape) - 1
    corners = {
        each: tuple(slice(k, k + size) for k, size in zip(each, shape, strict=True)) for each in _CORNERS
    }
    inside = sum(below[window].astype(np.int8) for window in corners.values())
    cells = np.argwhere((inside > 0) & (inside < 8))
    total, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for one, other in _EDGES:
        u, v = (field[tuple((cells + each).T)] for each in (one, other))
        crossed = (u < 0.0) != (v < 0.0)
        share = np.where(crossed, u / np.where(crossed, u - v, 1.0), 0.0)[:, None]
        total += crossed[:, None] * (np.array(one) + share * np.subtract(other, one))
        count += crossed
    number = np.full(shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    return cells + total / count[:, None], number


def _quads(below: NDArray[np.bool_], number: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Return the four points (m, 4) around each edge of the grid along an axis that the surface crosses."""
    low, high = ([slice(None)] * 3 for _ in range(2))
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    first, last = below[tuple(low)], below[tuple(high)]
    made = []
    for outwards in (True, False):
        at = np.argwhere((first & ~last) if outwards else (~first & last))
        u, v = ((np.arange(3) == (axis + k) % 3).astype(int) for k in (1, 2))
        around = [at - u - v, at - v, at, at - u] if outwards else [at - u - v, at - u, at, at - v]
        made.append(np.stack([number[tuple(each.T)] for each in around], -1))
    return np.concatenate(made)
