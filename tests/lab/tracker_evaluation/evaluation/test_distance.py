"""Errors by distance, and the distances at which a limit is met."""

import math

import pytest

from em_tables import rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.distance import DistanceBin, DistanceErrors
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


def bins(rmse):
    """Bins of 50 mm from 600 mm."""
    return tuple(
        DistanceBin(600.0 + 50 * k, 650.0 + 50 * k, 625.0 + 50 * k, 9, 90, value, value, value, 0.1)
        for k, value in enumerate(rmse)
    )


@pytest.mark.parametrize(
    ("smallest", "exceeded", "text"),
    [
        (None, (), "nowhere"),
        (625.0, (), "at all measured distances"),
        (675.0, (), "from 675 mm"),
        (625.0, (725.0,), "up to 675 mm, not at 725 mm"),
        (675.0, (725.0, 775.0), "from 675 mm, not at 725, 775 mm"),
    ],
)
def test_distances_nearer_than_the_nearest_bin_are_not_claimed(smallest, exceeded, text):
    assert DistanceErrors(50.0, 0.5, smallest, exceeded, bins([0.4] * 4)).limit_met == text


def test_without_a_limit_there_is_no_distance():
    assert DistanceErrors(50.0, None, None, (), bins([0.4])).limit_met == "no limit"


def test_the_rmse_of_a_bin_is_compared_with_the_limit_not_its_largest_error(tmp_path):
    """At 610 mm errors of 3 mm, at 710 mm of 0.2 and 0.9 mm, whose RMS is 0.65 mm: 0.7 mm is met from there."""
    points = [(0, 610.0, 3.0), (1, 610.0, 3.0), (2, 710.0, 0.2), (3, 710.0, 0.9)]
    rows = [
        {
            "point_id": point,
            "true_x_mm": 25.0 * point,
            "true_y_mm": 0.0,
            "true_z_mm": 0.0,
            "x_mm": 25.0 * point + error,
            "y_mm": 0.0,
            "z_mm": 0.0,
            "indicator": 0.02,
            "sensor": "coil",
            "environment": "lab",
            "distance_mm": distance,
        }
        for point, distance, error in points
        for _ in range(2)
    ]
    found = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions(limit_mm=0.7)).values()[
        "results"
    ][0]
    assert found["distance"]["smallest_mm"] == pytest.approx(710.0)
    assert [one["rmse_mm"] for one in found["distance"]["bins"]] == pytest.approx([3.0, 0.425**0.5])


def test_errors_of_a_bin_are_those_of_its_points(tmp_path):
    """Errors of 1 to 5 mm at five points, two samples 0.1 mm off each mean; a sixth point is farther away."""
    true = [(25.0 * k, 0.0, 0.0) for k in range(6)]
    samples = [[(x, k + 1.0, 0.1), (x, k + 1.0, -0.1)] for k, (x, _, _) in enumerate(true)]
    rows = rows_of(true, samples, "coil")
    rows = [{**row, "distance_mm": 710.0 if row["point_id"] < 5 else 790.0} for row in rows]
    found = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions()).values()["results"][0][
        "distance"
    ]["bins"]
    near = [found[0][name] for name in ("rmse_mm", "p95_mm", "max_mm", "jitter_mm")]
    assert near == pytest.approx([math.sqrt(11.0), 4.8, 5.0, 0.1])
    assert [bin_["n_points"] for bin_ in found] == [5, 1]
