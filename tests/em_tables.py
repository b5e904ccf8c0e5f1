"""Tables of measurements for the tests, and a second, plain implementation of the paper's equations."""

import csv

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.tables.columns import REQUIRED
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table

GRID = np.stack(np.meshgrid(*[np.arange(3) * 25.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def rows_of(true, samples, sensor="tip", environment="ideal", indicator=None, names=None):
    """Rows of samples (list of (m_i, 3)) at true positions (n, 3); indicator: one for each point, or None."""
    names = range(len(true)) if names is None else names
    indicator = [None] * len(true) if indicator is None else indicator
    return [
        dict(zip(REQUIRED, (name, *map(float, p), *map(float, x), i, sensor, environment), strict=True))
        for name, p, own, i in zip(names, true, samples, indicator, strict=True)
        for x in own
    ]


def random_rows(seed=0, samples=20, bias=0.5, jitter=0.07, offset=0.0, **more):
    """A grid with a separate bias at each point."""
    rng = np.random.default_rng(seed)
    middle = GRID + offset + rng.normal(0.0, bias, GRID.shape)
    drawn = [p + rng.normal(0.0, jitter, (samples, 3)) for p in middle]
    return rows_of(GRID + offset, drawn, indicator=rng.uniform(0.01, 0.05, len(GRID)).tolist(), **more)


def write_csv(path, rows, header=None, delimiter=","):
    """Write rows with all digits, None as an empty field; header: other names of the columns, in their order."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n", delimiter=delimiter)
        writer.writerow(header or list(rows[0]))
        writer.writerows([_field(value) for value in row.values()] for row in rows)
    return path


def _field(value):
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else value


def plain(rows):
    """RMSE, 95 %, max, jitter, mean and sd of the errors by two passes over all rows (paper, section IV-B)."""
    points = {}
    for row in rows:
        points.setdefault(row["point_id"], []).append(row)
    error, square, count = [], 0.0, 0
    for own in points.values():
        x = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in own], dtype=np.longdouble)
        true = np.array([own[0][f"true_{axis}_mm"] for axis in "xyz"], dtype=np.longdouble)
        error.append(float(np.sqrt(((x.mean(axis=0) - true) ** 2).sum())))
        square += ((x - x.mean(axis=0)) ** 2).sum()
        count += len(x)
    error = np.array(error)
    return {
        "rmse_mm": float(np.sqrt((error**2).mean())),
        "p95_mm": float(np.quantile(error, 0.95)),
        "max_mm": float(error.max()),
        "jitter_mm": float(np.sqrt(square / count)),
        "mean_mm": float(error.mean()),
        "sd_mm": float(error.std(ddof=1)),
    }


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        evaluate_table(path, EvaluationOptions(**options))
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def one(path, **options):
    return evaluate_table(path, EvaluationOptions(**options)).values()["results"][0]
