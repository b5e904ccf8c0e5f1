"""Forecasts of paths whose deviations are drawn from the noise model."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.lab.calibration.deviations import TAIL, Deviations, Noise, Whitened
from flexneedle.lab.calibration.forecast import expect_deviations

COUNT = 15
DEPTH = 5.0 * np.arange(COUNT)
PLAIN = Noise(np.array([1e-3, 0.03, 0.2, 0.3, 3.0, 2e-5, 0.1, 0.03, 1e-3]))


def model_path(seed=0):
    """Return the deviations about a path of the model with turns by the guide."""
    random = np.random.default_rng(seed)
    slope = np.cumsum(0.02 * random.normal(size=COUNT))
    position = np.append(0.0, np.cumsum(2.5 * (slope[1:] + slope[:-1])))
    return Deviations(DEPTH, position, slope, np.zeros(COUNT, dtype=bool))


def draw(deviations, noise, random):
    """Return residuals (2 k,) of positions and slopes, with heavy-tailed disturbances."""
    factors = 0.5 * TAIL / random.gamma(0.5 * TAIL, size=COUNT)
    path = Whitened(deviations, np.ones(2 * COUNT, dtype=bool), factors)
    return np.linalg.cholesky(path.covariance(noise)) @ random.standard_normal(2 * COUNT)


def whole(deviations):
    return Whitened(deviations, np.ones(2 * COUNT, dtype=bool), np.ones(COUNT))


def test_the_covariance_is_the_sum_over_kinds_of_errors():
    path = Whitened(model_path(), np.arange(2 * COUNT) % 3 > 0, np.linspace(0.5, 2.0, COUNT))
    expected = path.start + np.tensordot(PLAIN.sd**2, path.parts, 1)
    np.testing.assert_allclose(path.covariance(PLAIN), expected, rtol=1e-9, atol=1e-12)


def test_intervals_cover_95_percent_at_each_distance():
    random, inside = np.random.default_rng(1), []
    for n in range(250):
        deviations = model_path(n)
        residuals = draw(deviations, PLAIN, random)
        expected, sd = expect_deviations(whole(deviations), PLAIN, residuals)
        inside.append(np.abs(expected - residuals[:COUNT]) <= 1.96 * sd)
    found = np.array(inside)
    for steps in (1, 2, 4, 8):
        pairs = [(i, i + steps) for i in range(2, COUNT - steps)]
        assert np.mean([found[:, i, j] for i, j in pairs]) == pytest.approx(0.95, abs=0.02), steps


def test_a_forecast_ignores_readings_after_its_step():
    deviations = model_path()
    residuals = draw(deviations, PLAIN, np.random.default_rng(2))
    changed = residuals.copy()
    changed[8:COUNT] += 5.0
    changed[COUNT + 8 :] -= 0.3
    (mean, sd), (other, _) = (
        expect_deviations(whole(deviations), PLAIN, each) for each in (residuals, changed)
    )
    np.testing.assert_array_equal(mean[:8], other[:8])
    assert np.abs(mean[8:] - other[8:]).max(axis=1).min() > 0.1
    assert np.isfinite(sd).all()


def test_up_to_its_step_a_forecast_is_of_the_readings():
    exact = Noise(np.append(PLAIN.sd[:-2], [1e-4, 1e-4]))
    deviations = model_path()
    residuals = draw(deviations, exact, np.random.default_rng(3))
    expected, sd = expect_deviations(whole(deviations), exact, residuals)
    for i in range(COUNT):
        np.testing.assert_allclose(expected[i, : i + 1], residuals[: i + 1], atol=1e-3)
    assert sd[-1].max() < 1e-3
    assert (np.diff(sd[3, 3:]) > 0.0).all()


def test_without_disturbances_the_first_reading_is_continued_straight():
    still = Noise(np.array([1e-9] * 7 + [0.01, 1e-4]))
    residuals = np.concatenate([np.full(COUNT, 0.4), np.full(COUNT, 0.02)])
    expected, sd = expect_deviations(whole(model_path()), still, residuals)
    np.testing.assert_allclose(expected[0], 0.4 + 0.02 * DEPTH, rtol=1e-4)
    np.testing.assert_allclose(sd[0], np.sqrt(2.0 * 0.01**2 + (1e-4 * DEPTH) ** 2), rtol=1e-3)


def test_after_exact_readings_the_next_step_has_the_variance_of_its_disturbance():
    """A random walk of the heading, q per √mm, moves the next step by q² dx³/3; its heavy tail doubles that."""
    exact = Noise(np.append([1e-3], np.full(8, 1e-7)))
    residuals = np.zeros(2 * COUNT)
    _, sd = expect_deviations(whole(model_path()), exact, residuals)
    ahead = sd[np.arange(COUNT - 1), np.arange(1, COUNT)]
    np.testing.assert_allclose(ahead, np.sqrt(2.0 * 1e-6 * 5.0**3 / 3.0), rtol=1e-3)


def test_mirrored_readings_have_the_mirrored_forecast():
    deviations = model_path()
    residuals = draw(deviations, PLAIN, np.random.default_rng(4))
    mirrored = replace(deviations, position=-deviations.position, slope=-deviations.slope)
    mean, sd = expect_deviations(whole(deviations), PLAIN, residuals)
    other, same = expect_deviations(whole(mirrored), PLAIN, -residuals)
    np.testing.assert_allclose(other, -mean, atol=1e-12)
    np.testing.assert_allclose(same, sd, rtol=1e-12)


def test_a_path_without_slopes_or_without_its_first_reading_has_a_forecast():
    deviations = model_path()
    known = np.append(np.ones(COUNT, dtype=bool), np.zeros(COUNT, dtype=bool))
    residuals = draw(deviations, PLAIN, np.random.default_rng(5))
    expected, sd = expect_deviations(Whitened(deviations, known, np.ones(COUNT)), PLAIN, residuals[:COUNT])
    assert np.isfinite(expected).all()
    assert sd[0, 5] > 2.0  # the heading is unknown at first
    known[0] = False
    expected, _ = expect_deviations(Whitened(deviations, known, np.ones(COUNT)), PLAIN, residuals[1:COUNT])
    np.testing.assert_array_equal(expected[0], np.zeros(COUNT))
