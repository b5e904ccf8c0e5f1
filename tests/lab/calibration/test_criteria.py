"""Criteria of a fit: what their errors are, and how they count."""

import numpy as np
import pytest

from flexneedle.lab.calibration.criteria import (
    HORIZONS,
    Likelihood,
    PredictionErrors,
    predict_ahead,
    steps_ahead,
)
from flexneedle.lab.calibration.deviations import Deviations, Noise, Whitened

DEPTH = 5.0 * np.arange(21)


def path(moved_from=None, slopes=True):
    moved = np.zeros(21, dtype=bool)
    if moved_from is not None:
        moved[moved_from] = True
    known = np.repeat([True, slopes], 21)
    return Whitened(Deviations(DEPTH, 0.01 * DEPTH, np.full(21, 0.01), moved), known, np.ones(21))


def test_steps_ahead_are_the_nearest_ones():
    assert steps_ahead(DEPTH, 20.0)[:2] == [(0, 4), (1, 5)]
    assert steps_ahead(np.array([0.0, 1.0, 2.0]), 20.0) == []


@pytest.mark.parametrize("slopes", [True, False])
def test_a_straight_deviation_is_predicted(slopes):
    """Errors of prediction do not depend on place and direction of an insertion, from the second step on."""
    rows, _ = predict_ahead(path(slopes=slopes), Noise.first(), 100.0)
    straight = np.append(0.7 + 0.02 * DEPTH, np.full(21, 0.02))[: rows.shape[1]]
    later = np.count_nonzero(rows[:, :21], axis=1) > 3
    assert later.sum() > 30
    assert np.abs(rows @ straight)[later].max() < 0.03


def test_predictions_with_and_without_motions_are_classes_of_their_own_scale():
    _, kinds = predict_ahead(path(moved_from=10), Noise.first(), 100.0)
    assert set(kinds.tolist()) == set(range(2 * len(HORIZONS))) - {len(HORIZONS) - 1}
    paths = [path(), path(moved_from=10)]
    rng = np.random.default_rng(1)
    residuals = [rng.standard_normal(42) * np.repeat([1.0, 1e-3], 21) for _ in paths]
    given = PredictionErrors.of(paths, Noise.first(), residuals)
    errors = np.concatenate([rows @ left for rows, left in zip(given.rows, residuals, strict=True)])
    assert np.mean(errors**2) == pytest.approx(given.weight)


def test_the_likelihood_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(2)
    left = rng.standard_normal(42)
    given = Likelihood.of([path()], Noise.first(), [left])
    errors = given.rows[0] @ left
    covariance = path().covariance(Noise.first())
    expected = left @ np.linalg.solve(covariance, left) + np.linalg.slogdet(covariance)[1]
    assert given.rho(errors**2)[0].sum() + given.constant == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("criterion", [Likelihood, PredictionErrors])
def test_derivatives_of_the_loss_are_those_of_finite_differences(criterion):
    given = criterion.of([path()], Noise.first(), [np.ones(42)])
    squares, h = np.array([0.01, 0.5, 4.0]), 1e-5
    value, first, second = given.rho(squares)
    up, down = given.rho(squares + h), given.rho(squares - h)
    np.testing.assert_allclose(first, (up[0] - down[0]) / (2 * h), rtol=1e-5)
    np.testing.assert_allclose(second, (up[1] - down[1]) / (2 * h), rtol=1e-4, atol=1e-8)
    assert (value <= squares + 1e-12).all()
