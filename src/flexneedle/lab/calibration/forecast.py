"""Prediction of a recorded insertion from its first steps: the model's path, and the expected deviation from it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flexneedle.lab.calibration.along import FIRST_FACTORS
from flexneedle.lab.calibration.deviations import TAIL, Noise, Whitened
from flexneedle.lab.calibration.fit import Fitted, Residuals, paths_along, paths_at, residuals_at
from flexneedle.lab.calibration.prediction import Replay
from flexneedle.lab.calibration.session import Session
from flexneedle.types import Floats

_UNKNOWN = TAIL / (TAIL - 2.0)  # mean of the prior of a factor


class SensorErrors(NamedTuple):
    """Values of a sensor along the needle minus the model's, (r,), and their expected size (r,), in a unit.

    Without the offset, drift and start of the insertion. The size is by the noise and model error of the scenario.
    """

    sensor: str
    unit: str
    size: Floats
    expected: Floats


class Forecast(NamedTuple):
    """Positions (k, k, axes) in mm predicted at steps j from the readings up to step i, and their standard deviations.

    Positions up to i are estimates. The standard deviations include the error of a reading. model, slope (k, axes): the
    model's own position, and slope (rad) of the sensor's axis, at each step. along: of each sensor along the needle.
    """

    position: Floats
    sd: Floats
    model: Floats
    slope: Floats
    along: tuple[SensorErrors, ...]


def forecast(fitted: Fitted, session: Session) -> list[Forecast]:
    """Return the forecasts of other insertions of the sessions of a fit, with its point and noise."""
    problem = replace(fitted.problem, replay=Replay.of(session), means=())
    tips = residuals_at(problem, fitted.point, derivatives=False).tips
    problem = replace(problem, replay=problem.replay.corrected(tips))
    if problem.sensors:
        problem = problem.with_means(residuals_at(problem, fitted.point, derivatives=False).shapes)
    found = residuals_at(problem, fitted.point, derivatives=False)
    paths, axes = paths_at(problem, found.tips), session.axes
    along = list(_errors_along(replace(fitted, problem=problem), found))
    forecasts = []
    for n in range(len(session.recordings)):
        own = range(axes * n, axes * n + axes)
        both = [expect_deviations(paths[k], fitted.noise, found.values[k]) for k in own]
        expected, sd = np.moveaxis(np.array(both), 0, -1)
        model = np.array([found.models[k].reshape(2, -1) for k in own])
        positions, slopes = np.moveaxis(model, 1, 0).swapaxes(1, 2)
        sensors = tuple(errors for number, errors in along if number == n)
        forecasts.append(Forecast(expected + positions, sd, positions, slopes, sensors))
    return forecasts


def _errors_along(fitted: Fitted, found: Residuals) -> Iterator[tuple[int, SensorErrors]]:
    """Yield the number of the recording and the errors of each sensor along the needle with readings in it."""
    problem = fitted.problem
    paths = paths_along(problem, found)
    for means, path, each in zip(problem.means, paths, found.along, strict=True):
        factor, unit = means.fit.sensor.unit
        left = path.unexplained(each.value, fitted.factors.get(path.sensor, FIRST_FACTORS))
        expected = np.sqrt(path.white + np.diag(path.model))
        yield path.recording, SensorErrors(path.sensor, unit, factor * left, factor * expected)


def expect_deviations(path: Whitened, noise: Noise, residuals: Floats) -> tuple[Floats, Floats]:
    """Return expected deviations (k, k) of the position on an axis, and standard deviations, after each step."""
    count = len(path.deviations.depth)
    step, factors = np.arange(count), np.full(count, _UNKNOWN)
    expected, sd = np.empty((count, count)), np.empty((count, count))
    values = np.zeros(2 * count)
    values[path.known] = residuals
    for i in range(count):
        now = replace(path, known=np.logical_and(path.known, np.tile(step, 2) <= i), factors=factors)
        expected[i], variance = _predict(now, noise, values[now.known])
        sd[i] = np.sqrt(np.maximum(variance, 0.0) + noise.sd[-2] ** 2)
        if i > 0 and now.known.any():
            # Factors of intervals that are over follow from the data; later ones keep the mean of their prior.
            found = now.with_factors_for(noise, values[now.known]).factors
            factors = np.where(step <= i, found, _UNKNOWN)
    return expected, sd


def _predict(path: Whitened, noise: Noise, residuals: Floats) -> tuple[Floats, Floats]:
    """Return expected deviations (k,) of the position at all steps given residuals (r,), and their variances."""
    latent = path.latent(noise)[: len(path.deviations.depth)]
    if not path.known.any():
        return np.zeros(len(latent)), np.diag(latent)
    across = latent[:, path.known]
    solved = cho_factor(path.covariance(noise), lower=True)
    variance = np.diag(latent) - np.einsum("ij,ji->i", across, cho_solve(solved, across.T))
    return across @ cho_solve(solved, residuals), variance
