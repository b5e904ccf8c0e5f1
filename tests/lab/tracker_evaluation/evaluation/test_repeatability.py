"""Relative distances and repeatability of single points, computed by hand."""

import math

import pytest

from em_tables import rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


@pytest.fixture
def found(tmp_path):
    """Points at 0, 10 and 30 mm, distances measured 1, 2 and 3 mm too short; samples 1, 2 and 6 mm off the mean."""
    true, measured, off = ((0, 0, 0), (10, 0, 0), (30, 0, 0)), (0, 9, 27), (1, 2, 6)
    samples = [[(x, y, 0), (x, -y, 0)] for x, y in zip(measured, off, strict=True)]
    path = write_csv(tmp_path / "t.csv", rows_of(true, samples))
    return evaluate_table(path, EvaluationOptions()).values()["results"][0]


def test_distances_measured_too_short_count_as_errors(found):
    spacing = found["relative_distance"]
    assert (spacing["mean_mm"], spacing["sd_mm"]) == pytest.approx((-2.0, 1.0))  # sd with n - 1
    assert spacing["rms_mm"] == pytest.approx(math.sqrt((1 + 4 + 9) / 3))
    assert spacing["p95_mm"] == pytest.approx(2.9)  # of 1, 2, 3
    assert spacing["max_mm"] == pytest.approx(3.0)
    assert (spacing["neighbours"], spacing["neighbours_rms_mm"]) == (1, pytest.approx(1.0))


def test_the_median_point_is_the_second_of_three(found):
    own = found["repeatability"]
    assert (own["median_mm"], own["worst_mm"]) == pytest.approx((2.0 * math.sqrt(2.0), 6.0 * math.sqrt(2.0)))
    assert own["sd_mm"] == pytest.approx(math.sqrt(2.0 * (1 + 4 + 36) / 3))
