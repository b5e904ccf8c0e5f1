"""The fit: robust least squares of the errors of predictions ahead, alternating with the noise they follow from."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from flexneedle.estimation.along import SensorFit
from flexneedle.lab.calibration.along import (
    FIRST_FACTORS,
    Along,
    AlongPath,
    Joint,
    StepMeans,
    estimate_factors,
    lay_out,
    path_along,
    read_means,
    residuals_along,
)
from flexneedle.lab.calibration.criteria import Criterion, predict_ahead
from flexneedle.lab.calibration.deviations import KINDS, Deviations, Noise, Whitened, estimate_noise
from flexneedle.lab.calibration.parameters import Parameter, make_needle, trial_of
from flexneedle.lab.calibration.prediction import Replay
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import Flags, Floats

_ROUNDS = 10  # of parameters, noise and weights
_SETTLED = 0.1  # change of a parameter, in standard deviations, at which the rounds end
_AXIS_SD = 0.2  # rad; prior standard deviation of the sensor's axis about the needle's
_LEVER_SD = 10.0  # mm; prior standard deviation of the lever of the sensor
_FAR = 20.0  # standard deviations, to the bounds of axis and lever


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit: scenario, parameters, recordings, and sensors along the needle whose readings count.

    The point of a fit has the p parameters, then for each session the slope (rad) of the sensor's axis on each axis,
    and the lever of the sensor (mm): its distance from the point whose path the model predicts, along the needle. Then
    for each session the errors of the sensors along the needle. means: of their readings, from the start of a fit on.
    """

    scenario: Scenario
    parameters: tuple[Parameter, ...]
    replay: Replay
    sensors: tuple[Sensor, ...] = ()
    means: tuple[StepMeans, ...] = ()

    @cached_property
    def sessions(self) -> tuple[str, ...]:
        """Names of the sessions."""
        return tuple(dict.fromkeys(one.session for one in self.replay.recordings))

    @property
    def moves(self) -> bool:
        """True if guide or base moves in a recording."""
        return not all(one.rests for one in self.replay.recordings)

    @cached_property
    def _nuisances(self) -> Floats:
        """Standard deviations of what is fitted besides the parameters."""
        tips = np.tile([*(_AXIS_SD,) * self.replay.axes, _LEVER_SD], len(self.sessions))
        return np.append(tips, [sd for _, sds in self._along for sd in sds])

    @cached_property
    def _along(self) -> list[tuple[tuple[SensorFit, ...], list[float]]]:
        """Sensors along the needle of each session, and standard deviations of their errors."""
        begin = len(self.parameters) + (self.replay.axes + 1) * len(self.sessions)
        found = []
        for _ in self.sessions:
            found.append(lay_out(self.sensors, self.replay.axes, begin))
            begin += len(found[-1][1])
        return found

    @cached_property
    def start(self) -> Floats:
        """The prior's mean."""
        return np.append([each.start for each in self.parameters], 0.0 * self._nuisances)

    @cached_property
    def sd(self) -> Floats:
        """Standard deviations of the prior."""
        return np.append([each.sd for each in self.parameters], self._nuisances)

    @cached_property
    def bounds(self) -> Floats:
        """Lower and upper bounds (2, p + s)."""
        far = _FAR * self._nuisances
        low = np.append([each.low for each in self.parameters], -far)
        return np.stack([low, np.append([each.high for each in self.parameters], far)])

    def carry_out(self, points: Sequence[Floats]) -> tuple[Floats, Flags, Floats]:
        """Return the tips (v, n, k, 5) at points, whether all solves converged (v, n), and shapes for the sensors."""
        trials = [trial_of(self.scenario, self.parameters, point[: len(self.parameters)]) for point in points]
        wanted = ("shapes",) if self.sensors else ()
        return self.replay.carry_out([make_needle(self.scenario, trial) for trial in trials], wanted)

    def with_means(self, shapes: Floats) -> "Problem":
        """Return the problem with the readings of the sensors, at needles with shapes (n, k, nodes, 5)."""
        means = list[StepMeans]()
        for n, one in enumerate(self.replay.recordings):
            sensors = self._along[self.sessions.index(one.session)][0]
            means += read_means(n, one, sensors, shapes[n], self.length)
        return replace(self, means=tuple(means))

    @property
    def length(self) -> float:
        """Length (mm) of the needle."""
        return self.scenario.needle.length_mm

    def nuisances(self, recording: int) -> slice:
        """Return the place of the axis and the lever of a recording's sensor in a point."""
        count = self.replay.axes + 1
        first = len(self.parameters) + count * self.sessions.index(self.replay.recordings[recording].session)
        return slice(first, first + count)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all recordings at a point on all axes, with their derivatives.

    values: (r,) for each recording and axis; slopes: (r, p + s); models: predicted readings (2 k,); tips (n, k, 5).
    along: of each sensor along the needle in each recording; shapes (n, k, nodes, 5): for these.
    """

    values: list[Floats]
    slopes: list[Floats]
    models: list[Floats]
    tips: Floats
    converged: bool
    along: list[Along]
    shapes: Floats


def residuals_at(problem: Problem, point: Floats, *, derivatives: bool = True) -> Residuals:
    """Return the residuals at a point, by differences of the model in one rollout of all needles."""
    steps = np.array([each.step for each in problem.parameters])
    size = len(steps)
    # Towards the inside of the bounds.
    signs = np.where(point[:size] + steps > problem.bounds[1, :size], -1.0, 1.0)
    points = [point]
    if derivatives:
        points += [point + np.eye(len(point))[k] * signs[k] * steps[k] for k in range(size)]
    tips, good, shapes = problem.carry_out(points)
    change = [(tips[1 + k] - tips[0]) / (signs[k] * steps[k]) for k in range(len(points) - 1)]
    values, slopes, models = list[Floats](), list[Floats](), list[Floats]()
    for n, one in enumerate(problem.replay.recordings):
        count, place = len(one.depth), problem.nuisances(n)
        *offset, lever = point[place].tolist()
        for axis in range(problem.replay.axes):
            path = [tips[0, n, :count, 1 + axis], tips[0, n, :count, 3 + axis]]
            turned = path[1] - path[1][0]
            model = np.append(path[0] + lever * turned, path[1] + offset[axis])
            derivative = np.zeros((2 * count, len(point)))
            for k, each in enumerate(change):
                y, slope = each[n, :count, 1 + axis], each[n, :count, 3 + axis]
                derivative[:, k] = np.append(y + lever * (slope - slope[0]), slope)
            derivative[count:, place.start + axis] = 1.0
            derivative[:count, place.stop - 1] = turned
            found = np.append(one.position[:, axis], one.slope[:, axis])
            known = np.isfinite(found)
            values.append((found - model)[known])
            slopes.append(derivative[known])
            models.append(model)
    along = []
    for each in problem.means:
        one, own = problem.replay.recordings[each.recording], shapes[:, each.recording]
        along.append(residuals_along(each, one, own, problem.length, signs * steps, point))
    return Residuals(values, slopes, models, tips[0], bool(good.all()), along, shapes[0])


def paths_at(problem: Problem, tips: Floats) -> list[Whitened]:
    """Return the likelihood of each recording and axis about the model's tips (n, k, 5)."""
    paths = []
    for n, one in enumerate(problem.replay.recordings):
        count = len(one.depth)
        for axis in range(problem.replay.axes):
            known = np.isfinite(np.append(one.position[:, axis], one.slope[:, axis]))
            y, slope = tips[n, :count, [1 + axis, 3 + axis]]
            deviations = Deviations(one.depth, y, slope, one.moved)
            paths.append(Whitened(deviations, known, np.ones(count)))
    return paths


