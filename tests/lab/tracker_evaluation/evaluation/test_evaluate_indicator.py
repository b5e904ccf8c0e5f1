"""The indicator: fits, threshold, confusion table and ROC against values computed by hand."""

import numpy as np
import pytest

from em_tables import GRID, rows_of, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import Options, evaluate
from flexneedle.lab.tracker_evaluation.evaluation.indicator import line
from flexneedle.lab.tracker_evaluation.evaluation.separation import area, roc

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


def test_fits_threshold_and_confusion_are_those_that_were_planted(tmp_path):
    (found,) = evaluate(planted(tmp_path / "t.csv"), Options()).values()["indicator"]
    assert found["ideal"]["mean_mm"] == pytest.approx((14 * 0.5 + 13 * 0.7) / 27)
    assert found["noisy"]["slope_mm"] == pytest.approx(9.0)
    assert found["noisy"]["intercept_mm"] == pytest.approx(0.1)
    assert found["noisy"]["scatter_mm"] == pytest.approx(0.0, abs=1e-12)
    assert found["threshold"] == pytest.approx(0.01 + 0.95 * 0.052)
    counts = {
        key: found["confusion"][key] for key in ("ideal_below", "ideal_above", "noisy_below", "noisy_above")
    }
    assert counts == {"ideal_below": 25, "ideal_above": 2, "noisy_below": 1, "noisy_above": 26}
    assert found["paper"]["threshold"] == 0.0547


def test_the_environments_can_have_other_names(tmp_path):
    path = planted(tmp_path / "t.csv", names=("clear", "plate"))
    evaluation = evaluate(path, Options())
    (found,) = evaluation.values()["indicator"] or [None]
    assert found is None
    assert any("use --ideal and --noisy to name the two" in note for note in evaluation.notes)
    (found,) = evaluate(path, Options(ideal="clear", noisy="plate")).values()["indicator"]
    assert found["noisy"]["slope_mm"] == pytest.approx(9.0)


def test_one_environment_gives_a_threshold_but_no_separation(tmp_path):
    rows = rows_of(GRID, [[p + 0.1] for p in GRID], "reference", "ideal", np.linspace(0.01, 0.06, N).tolist())
    (found,) = evaluate(write_csv(tmp_path / "t.csv", rows), Options()).values()["indicator"]
    assert found["threshold"] == pytest.approx(0.0575)
    assert (found["noisy"], found["confusion"], found["auc"]) == (None, None, None)


def test_a_sensor_without_indicator_has_no_analysis(tmp_path):
    evaluation = evaluate(write_csv(tmp_path / "t.csv", rows_of(GRID, [[p] for p in GRID])), Options())
    assert evaluation.separations == []
    assert evaluation.values()["results"][0]["indicator"] is None


def test_percentiles_of_single_samples_are_known_to_half_a_ten_thousandth(tmp_path):
    rng = np.random.default_rng(0)
    values = rng.gamma(3.0, 0.01, (N, 40))
    rows = rows_of(GRID, [[p] * 40 for p in GRID], "reference")
    for row, value in zip(rows, values.ravel().tolist(), strict=True):
        row["indicator"] = value
    found = evaluate(write_csv(tmp_path / "t.csv", rows), Options()).values()["results"][0]["indicator"]
    assert found["samples"]["p95"] == pytest.approx(np.quantile(values, 0.95), abs=0.5001e-4)
    assert found["samples"]["max"] == values.max()
    assert found["samples"]["min"] == values.min()
    assert found["p95"] == pytest.approx(np.quantile(values.mean(axis=1), 0.95))


