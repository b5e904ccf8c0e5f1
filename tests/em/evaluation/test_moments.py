"""Moments of groups are exact far from the origin, for any number of rows in any order."""

import numpy as np
from numpy.testing import assert_allclose

from flexneedle.em.evaluation.grid import Sums
from flexneedle.em.evaluation.moments import Moments


def filled(group, column, groups, batch=None):
    moments = Moments(1)
    for start in range(0, len(group), batch or len(group)):
        some = slice(start, start + (batch or len(group)))
        moments.add(group[some], [column[some]], groups)
    return moments


def test_scatter_is_exact_to_a_billionth_of_a_millimetre_a_metre_away():
    rng = np.random.default_rng(0)
    group = rng.integers(0, 5, 200_000)
    # Deviations of exactly ±2⁻⁵ mm about a mean that is exact, too: the jitter is 0.03125 mm to the last digit.
    sign = np.where(np.arange(len(group)) % 2, 1.0, -1.0)
    group = np.repeat(group[::2], 2)
    order = rng.permutation(len(group))
    for offset in (0.0, 1024.0, -4096.0, 1e6):
        moments = filled(group[order], (offset + sign * 2.0**-5)[order], 5, batch=999)
        jitter = np.sqrt(moments.scatter[:, 0] / moments.count)
        assert_allclose(jitter, 2.0**-5, rtol=0, atol=1e-12)
        assert_allclose(moments.mean[:, 0], offset, rtol=0, atol=1e-12 * max(1.0, abs(offset)))


def test_groups_that_come_later_or_never_are_empty_until_then():
    moments = filled(np.array([0, 2, 2]), np.array([1.0, 5.0, 7.0]), 4)
    assert moments.count.tolist() == [1, 0, 2, 0]
    assert_allclose(moments.mean[:, 0], [1.0, np.nan, 6.0, np.nan])
    assert_allclose(moments.scatter[:, 0], [0.0, np.nan, 2.0, np.nan])


def test_pooled_groups_have_the_moments_of_their_samples_together():
    rng = np.random.default_rng(1)
    group, values = rng.integers(0, 6, 300), 900.0 + rng.normal(size=300)
    moments = filled(group, values, 7)  # group 6 is empty
    into = np.array([0, 1, 0, 1, 0, 1, 2])
    pooled = Sums(moments.count, moments.mean, moments.scatter).merged(into, 3)
    for k in (0, 1):
        own = values[group % 2 == k]
        assert pooled.count[k] == len(own)
        assert_allclose(pooled.mean[k, 0], own.mean(), rtol=1e-14)
        assert_allclose(pooled.scatter[k, 0], len(own) * own.var(), rtol=1e-11)
    assert (pooled.count[2], np.isnan(pooled.mean[2, 0])) == (0, True)
