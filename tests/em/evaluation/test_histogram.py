"""Counts of single indicator values: in whose bins they are, and what they need of memory."""

import tracemalloc

import numpy as np
import pytest

from flexneedle.em.evaluation.histogram import Singles


def singles(*batches):
    found = Singles()
    for number, values in batches:
        found.add(np.asarray(number, dtype=np.int64), np.asarray(values, dtype=float))
    return found


def test_a_share_above_a_limit_is_that_of_the_bins_beyond_the_limits_own():
    found, _ = singles(([0] * 6, [0.01, 0.01, 0.01, 0.0101, 0.0101, 0.0102])).of(0)
    shares = [found.above(limit) for limit in (0.0099, 0.01, 0.0101, 0.0102, 9.0)]
    assert shares == pytest.approx([1.0, 3 / 6, 1 / 6, 0.0, 0.0])
    assert np.isnan(found.above(9.95))


def test_values_are_counted_under_their_own_number_whatever_the_batches():
    rng = np.random.default_rng(0)
    number, values = rng.permutation(np.repeat([2, 5, 700], 400)), rng.gamma(2.0, 0.05, 1200)
    found = singles(*((number[k : k + 97], values[k : k + 97]) for k in range(0, 1200, 97)), ([], []))
    for one in (2, 5, 700):
        own, (low, high) = values[number == one], found.of(one)[1]
        np.testing.assert_array_equal(found.of(one)[0].counts, np.bincount(np.rint(own * 1e4).astype(int)))
        assert (low, high) == (own.min(), own.max())
    assert found.of(3)[0].count == 0
    assert found.of(3)[1] == (np.inf, -np.inf)


def test_three_hundred_sensors_need_no_more_memory_than_their_values():
    tracemalloc.start()
    found = singles((np.arange(0, 600, 2), np.full(300, 0.05)))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 2e6
    assert np.iinfo(found.of(0)[0].counts.dtype).max > 4e9  # one bin may hold all samples of a long table