def paths_along(problem: Problem, found: Residuals) -> list[AlongPath]:
    """Return the covariances of each sensor along the needle in each recording about the model's needles."""
    recordings, target = problem.replay.recordings, problem.scenario.target.depth_mm
    sessions = Counter(one.session for one in recordings)
    paths = []
    for means, each in zip(problem.means, found.along, strict=True):
        one, shapes = recordings[means.recording], found.shapes[means.recording]
        alike = sessions[one.session]
        paths.append(path_along(means, one, shapes, problem.length, target, each, alike))
    return paths


@dataclass(frozen=True, eq=False)
class Fitted:
    """The end of a fit: point, noise, and what the criterion has there.

    cost: the loss, with the prior; errors (m,), with the weights of iterated least squares, derivatives (m, p + s), and
    groups (m,), the recording of each; residuals: at the point; settled: whether the rounds ended before the last.
    factors: on noise and model error of each sensor along the needle; tip_errors: number of the errors of tips, which
    are first.
    """

    problem: Problem
    criterion: type[Criterion]
    point: Floats
    noise: Noise
    paths: list[Whitened]
    cost: float
    errors: Floats
    slopes: Floats
    groups: Any
    residuals: Residuals
    settled: bool
    factors: dict[str, Floats]
    tip_errors: int

    def sds_by(self, rows: slice) -> Floats:
        """Return standard deviations (p + s,) by some of the errors, and the prior."""
        some = self.slopes[rows]
        found: Floats = np.sqrt(np.diag(np.linalg.inv(some.T @ some + np.diag(self.problem.sd**-2.0))))
        return found

    @cached_property
    def information(self) -> Floats:
        """Information (p + s, p + s) of the data and the prior at the point."""
        found: Floats = self.slopes.T @ self.slopes + np.diag(self.problem.sd**-2.0)
        return found

    @cached_property
    def gradient(self) -> Floats:
        """Half of the negative gradient (p + s,) of the loss at the point."""
        found: Floats = self.slopes.T @ self.errors + (self.problem.start - self.point) / self.problem.sd**2
        return found

    @property
    def left(self) -> Floats:
        """Step (p + s,) of Gauss–Newton that is left to the minimum, in standard deviations of each parameter."""
        covariance = np.linalg.inv(self.information)
        found: Floats = covariance @ self.gradient / np.sqrt(np.diag(covariance))
        return found

    @cached_property
    def without(self) -> Floats:
        """Points (n, p + s) without one recording each: one step of Gauss–Newton from the point."""
        moves = []
        for n in range(len(self.problem.replay.recordings)):
            rows = self.groups == n
            less = self.information - self.slopes[rows].T @ self.slopes[rows]
            moves.append(np.linalg.solve(less, self.gradient - self.slopes[rows].T @ self.errors[rows]))
        found: Floats = self.point + np.array(moves)
        return found


