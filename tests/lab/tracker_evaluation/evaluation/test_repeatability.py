"""Relative distances, repeatability and orientation jitter: by hand, and against angles of each sample."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from em_tables import GRID, one, rows_of, write_csv


def test_distances_and_repeatability_of_a_table_worked_out_by_hand(tmp_path):
    """Points at 0, 10 and 30 mm, distances measured 1, 2 and 3 mm too short; samples 1, 2 and 6 mm off the mean."""
    true, measured, off = ((0, 0, 0), (10, 0, 0), (30, 0, 0)), (0, 9, 27), (1, 2, 6)
    samples = [[(x, y, 0), (x, -y, 0)] for x, y in zip(measured, off, strict=True)]
    found = one(write_csv(tmp_path / "t.csv", rows_of(true, samples)))
    spacing, own = found["relative_distance"], found["repeatability"]
    assert (spacing["mean_mm"], spacing["sd_mm"]) == pytest.approx((-2.0, 1.0))  # sd with n - 1
    assert spacing["rms_mm"] == pytest.approx(math.sqrt((1 + 4 + 9) / 3))
    assert spacing["p95_mm"] == pytest.approx(2.9)  # of 1, 2, 3
    assert (spacing["n_pairs"], spacing["max_mm"]) == (3, pytest.approx(3.0))
    assert (spacing["neighbours"], spacing["neighbours_rms_mm"]) == (1, pytest.approx(1.0))
    assert (own["median_mm"], own["worst_mm"]) == pytest.approx((2.0 * math.sqrt(2.0), 6.0 * math.sqrt(2.0)))
    assert own["worst_at"] == "2"
    assert own["axis_sd_mm"] == pytest.approx((0.0, math.sqrt(2.0 * (1 + 4 + 36) / 3), 0.0))
    assert own["sd_mm"] == pytest.approx(own["axis_sd_mm"][1])


def oriented(path, rotations, scale=1.0):
    """A table with orientations (n, m) at n grid points, of either sign and of lengths `scale` and its inverse."""
    rows = rows_of(GRID, np.repeat(GRID[:, None], len(rotations[0]), axis=1))
    quaternions = np.concatenate([own.as_quat() for own in rotations]).tolist()
    for k, (row, (x, y, z, w)) in enumerate(zip(rows, quaternions, strict=True)):
        factor = (1.0, -1.0, -1.0)[k % 3] * scale ** (1 - 2 * (k % 2))
        row |= {"qw": factor * w, "qx": factor * x, "qy": factor * y, "qz": factor * z}
    return one(write_csv(path, rows))["orientation"]


def test_any_mean_orientation_and_any_small_scatter_are_measured(tmp_path):
    rng = np.random.default_rng(0)
    middle = Rotation.random(len(GRID), random_state=1)
    rotations = [turn * Rotation.from_rotvec(rng.normal(0.0, 0.003, (40, 3))) for turn in middle]
    found = oriented(tmp_path / "t.csv", rotations)
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
    scaled = oriented(tmp_path / "t.csv", rotations, 1.004)  # rounded quaternions have other lengths than 1
    assert scaled["jitter_deg"] == pytest.approx(found["jitter_deg"], rel=1e-9)
    assert scaled["axis_jitter_deg"] == pytest.approx(found["axis_jitter_deg"], rel=1e-9)
