"""Prediction of a recorded insertion from its first steps: the model's path, and the expected deviation from it."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flexneedle.lab.calibration.deviations import TAIL, Noise, Whitened
from flexneedle.lab.calibration.fit import Fitted, paths_at, residuals_at
from flexneedle.types import Floats


class Forecast(NamedTuple):
    """Positions (k, k, axes) predicted at steps j from the readings up to step i, and standard deviations (mm).

    Those of steps up to i are estimates. The standard deviations are of a reading.
    """

    position: Floats
    sd: Floats


def forecast(fitted: Fitted) -> list[Forecast]:
    """Return the forecasts of the recordings of a fit, with its point and noise."""
    problem, point = fitted.problem, fitted.point
    found = residuals_at(problem, point, derivatives=False)
    paths, axes = paths_at(problem, found.tips), problem.replay.axes
    forecasts = []
    for n, one in enumerate(problem.replay.recordings):
        count = len(one.depth)
        both = [
            _on_axis(paths[axes * n + axis], fitted.noise, found.values[axes * n + axis])
            for axis in range(axes)
        ]
        model = np.stack([found.models[axes * n + axis][:count] for axis in range(axes)], axis=1)
        mean = np.stack([expected for expected, _ in both], axis=2) + model
        forecasts.append(Forecast(mean, np.stack([sd for _, sd in both], axis=2)))
    return forecasts


def _on_axis(path: Whitened, noise: Noise, residuals: Floats) -> tuple[Floats, Floats]:
    """Return expected deviations (k, k) of the position on an axis, and standard deviations, after each step."""
    count = len(path.deviations.depth)
    steps = np.tile(np.arange(count), 2)[path.known]
    expected, sd = np.empty((count, count)), np.empty((count, count))
    factors = np.ones(count)
    for i in range(count):
        # Factors of intervals that are over follow from the data; later ones have the mean of their prior.
        ahead = np.where(np.arange(count) <= i, factors, TAIL / (TAIL - 2.0))
        known = steps <= i
        now = replace(path, factors=ahead)
        covariance = now.covariance(noise)[np.ix_(known, known)]
        latent = now.latent(noise)
        across = latent[:count][:, path.known][:, known]
        solved = cho_factor(covariance, lower=True)
        expected[i] = across @ cho_solve(solved, residuals[known])
        variance = np.diag(latent)[:count] - np.einsum("ij,ji->i", across, cho_solve(solved, across.T))
        sd[i] = np.sqrt(np.maximum(variance, 0.0) + noise.sd[-2] ** 2)
        factors = _factors(path, noise, residuals, known, i, factors)
    return expected, sd


def _factors(
    path: Whitened, noise: Noise, residuals: Floats, known: Floats, i: int, factors: Floats
) -> Floats:
    """Return the factors of the intervals up to step i, from the residuals up to there."""
    if i == 0:
        return factors
    seen = np.zeros(len(path.known), dtype=bool)
    seen[np.flatnonzero(path.known)[known]] = True
    part = replace(path, known=seen, factors=np.where(np.arange(len(factors)) <= i, factors, 1.0))
    new = part.with_factors_for(noise, residuals[known]).factors
    return np.where(np.arange(len(factors)) <= i, new, 1.0)