def fit(
    problem: Problem,
    criterion: type[Criterion],
    start: Floats | None = None,
    noise: Noise | None = None,
    rounds: int = _ROUNDS,
) -> Fitted:
    """Return the parameters with the least loss, and their noise, from a start (default: the prior's mean)."""
    point = problem.start if start is None else start
    noise = noise or Noise.first()
    found = residuals_at(problem, point)
    problem = replace(problem, replay=problem.replay.corrected(found.tips))
    if problem.sensors:
        problem = problem.with_means(residuals_at(problem, point, derivatives=False).shapes)
    found = residuals_at(problem, point)
    paths, along = paths_at(problem, found.tips), paths_along(problem, found)
    factors = {each.sensor: FIRST_FACTORS for each in along}
    for _ in range(rounds):
        before = point
        given = Joint.of(criterion.of(paths, noise, found.values), along, factors)
        point, found = _least_squares(problem, given, point)
        new = paths_at(problem, found.tips)
        paths = [replace(path, factors=old.factors) for path, old in zip(new, paths, strict=True)]
        noise = estimate_noise(paths, found.values, noise)
        paths = [path.with_factors_for(noise, value) for path, value in zip(paths, found.values, strict=True)]
        along = paths_along(problem, found)
        factors = estimate_factors(along, [each.value for each in found.along], factors)
        ended = conclude(problem, criterion, paths, noise, point, found, along, factors)
        scale = np.sqrt(np.diag(np.linalg.inv(ended.information)))
        if (np.abs(point - before) < _SETTLED * scale).all():
            return replace(ended, settled=True)
    return ended


