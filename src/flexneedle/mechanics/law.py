"""Laws of the tissue as tables: radial compression of a contact, by cells of its relative compression e = |u|/h.

A law is scaled to the stiffness 1 at e = 0: with the initial stiffness k of a contact and its compression length h

    energy k h² w(e),   force −k s(e) u with s = w′/e,   stiffness k w″ along u and k s across it.

A cell holds s as a polynomial of degree 5, from which w′, w″ and w follow: each is the exact derivative of the other,
and the cost of a law does not depend on it. From its limit on, a law continues with a linear force.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner

Floats = NDArray[np.float64]

CELLS = 256
DEGREE = 5
_ENERGY, _SHARPNESS = DEGREE + 1, DEGREE + 2  # columns: w at the start of the cell; bound of |w‴|/w″ in it
_COLUMNS = DEGREE + 3
# Of the row after the cells: limit, w′, w″, w there; 1/width.
_LIMIT, _FORCE, _STIFFNESS, _STORED, _PER_UNIT = range(5)


class Law(Protocol):
    """Radial compression of a tissue, scaled to the stiffness 1 at e = 0; functions of arrays of e in [0, limit]."""

    @property
    def limit(self) -> float:
        """Relative compression up to which the law is valid, below 1."""
        ...

    def energy(self, e: Floats) -> Floats:
        """Return w(e)."""
        ...

    def force(self, e: Floats) -> Floats:
        """Return w′(e)."""
        ...

    def stiffness(self, e: Floats) -> Floats:
        """Return w″(e)."""
        ...


class Response(NamedTuple):
    """A law at a relative compression: w′/e, w″ and a bound of |w‴|/w″, infinite beyond the limit."""

    secant: float
    tangent: float
    sharpness: float


def tables(laws: Sequence[Law]) -> Floats:
    """Return tables (k, CELLS + 1, 8) of laws."""
    return np.stack([_table(law) for law in laws])


def _table(law: Law) -> Floats:
    width = law.limit / CELLS
    start = width * np.arange(CELLS)
    # Chebyshev–Lobatto points: s is continuous.
    points = 0.5 * (1.0 - np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE))
    e = start[:, None] + width * points
    at = np.where(e > 0.0, e, 1.0)
    secant = np.where(e > 0.0, law.force(np.where(e > 0.0, e, 0.0)) / at, 1.0)
    table = np.zeros((CELLS + 1, _COLUMNS))
    table[:-1, : DEGREE + 1] = np.linalg.solve(np.vander(points, increasing=True), secant.T).T
    powers = np.arange(DEGREE + 1)
    within = width * table[:-1, : DEGREE + 1] * (start[:, None] / (powers + 1.0) + width / (powers + 2.0))
    stored = np.append(0.0, np.cumsum(within.sum(axis=1)))
    table[:-1, _ENERGY] = stored[:-1]
    edges = law.stiffness(width * np.arange(CELLS + 1.0))
    slope = np.abs(np.diff(edges)) / width / np.minimum(edges[1:], edges[:-1])
    table[:-1, _SHARPNESS] = np.maximum(
        slope, np.maximum(np.append(slope[1:], 0.0), np.append(0.0, slope[:-1]))
    )
    end = np.array([law.limit])
    table[-1, _LIMIT], table[-1, _STORED], table[-1, _PER_UNIT] = law.limit, stored[-1], 1.0 / width
    table[-1, _FORCE], table[-1, _STIFFNESS] = law.force(end)[0], law.stiffness(end)[0]
    return table


@inner
def response(table: Floats, e: float) -> Response:
    """Return the law of a table (CELLS + 1, 8) at e ≥ 0."""
    end = table[CELLS]
    if not e < end[_LIMIT]:
        force = end[_FORCE] + end[_STIFFNESS] * (e - end[_LIMIT])
        return Response(force / e, end[_STIFFNESS], math.inf)
    place = e * end[_PER_UNIT]
    cell = min(int(place), CELLS - 1)
    t, c = place - cell, table[cell]
    secant, slope = c[DEGREE], 0.0
    for k in range(DEGREE - 1, -1, -1):
        slope = slope * t + secant
        secant = secant * t + c[k]
    return Response(secant, secant + place * slope, c[_SHARPNESS])


@inner
def stored_energy(table: Floats, e: float) -> float:
    """Return w of the law of a table (CELLS + 1, 8) at e ≥ 0."""
    end = table[CELLS]
    if not e < end[_LIMIT]:
        beyond = e - end[_LIMIT]
        return float(end[_STORED] + (end[_FORCE] + 0.5 * end[_STIFFNESS] * beyond) * beyond)
    place = e * end[_PER_UNIT]
    cell = min(int(place), CELLS - 1)
    t, c = place - cell, table[cell]
    total = 0.0
    for k in range(DEGREE, -1, -1):
        total = total * t + c[k] * (cell * (1.0 / (k + 1.0)) + t * (1.0 / (k + 2.0)))
    return float(c[_ENERGY] + t * total / (end[_PER_UNIT] * end[_PER_UNIT]))
