"""Laws of the tissue as tables: radial compression of a contact, by cells of its relative compression e = |u|/h.

A law is scaled to the stiffness 1 at e = 0: with the initial stiffness k of a contact and its compression length h

    energy k h² w(e),   force −k s(e) u with s = w′/e,   stiffness k w″ along u and k s across it.

A cell holds s as a polynomial of degree 5, from which w′, w″ and w follow: each is the exact derivative of the other,
and the cost of a law does not depend on it. From its limit on, a law continues with a linear force. Kernels measure e
in cells: its `place` in the table of the law.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lanes import ROW, opposite, row_of, select, some, whole
from flexneedle.types import Floats, Law

CELLS = 256
DEGREE = 5
ROWS = CELLS + 1
"""Rows of the table of a law."""
# Columns of a cell after the coefficients: w at its start, and a bound of |w‴|/w″ in it, both with e in cells.
_ENERGY, _SHARPNESS = DEGREE + 1, DEGREE + 2
# Of the row after the cells: limit, w′, w″, w there; 1/width of a cell.
_LIMIT, _FORCE, _STIFFNESS, _STORED, PER_UNIT = range(5)


class Response(NamedTuple):
    """A law at a place: w′/e, w″ and a bound of |w‴|/w″ per cell, infinite beyond the limit."""

    secant: float
    tangent: float
    sharpness: float


def tables(laws: Sequence[Law]) -> Floats:
    """Return tables (k, 257, 8) of laws."""
    return np.stack([_table(law) for law in laws])


def _table(law: Law) -> Floats:
    width = law.limit / CELLS
    start = width * np.arange(CELLS)
    # Chebyshev–Lobatto points: s is continuous.
    points = 0.5 * (1.0 - np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE))
    e = start[:, None] + width * points
    at = np.where(e > 0.0, e, 1.0)
    secant = np.where(e > 0.0, law.force(np.where(e > 0.0, e, 0.0)) / at, 1.0)
    table = np.zeros((ROWS, ROW))
    table[:-1, : DEGREE + 1] = np.linalg.solve(np.vander(points, increasing=True), secant.T).T
    powers = np.arange(DEGREE + 1)
    within = width * table[:-1, : DEGREE + 1] * (start[:, None] / (powers + 1.0) + width / (powers + 2.0))
    stored = np.append(0.0, np.cumsum(within.sum(axis=1)))
    table[:-1, _ENERGY] = stored[:-1] / width**2
    edges = law.stiffness(width * np.arange(CELLS + 1.0))
    slope = np.abs(np.diff(edges)) / np.minimum(edges[1:], edges[:-1])
    table[:-1, _SHARPNESS] = np.maximum(
        slope, np.maximum(np.append(slope[1:], 0.0), np.append(0.0, slope[:-1]))
    )
    end = np.array([law.limit])
    table[-1, _LIMIT], table[-1, _STORED], table[-1, PER_UNIT] = law.limit, stored[-1], 1.0 / width
    table[-1, _FORCE], table[-1, _STIFFNESS] = law.force(end)[0], law.stiffness(end)[0]
    return table


@inner
def response(laws: Floats, first: float, place: float) -> Response:
    """Return the law whose table begins at row `first` of `laws` (rows, 8), at e = place / `PER_UNIT` ≥ 0."""
    inside = place < CELLS
    cell = whole(select(inside, place, 0.0))
    t = place - cell
    c0, c1, c2, c3, c4, c5, _, sharpness = row_of(laws, first + cell)
    s4 = c5 * t + c4
    s3 = s4 * t + c3
    s2 = s3 * t + c2
    s1 = s2 * t + c1
    secant = s1 * t + c0
    slope = (((c5 * t + s4) * t + s3) * t + s2) * t + s1  # of the secant
    tangent = secant + place * slope
    beyond = opposite(inside)
    if some(beyond):
        limit, force, stiffness, _, per_unit, _, _, _ = row_of(laws, first + CELLS)
        e = select(beyond, place, 1.0) / per_unit
        secant = select(beyond, (force + stiffness * (e - limit)) / e, secant)
        tangent = select(beyond, stiffness, tangent)
        sharpness = select(beyond, math.inf, sharpness)
    return Response(secant, tangent, sharpness)


@inner
def stored_energy(laws: Floats, first: float, place: float) -> float:
    """Return w of the law whose table begins at row `first` of `laws` (rows, 8), times the square of `PER_UNIT`."""
    inside = place < CELLS
    cell = whole(select(inside, place, 0.0))
    t = place - cell
    c0, c1, c2, c3, c4, c5, before, _ = row_of(laws, first + cell)
    total = c5 * (cell * (1.0 / 6.0) + t * (1.0 / 7.0))
    total = total * t + c4 * (cell * (1.0 / 5.0) + t * (1.0 / 6.0))
    total = total * t + c3 * (cell * (1.0 / 4.0) + t * (1.0 / 5.0))
    total = total * t + c2 * (cell * (1.0 / 3.0) + t * (1.0 / 4.0))
    total = total * t + c1 * (cell * (1.0 / 2.0) + t * (1.0 / 3.0))
    total = total * t + c0 * (cell + t * (1.0 / 2.0))
    energy = before + t * total
    beyond = opposite(inside)
    if some(beyond):
        limit, force, stiffness, stored, per_unit, _, _, _ = row_of(laws, first + CELLS)
        more = select(beyond, place, 0.0) / per_unit - limit
        linear = (stored + (force + 0.5 * stiffness * more) * more) * per_unit * per_unit
        energy = select(beyond, linear, energy)
    return energy