def conclude(
    problem: Problem,
    criterion: type[Criterion],
    paths: list[Whitened],
    noise: Noise,
    point: Floats,
    found: Residuals,
    along: Sequence[AlongPath] = (),
    factors: dict[str, Floats] | None = None,
) -> Fitted:
    """Return the fit at a point, not settled."""
    given = Joint.of(criterion.of(paths, noise, found.values), along, factors or {})
    errors, slopes = _errors(given, found)
    loss, weight, _ = given.rho(errors**2)
    off = (point - problem.start) / problem.sd
    axes = problem.replay.axes
    owners = [*(np.arange(len(paths)) // axes).tolist(), *(each.recording for each in along)]
    groups = np.repeat(owners, [len(each) for each in given.rows])
    root = np.sqrt(weight)
    return Fitted(
        problem, criterion, point, noise, paths, float(loss.sum() + off @ off) + given.constant,
        root * errors, root[:, None] * slopes, groups, found, False, factors or {},
        sum(map(len, given.tip.rows)),
    )  # fmt: skip


def _errors(criterion: Joint, found: Residuals) -> tuple[Floats, Floats]:
    """Return errors (m,) and their derivatives (m, p + s), of the opposite sign."""
    rows = criterion.rows
    values = [*found.values, *(each.value for each in found.along)]
    slopes = [*found.slopes, *(each.slopes for each in found.along)]
    return (
        np.concatenate([each @ value for each, value in zip(rows, values, strict=True)]),
        np.concatenate([each @ slope for each, slope in zip(rows, slopes, strict=True)]),
    )


def _least_squares(problem: Problem, criterion: Joint, start: Floats) -> tuple[Floats, Residuals]:
    """Return the point of the least loss of a criterion, and its residuals."""
    known: dict[bytes, Residuals] = {}
    size = len(start)

    def at(point: Floats) -> Residuals:
        key = point.tobytes()
        if key not in known:
            known[key] = residuals_at(problem, point)
        return known[key]

    def misfit(point: Floats) -> Floats:
        return np.append(_errors(criterion, at(point))[0], (problem.start - point) / problem.sd)

    def derivative(point: Floats) -> Floats:
        return -np.vstack([_errors(criterion, at(point))[1], np.diag(1.0 / problem.sd)])

    def rho(squares: Floats) -> Floats:
        prior = squares[-size:]
        quadratic = np.stack([prior, np.ones(size), np.zeros(size)])
        return np.hstack([criterion.rho(squares[:-size]), quadratic])

    low, high = problem.bounds
    inside = np.clip(start, low + 1e-9, high - 1e-9)
    found = least_squares(
        misfit,
        inside,
        derivative,
        bounds=(low, high),
        loss=rho,
        x_scale="jac",
        xtol=1e-3,
        ftol=1e-4,
        max_nfev=12,
    )
    return found.x, at(found.x)


def reading_share(fitted: Fitted) -> float:
    """Return the share of errors of readings in the variance of predictions ahead; the rest is what the model lacks."""
    reached = max(float(np.ptp(path.deviations.depth)) for path in fitted.paths)
    readings = fitted.noise.without(range(len(KINDS) - 2))
    parts = np.zeros(2)
    for path in fitted.paths:
        rows, _ = predict_ahead(path, fitted.noise, reached)
        start = path.start
        parts += [
            np.einsum("ai,ij,aj->", rows, path.covariance(noise) - start, rows)
            for noise in (readings, fitted.noise)
        ]
    return float(parts[0] / parts[1])
