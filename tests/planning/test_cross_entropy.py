"""The cross-entropy method on functions whose minimum is known, and its update against numbers by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle.planning import cross_entropy as ce

FREE = ce.Settings(
    samples=60, elite=10, iterations=60, smoothing=0.2, tolerance=1e-12,
    lower=np.full(2, -10.0), upper=np.full(2, 10.0),
)  # fmt: skip
LEAST = np.array([1.5, -2.0])
NARROW = np.array([[10.0, 9.0], [9.0, 10.0]])  # a valley along (1, −1)


def quadratic(z):
    return np.einsum("ni,ij,nj->n", z - LEAST, NARROW, z - LEAST)


def two_wells(z):
    """Wells at ±3 on the first axis; the one at +3 is deeper by 1."""
    well = [np.sum((z - [side, 0.0]) ** 2, axis=1) for side in (3.0, -3.0)]
    return np.minimum(well[0] - 1.0, well[1])


def search(cost, settings=FREE, mean=(0.0, 0.0), sigma=(2.0, 2.0), seed=0):
    return ce.minimize(cost, ce.start(mean, sigma), settings, np.random.default_rng(seed))


def after(costs, samples, *, elite=2, smoothing=0.25, search_state=None):
    """The search_state after one iteration with these costs and samples (N, 2)."""
    search_state = search_state or ce.start(
        np.array([1.0, -1.0]), np.array([2.0, 3.0]), np.array([[1, 1 / 6], [1 / 6, 1]])
    )
    settings = replace(FREE, samples=len(costs), elite=elite, smoothing=smoothing, tolerance=0.0)
    return ce.update(search_state, settings, np.array(samples, dtype=float), np.array(costs, dtype=float))


@pytest.mark.parametrize(("cost", "least"), [(quadratic, LEAST), (two_wells, [3.0, 0.0])])
@pytest.mark.parametrize("seed", range(5))
def test_known_minimum_is_found(cost, least, seed):
    found = search(cost, seed=seed)
    np.testing.assert_allclose(found.best, least, atol=1e-3)
    np.testing.assert_allclose(found.best_cost, cost(np.array([least]))[0], atol=1e-5)


def test_update_against_numbers_by_hand():
    """Elite (0, 0), (2, 4): mean (1, 2), covariance ½ Σ c cᵀ = ((1, 2), (2, 4)); a quarter of the old is kept."""
    search_state = after([7.0, 1.0, 5.0, 2.0, 6.0], [(9, 9), (0, 0), (8, -8), (2, 4), (-9, 3)])
    np.testing.assert_allclose(search_state.mean, [0.75 * 1 + 0.25 * 1, 0.75 * 2 - 0.25 * 1], rtol=1e-14)
    floor = [4e-6, 9e-6]  # a thousandth of the first standard deviation, squared
    expected = [[0.75 * 1 + 0.25 * 4 + floor[0], 0.75 * 2 + 0.25 * 1], [1.75, 0.75 * 4 + 0.25 * 9 + floor[1]]]
    np.testing.assert_allclose(search_state.covariance, expected, rtol=1e-12)
    np.testing.assert_array_equal(search_state.best, [0.0, 0.0])
    assert search_state.best_cost == 1.0


def test_smoothing_takes_the_old_moments_of_the_last_iteration():
    once = after([1.0, 2.0, 3.0], [(0, 0), (2, 4), (9, 9)])
    twice = after([1.0, 2.0, 3.0], [(0, 0), (2, 4), (9, 9)], search_state=once)
    np.testing.assert_allclose(twice.mean, 0.75 * np.array([1, 2]) + 0.25 * once.mean, rtol=1e-14)
    floor = np.diag([4e-6, 9e-6])
    expected = 0.75 * np.array([[1, 2], [2, 4]]) + 0.25 * once.covariance + floor
    np.testing.assert_allclose(twice.covariance, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("costs", "elite", "mean", "quantile"),
    [
        *(
            ([4, 1, 5, 3, 2], elite, mean, elite)
            for elite, mean in ((1, 2.0), (2, 3.5), (3, 11 / 3), (5, 3.0))
        ),
        ([2, 1, 2, 2], 2, 1.5, 2),  # of equal costs the first drawn counts
    ],
)
def test_elite_are_the_samples_of_least_cost(costs, elite, mean, quantile):
    """The samples are 1, 2, 3 … in the order in which they are drawn."""
    search_state = after(costs, [(k + 1, 0) for k in range(len(costs))], elite=elite, smoothing=0.0)
    assert search_state.history[-1]["cost_quantiles"][1] == quantile
    assert search_state.mean[0] == pytest.approx(mean)


def test_samples_have_the_mean_and_covariance_of_the_state():
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    search_state = ce.start(np.array([1.0, -1.0]), np.array([2.0, 1.0]), np.array([[1.0, 0.75], [0.75, 1.0]]))
    wide = replace(FREE, samples=20_000, lower=np.full(2, -1e3), upper=np.full(2, 1e3))
    samples = ce.sample(search_state, wide, np.random.default_rng(0))
    np.testing.assert_allclose(samples.mean(axis=0), [1.0, -1.0], atol=0.05)
    np.testing.assert_allclose(np.cov(samples.T), covariance, rtol=0.05)


def test_first_sample_is_the_mean_and_later_the_second_the_best_so_far():
    search_state = after([3.0, 1.0, 2.0], [(5, 5), (7, -7), (1, 1)])
    samples = ce.sample(search_state, FREE, np.random.default_rng(0))
    np.testing.assert_array_equal(samples[0], search_state.mean)
    np.testing.assert_array_equal(samples[1], [7.0, -7.0])
    fresh = ce.start(np.array([1.0, -1.0]), np.array([2.0, 3.0]))
    assert (ce.sample(fresh, FREE, np.random.default_rng(0))[1] != fresh.mean).all()


class RecordedCost:
    """The quadratic cost, which keeps the samples of each iteration."""

    def __init__(self):
        self.evaluated = []

    def __call__(self, z):
        self.evaluated.append(z.copy())
        return quadratic(z)


def test_every_sample_keeps_its_bounds():
    tight = replace(FREE, lower=np.array([-0.5, 0.2]), upper=np.array([0.1, 0.3]), iterations=5)
    cost = RecordedCost()
    search(cost, tight, mean=(0.0, 0.9))
    samples = np.concatenate(cost.evaluated)
    assert (samples >= tight.lower).all()
    assert (samples <= tight.upper).all()
    assert (samples == tight.lower).any()


def test_a_coordinate_without_sigma_stays_at_its_mean():
    cost = RecordedCost()
    found = search(cost, mean=(0.0, 1.0), sigma=(2.0, 0.0))
    np.testing.assert_allclose(np.concatenate(cost.evaluated)[:, 1], 1.0, rtol=1e-12)
    assert not found.covariance[1].any()
    assert not found.covariance[:, 1].any()
    assert found.best[0] == pytest.approx(LEAST[0] - 0.9 * (1.0 - LEAST[1]), abs=1e-3)  # least on that line


@given(seed=st.integers(0, 2**32), failing=st.floats(0.0, 1.0))
@hypothesis_settings(max_examples=60)
def test_the_best_is_never_worse_than_any_sample(seed, failing):
    """A share of the samples fails."""
    rng = np.random.default_rng(seed)
    costs: list[float] = []
    sampled: list[np.ndarray] = []

    def cost(z):
        value = np.sin(5.0 * z[:, 0]) + 0.1 * np.sum(z**2, axis=1)
        value[rng.random(len(z)) < failing] = rng.choice([np.nan, np.inf, -np.inf])
        costs.extend(value)
        sampled.extend(z)
        return value

    search_state = ce.start(np.zeros(2), np.full(2, 2.0))
    small = replace(FREE, samples=8, elite=2)
    for _ in range(6):
        samples = ce.sample(search_state, small, rng)
        search_state = ce.update(search_state, small, samples, cost(samples))
        finite = [value for value in costs if np.isfinite(value)]
        assert search_state.best_cost == min(finite, default=np.inf)
        assert search_state.history[-1]["best"] == search_state.best_cost
        assert np.isfinite(search_state.mean).all()
        assert np.isfinite(search_state.covariance).all()
        if finite:
            assert any(np.array_equal(search_state.best, z) for z in sampled)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_failed_samples_are_no_elite(bad):
    search_state = after([bad, 1.0, 2.0, bad], [(9, 9), (0, 0), (2, 4), (9, 9)], elite=3, smoothing=0.0)
    np.testing.assert_allclose(search_state.mean, [1.0, 2.0])
    np.testing.assert_allclose(search_state.covariance, [[1 + 4e-6, 2], [2, 4 + 9e-6]], rtol=1e-12)
    assert not search_state.converged


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_with_only_failed_samples_the_gaussian_stays(bad):
    begin = ce.start(np.array([1.0, -1.0]), np.array([2.0, 3.0]))
    search_state = after([bad] * 4, [(9, 9)] * 4, search_state=begin)
    np.testing.assert_array_equal(search_state.mean, begin.mean)
    np.testing.assert_array_equal(search_state.covariance, begin.covariance)
    np.testing.assert_array_equal(search_state.best, begin.mean)
    assert search_state.best_cost == np.inf
    assert not search_state.converged
    assert search_state.iterations == 1


@pytest.mark.parametrize(("spread", "converged"), [(0.0999, True), (0.1001, False)])
def test_converged_once_the_elite_costs_spread_by_a_share_of_the_first_iterations(spread, converged):
    """The first spread is 4 and the tolerance a tenth: 0.4 is enough at any level of the costs."""
    settings = ce.Settings(3, 2, 9, 0.0, 0.1, np.full(1, -9.0), np.full(1, 9.0))
    samples = np.array([[1.0], [2.0], [3.0]])
    first = ce.update(ce.start(np.zeros(1), np.ones(1)), settings, samples, np.array([2.0, 5.0, -2.0]))
    assert not first.converged
    second = ce.update(first, settings, samples, np.array([-7.0 + 4.0 * spread, 5.0, -7.0]))
    assert second.converged is converged
    assert second.has_ended(settings) is converged


def test_an_iteration_with_fewer_good_samples_than_the_elite_sets_no_scale():
    """The first iteration with a finite elite sets the scale: a spread of 1, then a tenth of it."""
    settings = replace(FREE, samples=4, elite=2, tolerance=0.1)
    samples = np.arange(8.0).reshape(4, 2)
    search_state, converged = ce.start(np.zeros(2), np.ones(2)), []
    for costs in (
        [1.0, *[np.inf] * 3],
        [np.inf] * 4,
        [1.0, 2.0, 9.0, 9.0],
        [0.0, 0.11, 9.0, 9.0],
        [0.0, 0.09, 9.0, 9.0],
    ):
        search_state = ce.update(search_state, settings, samples, np.array(costs))
        converged.append(search_state.converged)
    assert converged == [False, False, False, False, True]


def stalling(usual, falls):
    """Return, for best costs that fall by `falls`, whether each iteration has converged: spread 10, tolerance 0.1."""
    settings = replace(FREE, samples=4, elite=2, tolerance=0.1, usual=usual)
    search_state, converged, best = ce.start(np.zeros(2), np.ones(2)), [], 0.0
    for fall in falls:
        best -= fall
        search_state = ce.update(
            search_state, settings, np.arange(8.0).reshape(4, 2), best + np.array([0.0, 10.0, 11.0, 12.0])
        )
        converged.append(search_state.converged)
    return converged


@pytest.mark.parametrize(("usual", "first"), [(3, 11), (15, 15), (None, None)])
def test_from_the_usual_number_on_ten_iterations_that_hardly_gain_are_enough(usual, first):
    """Ten falls of 0.0999 are less than a tenth of the spread of 10; eleven iterations are needed to detect them."""
    expected = [first is not None and k + 1 >= first for k in range(20)]
    assert stalling(usual, [0.0999] * 20) == expected


def test_while_the_best_cost_falls_the_search_continues():
    assert not any(stalling(3, [0.1001] * 30))


def test_samples_of_the_first_iteration_can_be_given():
    given = np.array([[3.0, 3.0], [1.5, -2.0], [0.0, 1.0]])
    cost, settings = RecordedCost(), replace(FREE, elite=2, iterations=2)
    found = ce.minimize(
        cost, ce.start(np.zeros(2), np.ones(2)), settings, np.random.default_rng(0), first=given
    )
    np.testing.assert_array_equal(cost.evaluated[0], given)
    assert [len(z) for z in cost.evaluated] == [3, 60]
    assert found.best_cost == 0.0


def test_search_stops_at_convergence_or_at_the_maximum_of_iterations():
    flat = search(lambda z: np.ones(len(z)))
    assert flat.converged
    assert flat.iterations == 1
    limited = search(quadratic, replace(FREE, iterations=7))
    assert not limited.converged
    assert limited.iterations == 7


def test_history_has_mean_quantiles_and_spread_of_each_iteration():
    search_state = after([7.0, 1.0, 5.0, 2.0, 6.0], [(9, 9), (0, 0), (8, -8), (2, 4), (-9, 3)])
    (entry,) = search_state.history
    assert entry["cost_mean"] == pytest.approx(21.0 / 5)
    assert entry["best"] == 1.0
    assert entry["cost_quantiles"] == (1.0, 2.0, 5.0, 7.0)  # least, ρ, median, greatest
    np.testing.assert_allclose(entry["spread"], np.sqrt(np.diag(search_state.covariance)))
    np.testing.assert_array_equal(entry["mean"], search_state.mean)
    later = after([3.0, 4.0, 5.0], [(0, 0), (1, 1), (2, 2)], search_state=search_state)
    assert [e["best"] for e in later.history] == [1.0, 1.0]
    np.testing.assert_array_equal(later.best, [0.0, 0.0])


def test_an_update_changes_neither_samples_nor_costs():
    samples, costs = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.array([np.nan, 1.0, 2.0])
    kept = samples.copy(), costs.copy()
    ce.update(ce.start(np.zeros(2), np.ones(2)), replace(FREE, samples=3, elite=2), samples, costs)
    np.testing.assert_array_equal(samples, kept[0])
    np.testing.assert_array_equal(costs, kept[1])
