"""What an evaluation knows of each grid point, as a table of its own."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from math import isfinite

import numpy as np

from flexneedle.em.evaluation.accuracy import error_vectors, errors
from flexneedle.em.evaluation.grid import Grid

POINTS_FILE = "points.csv"
_COLUMNS = (
    *("sensor", "environment", "point_id"),
    *("true_x_mm", "true_y_mm", "true_z_mm"),
    *("mean_x_mm", "mean_y_mm", "mean_z_mm"),
    *("error_x_mm", "error_y_mm", "error_z_mm", "error_mm"),
    *("samples", "missing", "jitter_mm", "indicator"),
)


def points_text(grids: Iterable[Grid]) -> str:
    """Return CSV with a row for each grid point of each grid, all digits; empty where something is not known."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for grid in grids:
        writer.writerows(_rows(grid))
    return text.getvalue()


def _rows(grid: Grid) -> Iterator[Sequence[str]]:
    points = grid.points
    count = points.position.count
    with np.errstate(invalid="ignore"):
        jitter = np.sqrt(points.position.scatter.sum(axis=1) / np.where(count > 1, count, np.nan))
    places = np.column_stack([points.true.mean, points.position.mean, error_vectors(points), errors(points)])
    others = np.column_stack([jitter, points.indicator.mean[:, 0]])
    counts = zip(count.tolist(), points.missing.tolist(), strict=True)
    for name, place, (seen, missing), other in zip(
        grid.names, places.tolist(), counts, others.tolist(), strict=True
    ):
        numbers = map(_field, place), (str(seen), str(missing)), map(_field, other)
        yield (grid.sensor, grid.environment, name, *(field for part in numbers for field in part))


def _field(value: float) -> str:
    return repr(value) if isfinite(value) else ""
