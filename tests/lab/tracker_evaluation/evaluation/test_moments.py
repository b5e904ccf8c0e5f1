"""Moments of grid points against exact fractions, far from the origin and in any order of rows."""

from fractions import Fraction
from math import sqrt

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from em_tables import GRID, rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import (
    EvaluationOptions,
    evaluate_table,
    read_table,
)


def written(path, rows, row_group_size=None):
    pq.write_table(pa.Table.from_pylist(rows), path, row_group_size=row_group_size)
    return path


def moments(rows):
    """Mean (mm) and sum of squares about it (mm²) along x, y, z of each grid point, without rounding."""
    points = {}
    for row in rows:
        points.setdefault(row["point_id"], []).append([Fraction(row[f"{axis}_mm"]) for axis in "xyz"])
    for own in points.values():
        means = [sum(column) / len(own) for column in zip(*own, strict=True)]
        yield means, [sum((row[k] - means[k]) ** 2 for row in own) for k in range(3)]


@pytest.mark.parametrize(("suffix", "offset"), [("csv", -4096.1), ("parquet", 0.0), ("parquet", 9e3)])
def test_the_jitter_is_accurate_far_from_the_origin(tmp_path, offset, suffix):
    rng = np.random.default_rng(0)
    positions = GRID[:5] + offset
    rows = rows_of(positions, [p + rng.normal(0.0, 0.04, (60, 3)) for p in positions])
    rng.shuffle(rows)
    path = tmp_path / f"t.{suffix}"
    write_csv(path, rows) if suffix == "csv" else written(path, rows)
    (grid,), _ = read_table(path, EvaluationOptions())
    exact = list(moments(sorted(rows, key=lambda row: row["point_id"])))
    for k, (means, squares) in enumerate(exact):
        for axis in range(3):
            error = Fraction(float(grid.points.position[k, axis])) - means[axis]
            assert abs(error) < Fraction(1, 10**12) + abs(means[axis]) * Fraction(1, 2**51)
            found = sqrt(grid.points.scatter[k, axis] / 60)
            assert found == pytest.approx(sqrt(squares[axis] / 60), abs=1e-9)
    jitter = sqrt(sum(sum(squares) for _, squares in exact) / 300)
    (result,) = evaluate_table(path, EvaluationOptions()).results
    assert result.accuracy.jitter_mm == pytest.approx(jitter, abs=1e-9)


@pytest.mark.long
def test_the_order_of_rows_of_a_long_table_does_not_matter(tmp_path):
    """With enough rows for several threads."""
    rng = np.random.default_rng(1)
    count = 300_000
    point, quaternion = (
        rng.integers(0, 27, count),
        np.array([1.0, 0.0, 0.0, 0.0]) + rng.normal(0.0, 0.01, (count, 4)),
    )
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    x = GRID[point] + 1000.0 + rng.normal(0.0, 0.04, (count, 3))
    table = pa.table(
        {
            "point_id": point,
            **{f"true_{axis}_mm": GRID[point, k] for k, axis in enumerate("xyz")},
            **{f"{axis}_mm": x[:, k] for k, axis in enumerate("xyz")},
            **{name: quaternion[:, k] for k, name in enumerate(("qw", "qx", "qy", "qz"))},
            "indicator": rng.gamma(3.0, 0.01, count),
            "sensor": ["tip"] * count,
            "environment": ["ideal"] * count,
        }
    )
    values = []
    for order in (np.arange(count), rng.permutation(count)):
        pq.write_table(table.take(order), tmp_path / "t.parquet", row_group_size=40_000)
        values.append(evaluate_table(tmp_path / "t.parquet", EvaluationOptions()).values()["results"])
    for found, other in zip(*values, strict=True):
        for name in ("rmse_mm", "p95_mm", "jitter_mm", "mean_mm", "sd_mm"):
            assert found[name] == pytest.approx(other[name], rel=1e-9)
        for part, name in (("orientation", "jitter_deg"), ("indicator", "mean"), ("repeatability", "sd_mm")):
            assert found[part][name] == pytest.approx(other[part][name], rel=1e-9)
    squares = sum(((x[point == k] - x[point == k].mean(axis=0)) ** 2).sum() for k in range(27))
    assert values[0][0]["jitter_mm"] == pytest.approx(np.sqrt(squares / count), abs=1e-11)


def test_grid_points_are_in_the_order_of_their_numbers_or_of_their_names(tmp_path):
    def names(ids):
        rows = rows_of(GRID[: len(ids)], GRID[: len(ids), None], names=ids)
        return read_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions())[0][0].names

    assert names([10, 9, -3, 100]) == ("-3", "9", "10", "100")
    assert names(["b", 10, 9]) == ("10", "9", "b")
