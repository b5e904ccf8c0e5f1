"""Sensors along the needle in a calibration: residuals of their readings, derivatives, and covariances.

The errors of a sensor that last for a session have the priors of the identification: offset, gain, turn, and the place
of each site. The residuals of an insertion have, by the values of a sensor, the covariance

    a² noise + b² model + offset + drift + start

white noise of the means at a step, an error of the model that is correlated over `_LASTING_MM` of advance, an offset
and a drift of that insertion, and the lateral position and heading with which the needle begins, which are unknown for
the tip, too. The factors a and b follow from the residuals, by the greatest likelihood. In the fit the error of the
model counts once for all insertions of a session, and all values of a sensor in a direction, in which it is alike.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from flexneedle.errors import InputError
from flexneedle.estimation.along import Bins, SensorFit, SensorPriors, Timeline
from flexneedle.lab.calibration.criteria import Criterion
from flexneedle.lab.calibration.session import Recording
from flexneedle.scenario.sensors.sensor import Sensor, turn
from flexneedle.types import THETA, Floats, Needles, Reading, X, Y

_LASTING_MM = 20.0
_START = (5.0, 0.1)  # standard deviations (mm, rad) of the unknown start, as of the tip (deviations.py)
_SHIFT_MM, _TILT = 0.1, 1e-3  # steps of differences
_FACTORS = ((0.0, math.log(30.0)), (math.log(2.0), math.log(100.0)))
"""Bounds of the factors on noise and model error. The identification fits base, bend and the modulus along the depth,
too; without these the exact rod's curvature is up to 12 % off the model's (studies/calibration_sensors.py)."""
FIRST_FACTORS = np.array([1.0, 2.0])
"""Factors at the start of a fit."""
_AT_REST = Timeline.of((), 0.0)
_LEAST_SD = 1e-9  # of an offset that is known
_HEAVY = 2.0  # standard deviations from which a residual counts less


def lay_out(sensors: Sequence[Sensor], axes: int, begin: int) -> tuple[tuple[SensorFit, ...], list[float]]:
    """Return sensors with the places of their errors from `begin` on, and prior standard deviations of the errors."""
    found: list[SensorFit] = []
    sds: list[float] = []
    for sensor in sensors:
        priors = SensorPriors.of(sensor)._replace(offset=max(sensor.offset_sd, _LEAST_SD), clock=0.0)
        one, more = SensorFit.begin(sensor, axes, begin + len(sds), priors, np.zeros(0))
        found.append(one)
        sds += more
    return tuple(found), sds


class StepMeans(NamedTuple):
    """Means of the readings of a sensor at the steps of a recording, by its number."""

    recording: int
    fit: SensorFit
    bins: Bins


def read_means(
    number: int, one: Recording, sensors: Sequence[SensorFit], shapes: Floats, length: float
) -> Iterator[StepMeans]:
    """Yield the means of each sensor with readings in a recording; shapes (k, n, 5): of the predicted needle.

    Raises InputError for rows of another shape than the sensor's.
    """
    for fit in sensors:
        readings = [each for each in one.readings if each.sensor == fit.name]
        total, count = np.zeros((2, len(one.depth), fit.size))
        for each in readings:
            needle = Needles(shapes[each.step][None], length / (shapes.shape[1] - 1))
            try:
                value = fit.sensor.read(Reading(0.0, each.rows), needle, fit.axes)
            except ValueError as error:
                raise InputError(f"{one.session}/{one.name}: readings of {fit.name}: {error}") from None
            seen = np.isfinite(value)
            total[each.step, seen] += value[seen]
            count[each.step, seen] += 1.0
        steps = np.flatnonzero(count.any(axis=1))
        facing = np.exp(1j * one.roll[steps]) if fit.sensor.rolls else np.ones(len(steps), dtype=complex)
        mean = total[steps] / np.maximum(count[steps], 1.0)
        mean = turn(mean, facing, fit.axes) if fit.sensor.rolls else mean
        if len(steps):
            part = np.ones(len(steps))
            yield StepMeans(number, fit, Bins(steps, part, mean, count[steps], facing, one.time[steps]))


class Along(NamedTuple):
    """Residuals (r,) of a sensor's means in a recording, and their derivatives (r, p + s), of the opposite sign."""

    value: Floats
    slopes: Floats


def residuals_along(
    means: StepMeans, one: Recording, shapes: Floats, length: float, steps: Floats, point: Floats
) -> Along:
    """Return the residuals at a point (p + s,).

    shapes (1 + p, k, n, 5): needles of a length (mm) at the point, and with each parameter changed by one of the steps
    (p,), or at the point alone.
    """
    fit, bins = means.fit, means.bins
    ends = fit.quantities(shapes[:, bins.index], length)
    known, depth = bins.count > 0.0, one.depth[bins.index]
    at_ends = np.concatenate([ends[0, :1], ends[0]])
    at = replace(bins, index=np.arange(len(depth)))
    value = bins.value - fit.expected(at, at_ends, depth, point)
    slopes = np.zeros((len(depth), len(point), fit.size))
    for k, step in enumerate(steps.tolist()[: len(ends) - 1]):
        slopes[:, k] = (ends[1 + k, ..., 0] - ends[0, ..., 0]) / step
    jacobian = fit.jacobian(at, at_ends, depth, slopes, point, _AT_REST)
    return Along(value[known], jacobian[known])


