"""`points.csv`: the results at each grid point, to the last digit."""

import csv

import numpy as np
import pytest

from em_tables import GRID, random_rows, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import (
    EvaluationOptions,
    evaluate_table,
    write_evaluation,
)


def points(path, rows, **options):
    """Return the rows of `points.csv` as dictionaries of text."""
    values = write_evaluation(
        evaluate_table(write_csv(path / "t.csv", rows), EvaluationOptions(**options)), path, []
    )
    assert values["points"] == str(path / "points.csv")
    with (path / "points.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_each_grid_point_of_each_sensor_and_environment_has_a_row(tmp_path):
    rows = random_rows(1, samples=4, sensor="reference", environment="a, b") + random_rows(2, samples=4)
    found = points(tmp_path, rows)
    assert len(found) == 2 * len(GRID)
    assert [row["sensor"] for row in found] == ["tip"] * 27 + ["reference"] * 27
    for k, row in enumerate(found[27:]):
        own = [r for r in rows if r["sensor"] == "reference" and r["point_id"] == k]
        x = np.array([[r[f"{axis}_mm"] for axis in "xyz"] for r in own])
        mean, off = x.mean(axis=0), x.mean(axis=0) - GRID[k]
        assert (row["environment"], row["point_id"]) == ("a, b", str(k))
        for j, axis in enumerate("xyz"):
            assert float(row[f"true_{axis}_mm"]) == GRID[k, j]
            assert float(row[f"mean_{axis}_mm"]) == pytest.approx(mean[j], abs=1e-12)
            assert float(row[f"error_{axis}_mm"]) == pytest.approx(off[j], abs=1e-12)
        assert float(row["error_mm"]) == pytest.approx(np.linalg.norm(off), abs=1e-12)
        jitter = np.sqrt(((x - mean) ** 2).sum() / 4)
        assert float(row["jitter_mm"]) == pytest.approx(jitter, abs=1e-12)
        assert float(row["indicator"]) == pytest.approx(own[0]["indicator"], abs=1e-15)
        assert (row["samples"], row["missing"]) == ("4", "0")


def test_a_point_without_samples_has_only_its_true_position(tmp_path):
    rows = random_rows(1, samples=3)
    for row in rows[3:6]:
        row |= {"x_mm": None, "y_mm": None, "z_mm": None, "indicator": None}
    rows[6]["x_mm"] = rows[6]["y_mm"] = rows[6]["z_mm"] = None
    first, empty, partly = points(tmp_path, rows)[:3]
    assert [float(empty[f"true_{axis}_mm"]) for axis in "xyz"] == GRID[1].tolist()
    assert {empty[key] for key in ("mean_x_mm", "error_z_mm", "error_mm", "jitter_mm", "indicator")} == {""}
    assert [(row["samples"], row["missing"]) for row in (first, empty, partly)] == [
        ("3", "0"),
        ("0", "3"),
        ("2", "1"),
    ]


def test_after_registration_positions_are_in_the_stages_frame(tmp_path):
    rows = random_rows(4, samples=3)
    moved = [{**row, "x_mm": row["x_mm"] + 300.0} for row in rows]
    before, after = points(tmp_path, rows, register=True), points(tmp_path, moved, register=True)
    for one, other in zip(before, after, strict=True):
        assert float(other["mean_x_mm"]) == pytest.approx(float(one["mean_x_mm"]), abs=1e-9)
