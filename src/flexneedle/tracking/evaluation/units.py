"""Metres where millimetres were meant: a result a thousand times too good, or absurd, is not given out unasked.

One of the two, true or measured, in metres: the grid is then about a thousand times larger in one than in the other,
which no distortion does. Both: a grid of less than a millimetre in all, on which the tracker scatters by less than 2 µm
and errs by less than 20 µm. A small grid alone is no reason: EM trackers resolve 10 µm.
"""

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.tracking.evaluation.accuracy import jitter
from flexneedle.tracking.evaluation.grid import Grid, Places

__all__ = ["refuse_metres"]

_FACTOR = (300.0, 3000.0)
_GRID_MM, _JITTER_MM, _ERROR_MM = 1.0, 2e-3, 2e-2
_HINT = "--unit m reads all lengths as metres, --unit mm as they are"


def refuse_metres(grids: list[Grid]) -> None:
    """Raise InputError if the lengths of a grid seem to be in metres."""
    for grid in grids:
        reason = _reason(grid.points[grid.seen])
        if reason:
            raise InputError(f"sensor {grid.sensor!r}, environment {grid.environment!r}: {reason}. {_HINT}")


def _reason(seen: Places) -> str:
    true, position = seen.true.mean, seen.position.mean
    wide, measured = _extent(true), _extent(position)
    told = f"the true positions span {wide:.3g}, the measured ones {measured:.3g}"
    low, high = _FACTOR
    if low * measured < wide < high * measured:
        return f"x_mm, y_mm, z_mm look like metres: {told}"
    if low * wide < measured < high * wide:
        return f"true_x_mm, true_y_mm, true_z_mm look like metres: {told}"
    tiny = 0.0 < wide < _GRID_MM and measured < _GRID_MM and jitter(seen) < _JITTER_MM
    if tiny and float(np.abs(_aligned(position) - _aligned(true)).max()) < _ERROR_MM:
        return f"true and measured positions look like metres: {told}, jitter {jitter(seen):.1g}"
    return ""


def _extent(points: NDArray[np.float64]) -> float:
    """Return the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def _aligned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n,) of points from their middle, which frames don't change."""
    distances: NDArray[np.float64] = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return distances
