"""Bootstrap intervals have their nominal coverage of planted values (studies/em_coverage.py: 200 data sets)."""

import numpy as np
import pytest
from scipy import stats

from flexneedle.lab.tracker_evaluation.evaluation.indicator import fit_line
from flexneedle.lab.tracker_evaluation.evaluation.intervals import bootstrap, quantile_interval


def test_the_interval_of_a_root_mean_square_covers_nine_times_of_ten():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(60):
        squares = (rng.normal(0.0, 0.5, (125, 3)) ** 2).sum(axis=1)
        low, high = bootstrap(lambda s, axis: np.sqrt(s.mean(axis=axis)), squares)
        covered += low <= np.sqrt(3 * 0.25) <= high
    assert 52 <= covered <= 60


def test_the_interval_of_a_slope_covers_if_the_scatter_grows_with_the_indicator():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(60):
        x = rng.uniform(0.07, 0.45, 125)
        found = fit_line(x, 9.6 * x + 0.05 + rng.normal(0.0, 4.0 * x))
        low, high = found.intervals["slope_mm"]
        covered += low <= 9.6 <= high
    assert 52 <= covered <= 60


def test_few_points_have_no_interval_and_the_same_seed_gives_the_same():
    values = np.arange(30.0)
    assert bootstrap(np.mean, values[:9]) is None
    assert bootstrap(np.mean, values) == bootstrap(np.mean, values)


@pytest.mark.parametrize("count", [72, 100, 125, 1000])
def test_the_interval_of_a_percentile_ends_at_the_narrowest_ranks_with_a_fortieth_beyond_each(count):
    low, high = (int(rank) for rank in quantile_interval(np.arange(1.0, count + 1.0), 0.95))
    below = stats.binom(count, 0.95)  # how many of the values are below the percentile
    assert below.cdf(low - 1) <= 0.025 < below.cdf(low)
    assert below.sf(high - 1) <= 0.025 < below.sf(high - 2)


def test_a_percentile_of_few_points_has_no_upper_end_or_no_interval():
    assert quantile_interval(np.arange(1.0, 72.0), 0.95) == (63.0, np.inf)
    assert quantile_interval(np.arange(9.0), 0.95) is None
