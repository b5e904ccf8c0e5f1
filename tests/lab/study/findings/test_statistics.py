"""Statistics of reports against hand values, NumPy and known coverage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexneedle.lab.study.findings.statistics import (
    bound_share_beyond,
    estimate_all,
    mean,
    quantile,
    ratio,
    sd,
)

VALUES = np.array([3.0, 1.0, np.nan, 2.0, 6.0])
ONCE = np.ones((1, 5), dtype=np.int64)


def own(count):
    """Return clusters of one row each."""
    return np.arange(count)


@pytest.mark.parametrize(
    ("statistic", "expected"),
    [
        (mean(VALUES), 3.0),
        (sd(VALUES), np.sqrt((0 + 4 + 1 + 9) / 3)),
        (quantile(VALUES, 0.5), 2.5),
        (quantile(VALUES, 0.95), 3.0 + 0.85 * 3.0),
        (quantile(VALUES, 0.0), 1.0),
        (quantile(VALUES, 1.0), 6.0),
        (ratio(VALUES, np.array([1.0, 2.0, 5.0, 3.0, np.nan])), 1.0),
    ],
)
def test_statistics_ignore_unknown_values(statistic, expected):
    assert_allclose(statistic(ONCE), [expected], rtol=1e-14)


def test_rows_are_weighted_by_their_multiplicity():
    counts = np.array([[2, 0, 7, 1, 1]])  # 3, 3, 2, 6; the NaN never counts
    assert_allclose(mean(VALUES)(counts), [3.5])
    assert_allclose(sd(VALUES)(counts), [np.std([3, 3, 2, 6], ddof=1)])
    assert_allclose(quantile(VALUES, 0.5)(counts), [3.0])
    assert_allclose(quantile(VALUES, 0.9)(counts), [np.quantile([3, 3, 2, 6], 0.9)])


@settings(max_examples=60)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30),
    st.floats(0, 1),
    st.integers(0, 2**32 - 1),
)
def test_quantiles_are_those_of_numpy_on_the_drawn_rows(values, share, seed):
    values = np.array(values)
    counts = np.bincount(
        np.random.default_rng(seed).integers(0, len(values), len(values)), minlength=len(values)
    )
    expected = np.quantile(np.repeat(values, counts), share)
    assert_allclose(quantile(values, share)(counts[None, :]), [expected], rtol=1e-9, atol=1e-9)


def test_without_known_values_the_statistics_are_nan():
    nothing = np.full(5, np.nan)
    found = estimate_all(
        {"mean": mean(nothing), "sd": sd(nothing), "half": quantile(nothing, 0.5)}, own(5), 50
    )
    assert all(np.isnan([e.value, e.low, e.high]).all() for e in found.values())
    assert np.isnan(estimate_all({"m": mean(np.empty(0))}, own(0))["m"].value)


def test_nine_phantoms_have_no_interval_and_ten_do():
    """For any number of insertions each: a percentile bootstrap of a few clusters is far too narrow."""
    values = np.random.default_rng(0).normal(size=40)
    few, enough = (estimate_all({"m": mean(values)}, np.arange(40) % phantoms)["m"] for phantoms in (9, 10))
    assert np.isnan([few.low, few.high]).all()
    assert enough.low < few.value == enough.value < enough.high
    (again,) = estimate_all({"m": mean(values)}, np.arange(40) % 10).values()
    (other,) = estimate_all({"m": mean(values)}, np.arange(40) % 10, seed=1).values()
    assert again == enough != other


def test_the_interval_of_a_mean_agrees_with_theory():
    """Standard error of the mean: sd √((n − 1)/n) / √n in a bootstrap; 1.96 of them on each side."""
    values = np.random.default_rng(4).normal(size=400)
    found = estimate_all({"m": mean(values)}, own(400), resamples=8000)["m"]
    assert_allclose((found.high - found.low) / 2, 1.96 * values.std() / 20, rtol=0.03)
    assert_allclose((found.high + found.low) / 2, values.mean(), atol=0.01)


def test_rows_of_one_seed_are_drawn_together():
    """Ten copies of each value add no information: the interval has the same width."""
    values = np.random.default_rng(5).normal(size=40)
    once = estimate_all({"m": mean(values)}, own(40), 4000)["m"]
    copied = estimate_all({"m": mean(np.repeat(values, 10))}, np.repeat(own(40), 10), 4000)["m"]
    apart = estimate_all({"m": mean(np.repeat(values, 10))}, own(400), 4000)["m"]
    assert_allclose([copied.low, copied.high], [once.low, once.high], rtol=1e-12)
    assert_allclose((apart.high - apart.low) / (once.high - once.low), 1 / np.sqrt(10), rtol=0.05)


def test_samples_in_chunks_are_the_same_samples(monkeypatch):
    values = np.random.default_rng(7).normal(size=50)
    whole = estimate_all({"m": mean(values), "q": quantile(values, 0.95)}, own(50))
    monkeypatch.setattr("flexneedle.lab.study.findings.statistics._CHUNK", 1000)
    assert estimate_all({"m": mean(values), "q": quantile(values, 0.95)}, own(50)) == whole


@pytest.mark.parametrize(("statistic", "truth"), [(mean, 0.0), (lambda v: quantile(v, 0.5), 0.0), (sd, 1.0)])
def test_intervals_have_about_the_nominal_coverage(statistic, truth):
    """95 % nominal; percentile intervals of 40 normal values fall a little short, of sd most."""
    rng = np.random.default_rng(8)
    trials = [
        estimate_all({"s": statistic(rng.normal(size=40))}, own(40), resamples=400, seed=k)["s"]
        for k in range(500)
    ]
    covered = np.mean([trial.low <= truth <= trial.high for trial in trials])
    assert 0.87 <= covered <= 0.975


def test_the_share_beyond_the_largest_agrees_with_the_textbook():
    """59 values: the textbook number for 95 % of all below the largest, with 95 % confidence."""
    assert bound_share_beyond(58) > 0.05 > bound_share_beyond(59)
    assert bound_share_beyond(1) == pytest.approx(0.95)
    assert np.isnan(bound_share_beyond(0))