@dataclass(frozen=True, eq=False)
class AlongPath:
    """Covariances of the residuals (r,) of a sensor in a recording.

    recording: its number; sensor: name; white (r,): variances of the means; model (r, r): of the model's error; fixed
    (r, r): of offset, drift and start; alike: insertions of the session times values in a direction that have the same
    error of the model.
    """

    recording: int
    sensor: str
    white: Floats
    model: Floats
    fixed: Floats
    alike: int

    def covariance(self, factors: Floats, alike: int = 1) -> Floats:
        """Return the covariance (r, r), with factors (2,) on the standard deviations of noise and model error.

        alike: number of insertions and values whose mean has the model's error of one.
        """
        found: Floats = (
            factors[0] ** 2 * np.diag(self.white) + alike * factors[1] ** 2 * self.model + self.fixed
        )
        return found

    def unexplained(self, residuals: Floats, factors: Floats) -> Floats:
        """Return residuals (r,) less the expected offset, drift and start of the insertion."""
        found: Floats = residuals - self.fixed @ np.linalg.solve(self.covariance(factors), residuals)
        return found


def path_along(
    means: StepMeans, one: Recording, shapes: Floats, length: float, target: float, found: Along, alike: int
) -> AlongPath:
    """Return the covariances about needles with shapes (k, n, 5); target: depth (mm) to which drifts refer.

    alike: insertions of the session.
    """
    fit, bins = means.fit, means.bins
    sensor, known = fit.sensor, bins.count > 0.0
    at = shapes[bins.index]
    planned = sensor.predict(Needles(at, length / (at.shape[1] - 1)), fit.axes)
    depth = np.repeat(one.depth[bins.index], known.sum(axis=1))
    apart, value = np.abs(depth[:, None] - depth), np.nonzero(known)[1]
    size = sensor.model_error(planned)[known]
    same = value[:, None] == value
    model = np.outer(size, size) * np.exp(-apart / _LASTING_MM) * same
    offsets = found.slopes[:, fit.slots.offset]
    width = fit.axes if sensor.paired else 1
    drifts = offsets.reshape(len(depth), -1, width).sum(axis=1)
    grown = np.maximum(np.minimum(depth[:, None], depth), 0.0) / target
    starts = _starts(means, one, at, length, planned)[known]
    white = (sensor.noise**2 / np.maximum(bins.count, 1.0) + sensor.wander_sd**2)[known]
    fixed = sensor.offset_sd**2 * offsets @ offsets.T + starts @ starts.T
    fixed += sensor.drift_sd**2 * grown * (drifts @ drifts.T)
    return AlongPath(means.recording, fit.name, white, model, fixed, alike * sensor.alike)


def _starts(means: StepMeans, one: Recording, at: Floats, length: float, planned: Floats) -> Floats:
    """Return the effects (b, d, 2 · axes) of the unknown start, of a standard deviation each."""
    found = []
    for axis in range(means.fit.axes):
        shifted, tilted = at.copy(), at.copy()
        shifted[..., Y + axis] += _SHIFT_MM
        tilted[..., Y + axis] += _TILT * (at[..., X] - one.depth[0])
        tilted[..., THETA + axis] += _TILT
        for moved, step, sd in ((shifted, _SHIFT_MM, _START[0]), (tilted, _TILT, _START[1])):
            needles = Needles(moved, length / (at.shape[1] - 1))
            found.append((means.fit.sensor.predict(needles, means.fit.axes) - planned) * (sd / step))
    return np.stack(found, axis=-1)


def estimate_factors(
    paths: Sequence[AlongPath], residuals: Sequence[Floats], first: dict[str, Floats]
) -> dict[str, Floats]:
    """Return the factors (2,) of each sensor with the greatest likelihood of residuals, (r,) for each path."""
    found = {}
    for name, start in first.items():
        own = [(path, left) for path, left in zip(paths, residuals, strict=True) if path.sensor == name]
        ended = minimize(_loss, np.log(start), (own,), method="L-BFGS-B", bounds=_FACTORS)
        found[name] = np.exp(ended.x)
    return found


def _loss(logs: Floats, own: Sequence[tuple[AlongPath, Floats]]) -> float:
    """Return −2 ln of the likelihood."""
    total = 0.0
    for path, left in own:
        root = np.linalg.cholesky(path.covariance(np.exp(logs)))
        white = solve_triangular(root, left, lower=True)
        total += float(white @ white + 2.0 * np.log(np.diag(root)).sum())
    return total


@dataclass(frozen=True, eq=False)
class Joint:
    """A criterion of the tip's residuals, with the likelihood of residuals along the needle.

    A residual beyond `_HEAVY` standard deviations counts less, by the pseudo-Huber loss.
    """

    tip: Criterion
    along: list[Floats]
    logs: float

    @classmethod
    def of(cls, tip: Criterion, paths: Sequence[AlongPath], factors: dict[str, Floats]) -> "Joint":
        """Return the criterion; factors: by sensor."""
        roots = [np.linalg.cholesky(path.covariance(factors[path.sensor], path.alike)) for path in paths]
        rows = [solve_triangular(root, np.eye(len(root)), lower=True) for root in roots]
        return cls(tip, rows, 2.0 * sum(float(np.log(np.diag(root)).sum()) for root in roots))

    @property
    def rows(self) -> list[Floats]:
        """Matrices (a, r) for each path: errors by residuals, scaled and weighted."""
        return [*self.tip.rows, *self.along]

    @property
    def constant(self) -> float:
        """Part of the loss by the scales of the errors."""
        return self.tip.constant + self.logs

    def rho(self, squares: Floats) -> Floats:
        """Return the loss, and its first and second derivatives (3, m), by squared errors (m,)."""
        own = len(squares) - sum(map(len, self.along))
        z = 1.0 + squares[own:] / _HEAVY**2
        along = np.stack([2.0 * _HEAVY**2 * (np.sqrt(z) - 1.0), z**-0.5, -0.5 / _HEAVY**2 * z**-1.5])
        return np.hstack([self.tip.rho(squares[:own]), along])
