"""Detection of positions in metres instead of millimetres, which would make errors a thousand times too small or large.

True or measured positions in metres: each point is then a thousand times closer to its centroid than the corresponding
point of the other set, up to the errors. The readings of a stuck sensor may be as close, but not in the grid's shape.

Both in metres: the grid spans less than a millimetre, with jitter below 2 µm and errors below 20 µm. A small grid alone
is not refused, since EM trackers resolve 10 µm.
"""

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation.accuracy import jitter
from flexneedle.lab.tracker_evaluation.table.grid import Grid, Moments

_SIMILAR = (
    0.3  # RMS difference over size: larger than a tracker's errors, smaller than for noise about one position
)
_GRID_MM, _JITTER_MM, _ERROR_MM = 1.0, 2e-3, 2e-2
_HINT = "Use --unit m to read all lengths as metres, --unit mm to accept them as millimetres"


def refuse_metres(grids: list[Grid]) -> None:
    """Raise InputError if the positions of a grid seem to be in metres."""
    for grid in grids:
        if grid.known.any() and (reason := _reason(grid.measured())):
            raise InputError(f"sensor {grid.sensor!r}, environment {grid.environment!r}: {reason}. {_HINT}")


def _reason(measured: Moments) -> str:
    true, position = measured.true, measured.position
    true_extent, measured_extent = _extent(true), _extent(position)
    spans = f"the true positions span {true_extent:.3g}, the measured ones {measured_extent:.3g}"
    if _similar(1000.0 * position, true):
        return f"x_mm, y_mm, z_mm seem to be in metres: {spans}"
    if _similar(1000.0 * true, position):
        return f"true_x_mm, true_y_mm, true_z_mm seem to be in metres: {spans}"
    small = 0.0 < true_extent < _GRID_MM and measured_extent < _GRID_MM
    quiet = not jitter(measured) >= _JITTER_MM  # also if it is unknown (NaN)
    if small and quiet and _largest_difference(position, true) < _ERROR_MM:
        return f"true and measured positions seem to be in metres: {spans}"
    return ""


def _extent(points: NDArray[np.float64]) -> float:
    """Return the diagonal of the bounding box of points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _similar(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two sets of points (n, 3) have similar distances from their centroids; independent of their frames."""
    size = _radii(other)
    return float(np.linalg.norm(_radii(one) - size)) < _SIMILAR * float(np.linalg.norm(size))


def _largest_difference(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.abs(_radii(one) - _radii(other)).max())


def _radii(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n,) of points from their centroid."""
    distances: NDArray[np.float64] = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return distances