def test_single_samples_of_shuffled_sensors_and_environments_are_not_mixed_up(tmp_path):
    rng, rows = np.random.default_rng(1), []
    for k, (sensor, name) in enumerate((s, e) for s in ("ref2", "ref1") for e in ("noisy", "ideal")):
        values = rng.uniform(k + 1.0, k + 1.5, N).tolist()
        rows += rows_of(GRID, [[p] for p in GRID], sensor, name, values)
    rng.shuffle(rows)
    found = evaluate(write_csv(tmp_path / "t.csv", rows), Options()).values()["results"]
    starts = {("ref2", "noisy"): 1.0, ("ref2", "ideal"): 2.0, ("ref1", "noisy"): 3.0, ("ref1", "ideal"): 4.0}
    for one in found:
        start, samples = starts[one["sensor"], one["environment"]], one["indicator"]["samples"]
        assert start <= samples["min"] < samples["p95"] < start + 0.5001
        assert samples["max"] == pytest.approx(one["indicator"]["max"])


def test_with_one_sample_per_point_both_thresholds_are_equal(tmp_path):
    level = np.linspace(0.01, 0.5, N) ** 2
    (found,) = evaluate(
        table(tmp_path / "t.csv", (level, np.ones(N)), (level, np.ones(N))), Options()
    ).values()["indicator"]
    assert found["samples_threshold"] == pytest.approx(found["threshold"], abs=0.5001e-4)
    above = np.mean(level > found["threshold"])
    assert found["samples_above"] == {"ideal": above, "noisy": above}


def test_single_samples_may_have_very_large_indicators(tmp_path):
    level = np.where(np.arange(N) < 10, 0.01, 50.0)
    (found,) = evaluate(
        table(tmp_path / "t.csv", (level, np.ones(N)), (level, np.ones(N))), Options()
    ).values()["indicator"]
    assert found["threshold"] == pytest.approx(50.0)
    assert found["samples_threshold"] == pytest.approx(50.0)
    assert found["samples_above"] == {"ideal": 0.0, "noisy": 0.0}


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [([1, 2], [3, 4], 1.0), ([3, 4], [1, 2], 0.0), ([1, 2], [1, 2], 0.5), ([1, 2, 3], [2, 4], 4.5 / 6)],
)
def test_the_area_counts_pairs_and_equals_that_under_the_curve(low, high, expected):
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    assert area(low, high) == pytest.approx(expected)
    false_alarms, detected = roc(low, high)
    assert np.trapezoid(detected, false_alarms) == pytest.approx(expected)
    assert (false_alarms[0], detected[0], false_alarms[-1], detected[-1]) == (0.0, 0.0, 1.0, 1.0)


def test_ties_count_half_in_the_interval_of_the_area_too(tmp_path):
    level = np.where(np.arange(N) < 20, 0.1, 0.2)  # the same in both, most pairs tie
    path = table(tmp_path / "t.csv", (level, np.ones(N)), (level, np.ones(N)))
    (found,) = evaluate(path, Options()).values()["indicator"]
    low, high = found["auc_interval"]
    assert found["auc"] == pytest.approx(0.5)
    assert low < 0.5 < high
    assert low + high == pytest.approx(1.0, abs=0.05)


def test_the_interval_of_the_area_agrees_with_a_loop_over_resamples(tmp_path):
    rng = np.random.default_rng(5)
    low, high = rng.normal(0.05, 0.01, N), rng.normal(0.06, 0.01, N)
    path = table(tmp_path / "t.csv", (low, np.ones(N)), (high, np.ones(N)))
    (found,) = evaluate(path, Options()).values()["indicator"]
    drawn = [np.mean(rng.choice(high, N)[:, None] > rng.choice(low, N)) for _ in range(2000)]
    ends = np.quantile(drawn, (0.025, 0.975))
    assert found["auc_interval"] == pytest.approx(ends, abs=0.1 * np.ptp(ends))


def test_a_line_through_equal_indicators_is_nan():
    found = line(np.full(12, 0.1), np.arange(12.0))
    assert np.isnan(found.slope_mm)
    assert found.intervals == {"slope_mm": None, "intercept_mm": None}


def test_the_scatter_about_the_line_has_n_minus_two():
    found = line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, -1.0, -1.0, 1.0]))
    assert (found.slope_mm, found.intercept_mm) == pytest.approx((0.0, 0.0))
    assert found.scatter_mm == pytest.approx(np.sqrt(4.0 / 2.0))
