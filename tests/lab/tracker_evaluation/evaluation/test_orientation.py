"""Orientation jitter against angles computed for each sample."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from em_tables import GRID, rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


def table(path, rotations):
    """A table with the given orientations (n, m) at n grid points, of either sign."""
    rows = rows_of(GRID, np.repeat(GRID[:, None], len(rotations[0]), axis=1))
    quaternions = np.concatenate([own.as_quat() for own in rotations])
    for row, (x, y, z, w), sign in zip(
        rows, quaternions.tolist(), np.resize([1, -1, -1], len(rows)), strict=True
    ):
        row |= {"qw": sign * w, "qx": sign * x, "qy": sign * y, "qz": sign * z}
    return write_csv(path, rows)


def test_any_mean_orientation_and_any_small_scatter_are_measured(tmp_path):
    rng = np.random.default_rng(0)
    middle = Rotation.random(len(GRID), random_state=1)
    rotations = [one * Rotation.from_rotvec(rng.normal(0.0, 0.003, (40, 3))) for one in middle]
    found = evaluate_table(table(tmp_path / "t.csv", rotations), EvaluationOptions()).values()["results"][0][
        "orientation"
    ]
    angle, axis = [], []
    for own in rotations:
        angle.append((own.mean().inv() * own).magnitude())
        directions = own.apply([0.0, 0.0, 1.0])
        towards = directions.mean(axis=0) / np.linalg.norm(directions.mean(axis=0))
        axis.append(np.arctan2(np.linalg.norm(np.cross(directions, towards), axis=1), directions @ towards))
    assert found["jitter_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(np.square(angle)))), rel=1e-4)
    assert found["axis_jitter_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(np.square(axis)))), rel=1e-4)
    worst = int(found["worst_at"])
    assert worst == np.argmax([np.mean(np.square(own)) for own in angle])


def test_quaternions_that_are_rounded_to_a_percent_are_scaled_to_length_1(tmp_path):
    rng = np.random.default_rng(2)
    rotations = [Rotation.from_rotvec(rng.normal(0.0, 0.003, (20, 3))) for _ in GRID]
    path = table(tmp_path / "t.csv", rotations)
    before = evaluate_table(path, EvaluationOptions()).values()["results"][0]["orientation"]
    header, *lines = path.read_text().splitlines()
    names = header.split(",")
    scaled = []
    for k, line in enumerate(lines):
        fields = line.split(",")
        for name in ("qw", "qx", "qy", "qz"):
            fields[names.index(name)] = repr(float(fields[names.index(name)]) * (1.004, 0.996)[k % 2])
        scaled.append(",".join(fields))
    path.write_text("\n".join([header, *scaled]) + "\n")
    after = evaluate_table(path, EvaluationOptions()).values()["results"][0]["orientation"]
    assert after["jitter_deg"] == pytest.approx(before["jitter_deg"], rel=1e-9)
    assert after["axis_jitter_deg"] == pytest.approx(before["axis_jitter_deg"], rel=1e-9)
