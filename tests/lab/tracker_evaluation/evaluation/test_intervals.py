"""Intervals over grid points, by independent formulas and coverage (studies/em_coverage.py: 200 data sets)."""

import numpy as np
import pytest
from scipy import stats

from em_tables import one, random_rows, write_csv
from flexneedle.lab.tracker_evaluation.evaluation.indicator import fit_line
from flexneedle.lab.tracker_evaluation.evaluation.intervals import bootstrap, quantile_interval


def test_intervals_are_quantiles_of_resampled_points(tmp_path):
    """27 independent points all miss a share s of the volume with probability (1 - s)^27."""
    rows = random_rows(3, samples=5, bias=0.8)
    found = one(write_csv(tmp_path / "t.csv", rows))
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
    assert (1.0 - found["beyond_max"]) ** 27 == pytest.approx(0.05)


def test_the_interval_of_a_slope_covers_if_the_scatter_grows_with_the_indicator():
    rng, covered = np.random.default_rng(1), 0
    for _ in range(60):
        x = rng.uniform(0.07, 0.45, 125)
        low, high = fit_line(x, 9.6 * x + 0.05 + rng.normal(0.0, 4.0 * x)).intervals["slope_mm"]
        covered += low <= 9.6 <= high
    assert 52 <= covered <= 60


@pytest.mark.parametrize("count", [72, 100, 125, 1000])
def test_the_interval_of_a_percentile_ends_at_the_narrowest_ranks_with_a_fortieth_beyond_each(count):
    low, high = (int(rank) for rank in quantile_interval(np.arange(1.0, count + 1.0), 0.95))
    below = stats.binom(count, 0.95)  # how many of the values are below the percentile
    assert below.cdf(low - 1) <= 0.025 < below.cdf(low)
    assert below.sf(high - 1) <= 0.025 < below.sf(high - 2)


def test_few_points_have_no_interval_or_no_upper_end():
    values = np.arange(30.0)
    assert bootstrap(np.mean, values[:9]) is quantile_interval(values[:9], 0.95) is None
    assert bootstrap(np.mean, values) == bootstrap(np.mean, values)
    assert quantile_interval(np.arange(1.0, 72.0), 0.95) == (63.0, np.inf)
