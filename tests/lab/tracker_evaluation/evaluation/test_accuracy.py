"""Intervals of the errors, and the share of the volume beyond the largest one, by independent formulas."""

import numpy as np
import pytest

from em_tables import random_rows, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


@pytest.fixture
def rows():
    return random_rows(3, samples=5, bias=0.8)


@pytest.fixture
def found(tmp_path, rows):
    return evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions()).values()["results"][0]


def test_intervals_are_quantiles_of_resampled_points(found, rows):
    x, true = (
        np.array([[row[f"{name}{axis}_mm"] for axis in "xyz"] for row in rows]).reshape(27, 5, 3)
        for name in ("", "true_")
    )
    chosen = np.random.default_rng(0).integers(0, 27, (2000, 27))
    error = np.linalg.norm((x - true).mean(axis=1), axis=1)[chosen]
    scatter = ((x - x.mean(axis=1, keepdims=True)) ** 2).sum(axis=(1, 2))[chosen]
    drawn = {
        "rmse_mm": np.sqrt((error**2).mean(axis=1)),
        "mean_mm": error.mean(axis=1),
        "sd_mm": np.sqrt(((error - error.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) / 26),
        "jitter_mm": np.sqrt(scatter.sum(axis=1) / (27 * 5)),
    }
    for name, values in drawn.items():
        assert found["intervals"][name] == pytest.approx(np.quantile(values, (0.025, 0.975)), abs=1e-9), name


def test_a_share_beyond_the_largest_error_is_detected_in_95_of_100_grids(found):
    """27 independent points all miss a share s of the volume with probability (1 - s)^27."""
    assert (1.0 - found["beyond_max"]) ** 27 == pytest.approx(0.05)
