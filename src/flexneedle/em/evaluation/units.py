"""Metres in place of millimetres: refused, since the errors would be a thousand times too small, or absurd.

One of the two, true or measured, in metres: its points are then a thousand times nearer to their middle than those of
the other, one by one and but for the errors. Those of a sensor that is stuck may be as near, but not in the grid's
shape.

Both: a grid of less than a millimetre in all, on which the tracker scatters by less than 2 µm and errs by less than
20 µm. A small grid alone is no reason: EM trackers resolve 10 µm.
"""

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.evaluation.accuracy import jitter
from flexneedle.em.table.grid import Grid, Places
from flexneedle.errors import InputError

_ALIKE = 0.3  # RMS difference over size: a tracker may be off by this, noise about one place is off by more
_GRID_MM, _JITTER_MM, _ERROR_MM = 1.0, 2e-3, 2e-2
_HINT = "--unit m reads all lengths as metres, --unit mm as they are"


def refuse_metres(grids: list[Grid]) -> None:
    """Raise InputError if the lengths of a grid seem to be in metres."""
    for grid in grids:
        if grid.known.any() and (reason := _reason(grid.measured())):
            raise InputError(f"sensor {grid.sensor!r}, environment {grid.environment!r}: {reason}. {_HINT}")


def _reason(measured: Places) -> str:
    true, position = measured.true, measured.position
    wide, reach = _extent(true), _extent(position)
    spans = f"the true positions span {wide:.3g}, the measured ones {reach:.3g}"
    if _alike(1000.0 * position, true):
        return f"x_mm, y_mm, z_mm look like metres: {spans}"
    if _alike(1000.0 * true, position):
        return f"true_x_mm, true_y_mm, true_z_mm look like metres: {spans}"
    tiny = 0.0 < wide < _GRID_MM and reach < _GRID_MM and not jitter(measured) >= _JITTER_MM  # NaN: not known
    if tiny and float(np.abs(_aligned(position) - _aligned(true)).max()) < _ERROR_MM:
        return f"true and measured positions look like metres: {spans}"
    return ""


def _extent(points: NDArray[np.float64]) -> float:
    """Return the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two sets of points (n, 3) are arranged alike about their middles, in any frames."""
    size = _aligned(other)
    return float(np.linalg.norm(_aligned(one) - size)) < _ALIKE * float(np.linalg.norm(size))


def _aligned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n,) of points from their middle, which frames don't change."""
    distances: NDArray[np.float64] = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return distances
