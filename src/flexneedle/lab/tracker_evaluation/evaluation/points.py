"""The table of results at each grid point."""

import csv
import io
from collections.abc import Iterable, Iterator
from math import isfinite

import numpy as np

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import compute_error_vectors, compute_errors
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid

POINTS_FILE = "points.csv"
_COLUMNS = (
    *("sensor", "environment", "point_id"),
    *("true_x_mm", "true_y_mm", "true_z_mm"),
    *("mean_x_mm", "mean_y_mm", "mean_z_mm"),
    *("error_x_mm", "error_y_mm", "error_z_mm", "error_mm"),
    *("samples", "missing", "jitter_mm", "indicator"),
)


def format_points(grids: Iterable[MeasuredGrid]) -> str:
    """Return CSV with one row per grid point, with all digits; unknown values are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for grid in grids:
        writer.writerows(_rows(grid))
    return text.getvalue()


def _rows(grid: MeasuredGrid) -> Iterator[list[str]]:
    points = grid.points
    several = np.where(points.count > 1, points.count, np.nan)
    jitter = np.sqrt(points.scatter.sum(axis=1) / several)
    columns = [
        *np.hstack([points.true, points.position, compute_error_vectors(points)]).T.tolist(),
        *(
            column.tolist()
            for column in (compute_errors(points), points.count, points.missing, jitter, points.indicator)
        ),
    ]
    for name, *values in zip(grid.names, *columns, strict=True):
        yield [grid.sensor, grid.environment, name, *(repr(v) if isfinite(v) else "" for v in values)]
