"""The indicator: fits and threshold against values computed by hand."""

import numpy as np
import pytest

from em_tables import GRID, rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table
from flexneedle.lab.tracker_evaluation.evaluation.indicator import fit_line

N = len(GRID)


def table(path, ideal, noisy, names=("ideal", "noisy")):
    """Two environments of one sensor, from (indicator, error) of each grid point."""
    rows = []
    for (indicator, error), name in zip((ideal, noisy), names, strict=True):
        samples = (GRID + np.outer(error, (0.0, 0.0, 1.0)))[:, None]
        rows += rows_of(GRID, samples, "reference", name, indicator=indicator.tolist())
    return write_csv(path, rows)


def planted(path, **more):
    low, high = np.linspace(0.01, 0.062, N), np.linspace(0.05, 0.57, N)
    return table(path, (low, np.where(np.arange(N) % 2, 0.7, 0.5)), (high, 9.0 * high + 0.1), **more)


def test_fits_and_threshold_are_the_planted_ones(tmp_path):
    (found,) = evaluate_table(planted(tmp_path / "t.csv"), EvaluationOptions()).values()["indicator"]
    assert found["ideal"]["mean_mm"] == pytest.approx((14 * 0.5 + 13 * 0.7) / 27)
    assert found["noisy"]["slope_mm"] == pytest.approx(9.0)
    assert found["noisy"]["intercept_mm"] == pytest.approx(0.1)
    assert found["noisy"]["scatter_mm"] == pytest.approx(0.0, abs=1e-12)
    assert found["threshold"] == pytest.approx(0.01 + 0.95 * 0.052)
    assert found["paper"]["threshold"] == 0.0547


def test_environments_may_have_other_names_and_one_or_the_indicator_may_be_missing(tmp_path):
    path = planted(tmp_path / "t.csv", names=("clear", "plate"))
    assert evaluate_table(path, EvaluationOptions()).fits == []
    (found,) = evaluate_table(path, EvaluationOptions(ideal="clear", noisy="plate")).fits
    assert found.noisy.slope_mm == pytest.approx(9.0)
    rows = rows_of(GRID, [[p + 0.1] for p in GRID], "reference", "ideal", np.linspace(0.01, 0.06, N).tolist())
    (found,) = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions()).fits
    assert (found.threshold, found.noisy) == (pytest.approx(0.0575), None)
    rows = rows_of(GRID, [[p] for p in GRID])
    evaluation = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions())
    assert evaluation.fits == []
    assert evaluation.values()["results"][0]["indicator"] is None


def test_statistics_of_single_samples_are_exact(tmp_path):
    rng = np.random.default_rng(0)
    values = rng.gamma(3.0, 0.01, (N, 40))
    rows = rows_of(GRID, [[p] * 40 for p in GRID], "reference")
    for row, value in zip(rows, values.ravel().tolist(), strict=True):
        row["indicator"] = value
    found = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions()).values()["results"][0][
        "indicator"
    ]
    expected = {"n_samples": values.size, "mean": values.mean(), "max": values.max(), "min": values.min()}
    expected |= {"p95": np.quantile(values, 0.95), "above": np.mean(values > 0.0547)}
    assert found["samples"] == pytest.approx(expected)
    assert found["p95"] == pytest.approx(np.quantile(values.mean(axis=1), 0.95))


def test_single_samples_of_shuffled_sensors_and_environments_are_not_mixed_up(tmp_path):
    rng, rows = np.random.default_rng(1), []
    for k, (sensor, name) in enumerate((s, e) for s in ("ref2", "ref1") for e in ("noisy", "ideal")):
        values = rng.uniform(k + 1.0, k + 1.5, N).tolist()
        rows += rows_of(GRID, [[p] for p in GRID], sensor, name, values)
    rng.shuffle(rows)
    found = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions()).values()["results"]
    starts = {("ref2", "noisy"): 1.0, ("ref2", "ideal"): 2.0, ("ref1", "noisy"): 3.0, ("ref1", "ideal"): 4.0}
    assert len(found) == len(starts)
    for one in found:
        start, samples = starts[one["sensor"], one["environment"]], one["indicator"]["samples"]
        assert start <= samples["min"] < samples["p95"] < start + 0.5001
        assert samples["max"] == pytest.approx(one["indicator"]["max"])


def test_a_line_through_equal_indicators_is_nan():
    found = fit_line(np.full(12, 0.1), np.arange(12.0))
    assert np.isnan(found.slope_mm)
    assert found.intervals == {"slope_mm": None, "intercept_mm": None}


def test_the_scatter_about_the_line_has_n_minus_two():
    found = fit_line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, -1.0, -1.0, 1.0]))
    assert (found.slope_mm, found.intercept_mm) == pytest.approx((0.0, 0.0))
    assert found.scatter_mm == pytest.approx(np.sqrt(4.0 / 2.0))
