"""The fit: robust least squares of the errors of predictions ahead, alternating with the noise they follow from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from flexneedle.lab.calibration.ahead import HORIZONS, Rows, predict_ahead
from flexneedle.lab.calibration.deviations import Deviations, Noise, Whitened, estimate_noise
from flexneedle.lab.calibration.parameters import Parameter, make_needle, trial_of
from flexneedle.lab.calibration.prediction import Replay
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_ROUNDS = 10  # of parameters, noise and weights
_SETTLED = 0.1  # change of a parameter, in standard deviations, at which the rounds end
_LEAST_SD = 0.01  # mm; of the errors of predictions
_AXIS_SD = 0.05  # rad; prior standard deviation of the sensor's axis about the needle's


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit: scenario, parameters, recordings.

    The point of a fit has the p parameters, then the slope (rad) of the sensor's axis for each session and axis.
    """

    scenario: Scenario
    parameters: tuple[Parameter, ...]
    replay: Replay

    @cached_property
    def sessions(self) -> tuple[str, ...]:
        """Names of the sessions."""
        return tuple(dict.fromkeys(one.session for one in self.replay.recordings))

    @cached_property
    def start(self) -> Floats:
        """The prior's mean."""
        offsets = np.zeros(len(self.sessions) * self.replay.axes)
        return np.append([each.start for each in self.parameters], offsets)

    @cached_property
    def sd(self) -> Floats:
        """Standard deviations of the prior."""
        offsets = np.full(len(self.start) - len(self.parameters), _AXIS_SD)
        return np.append([each.sd for each in self.parameters], offsets)

    @cached_property
    def bounds(self) -> Floats:
        """Lower and upper bounds (2, p + s)."""
        offsets = np.ones(len(self.start) - len(self.parameters))
        low = np.append([each.low for each in self.parameters], -offsets)
        return np.stack([low, np.append([each.high for each in self.parameters], offsets)])

    def tips(self, points: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return the tips (v, n, k, 5) at points, and whether all solves converged (v, n)."""
        trials = [trial_of(self.scenario, self.parameters, point[: len(self.parameters)]) for point in points]
        return self.replay.predict([make_needle(self.scenario, trial) for trial in trials])

    def offset(self, point: Floats, recording: int) -> Floats:
        """Return the slope (axes,) of the sensor's axis in a recording."""
        axes, session = self.replay.axes, self.sessions.index(self.replay.recordings[recording].session)
        first = len(self.parameters) + axes * session
        return point[first : first + axes]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all recordings at a point on all axes, with their derivatives.

    values: (r,) for each recording and axis; slopes: (r, p + s); tips (n, k, 5).
    """

    values: list[Floats]
    slopes: list[Floats]
    tips: Floats
    converged: bool


def known_of(problem: Problem) -> list[Floats]:
    """Return for each recording and axis which positions, then slopes, are measured."""
    return [
        np.isfinite(np.append(one.position[:, axis], one.slope[:, axis]))
        for one in problem.replay.recordings
        for axis in range(problem.replay.axes)
    ]


def residuals_at(problem: Problem, point: Floats, *, derivatives: bool = True) -> Residuals:
    """Return the residuals at a point, by differences of the model in one rollout of all needles."""
    steps = np.array([each.step for each in problem.parameters])
    size = len(steps)
    # Towards the inside of the bounds.
    signs = np.where(point[:size] + steps > problem.bounds[1, :size], -1.0, 1.0)
    points = [point]
    if derivatives:
        points += [point + np.eye(len(point))[k] * signs[k] * steps[k] for k in range(size)]
    tips, good = problem.tips(points)
    change = [(tips[1 + k] - tips[0]) / (signs[k] * steps[k]) for k in range(len(points) - 1)]
    axes, values, slopes = problem.replay.axes, list[Floats](), list[Floats]()
    for n, one in enumerate(problem.replay.recordings):
        count, offset = len(one.depth), problem.offset(point, n)
        for axis in range(axes):
            columns = [1 + axis, 3 + axis]
            found = np.append(one.position[:, axis], one.slope[:, axis])
            known = np.isfinite(found)
            model = tips[0, n, :count, columns].ravel() + np.append(
                np.zeros(count), np.full(count, offset[axis])
            )
            derivative = np.zeros((2 * count, len(point)))
            for k, each in enumerate(change):
                derivative[:, k] = each[n, :count, columns].ravel()
            session = problem.sessions.index(one.session)
            derivative[count:, size + axes * session + axis] = 1.0
            values.append((found - model)[known])
            slopes.append(derivative[known])
    return Residuals(values, slopes, tips[0], bool(good.all()))


def paths_at(problem: Problem, tips: Floats) -> list[Whitened]:
    """Return the likelihood of each recording and axis about the model's tips (n, k, 5)."""
    paths = []
    for n, one in enumerate(problem.replay.recordings):
        count = len(one.depth)
        for axis in range(problem.replay.axes):
            known = np.isfinite(np.append(one.position[:, axis], one.slope[:, axis]))
            deviations = Deviations(one.depth, tips[n, :count, 1 + axis], tips[n, :count, 3 + axis])
            paths.append(Whitened(deviations, known, np.ones(count)))
    return paths


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of all recordings: `Rows` for each recording and axis, standard deviations (h,) of the errors (mm) by
    horizon, and the weight of an error.
    """

    rows: list[Rows]
    sd: Floats
    weight: float

    @staticmethod
    def of(problem: Problem, paths: Sequence[Whitened], noise: Noise, found: Residuals) -> "Predictions":
        """Return the predictions, with the root mean squares of their errors at the residuals.

        Errors of overlapping predictions are not independent: each counts by the share of its advance that is its own.
        """
        depths = [one.depth for one in problem.replay.recordings]
        reached = max(float(np.ptp(depth)) for depth in depths)
        spacing = float(np.mean(np.concatenate([np.diff(depth) for depth in depths])))
        rows = [predict_ahead(path, noise, reached) for path in paths]
        errors = np.concatenate([each.rows @ values for each, values in zip(rows, found.values, strict=True)])
        horizon = np.concatenate([each.horizon for each in rows])
        sd = np.ones(len(HORIZONS))
        for k in np.unique(horizon):
            sd[k] = max(float(np.sqrt(np.mean(errors[horizon == k] ** 2))), _LEAST_SD)
        overlap = float(np.exp(np.mean(np.log(HORIZONS)))) * reached / spacing
        return Predictions(rows, sd, 1.0 / (len(HORIZONS) * max(overlap, 1.0)))

    def scale(self, found: Residuals) -> tuple[Floats, Floats, Floats]:
        """Return errors (m,) over their standard deviations, derivatives (m, p + s), and the recording (m,) of each."""
        parts = [
            (each.rows @ value / self.sd[each.horizon], each.rows @ slope / self.sd[each.horizon, None])
            for each, value, slope in zip(self.rows, found.values, found.slopes, strict=True)
        ]
        axes = len(self.rows) // len(found.tips)
        groups = np.repeat(np.arange(len(self.rows)) // axes, [len(each.rows) for each in self.rows])
        return np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts]), groups

    def loss(self, errors: Floats) -> float:
        """Return −2 ln of the likelihood of scaled errors (m,): twice the pseudo-Huber loss, and of their scales."""
        horizon = np.concatenate([each.horizon for each in self.rows])
        each = 2.0 * (np.sqrt(1.0 + errors**2) - 1.0) + 2.0 * np.log(self.sd[horizon])
        return self.weight * float(each.sum())


@dataclass(frozen=True, eq=False)
class Fitted:
    """The end of a fit: point, noise, and the errors of predictions there.

    cost: −2 ln of the likelihood, with the prior; errors (m,), scaled and weighted, with derivatives (m, p + s); groups
    (m,): recording of each; settled: whether the rounds ended before the last.
    """

    problem: Problem
    point: Floats
    noise: Noise
    paths: list[Whitened]
    cost: float
    errors: Floats
    slopes: Floats
    groups: Floats
    tips: Floats
    settled: bool
    converged: bool

    @cached_property
    def information(self) -> Floats:
        """Information (p + s, p + s) of the data and the prior at the point."""
        found: Floats = self.slopes.T @ self.slopes + np.diag(self.problem.sd**-2.0)
        return found


def fit(problem: Problem, start: Floats | None = None, noise: Noise | None = None) -> Fitted:
    """Return the parameters of the least errors of predictions, with their prior, from a start (default: the prior)."""
    point = problem.start if start is None else start
    noise, settled = noise or Noise.first(), False
    found = residuals_at(problem, point)
    problem = replace(problem, replay=problem.replay.corrected(found.tips))
    found = residuals_at(problem, point)
    paths = paths_at(problem, found.tips)
    for _ in range(_ROUNDS):
        before = point
        predictions = Predictions.of(problem, paths, noise, found)
        point, found = _least_squares(problem, predictions, point)
        paths = _renew(problem, paths, found)
        noise = estimate_noise(paths, found.values, noise)
        paths = [path.with_factors_for(noise, value) for path, value in zip(paths, found.values, strict=True)]
        ended = conclude(problem, paths, noise, point, found, settled)
        scale = np.sqrt(np.diag(np.linalg.inv(ended.information)))
        if (np.abs(point - before) < _SETTLED * scale).all():
            return replace(ended, settled=True)
    return ended


def conclude(
    problem: Problem, paths: list[Whitened], noise: Noise, point: Floats, found: Residuals, settled: bool
) -> Fitted:
    """Return the fit at a point with its errors."""
    predictions = Predictions.of(problem, paths, noise, found)
    errors, slopes, groups = predictions.scale(found)
    off = (point - problem.start) / problem.sd
    # Weights of iterated least squares for the pseudo-Huber loss.
    root = np.sqrt(predictions.weight) * (1.0 + errors**2) ** -0.25
    cost = predictions.loss(errors) + float(off @ off)
    return Fitted(
        problem, point, noise, paths, cost, root * errors, root[:, None] * slopes, groups, found.tips, settled,
        found.converged,
    )  # fmt: skip


def _renew(problem: Problem, paths: Sequence[Whitened], found: Residuals) -> list[Whitened]:
    """Return the paths about other tips, with the same factors of the intervals."""
    new = paths_at(problem, found.tips)
    return [replace(path, factors=old.factors) for path, old in zip(new, paths, strict=True)]


def _least_squares(problem: Problem, predictions: Predictions, start: Floats) -> tuple[Floats, Residuals]:
    """Return the point of the least loss for given predictions, and its residuals."""
    known: dict[bytes, Residuals] = {}
    root = np.sqrt(predictions.weight)

    def at(point: Floats) -> Residuals:
        key = point.tobytes()
        if key not in known:
            known[key] = residuals_at(problem, point)
        return known[key]

    def misfit(point: Floats) -> Floats:
        return np.append(root * predictions.scale(at(point))[0], (problem.start - point) / problem.sd)

    def derivative(point: Floats) -> Floats:
        return -np.vstack([root * predictions.scale(at(point))[1], np.diag(1.0 / problem.sd)])

    def loss(squares: Floats) -> Floats:
        """Return the loss, and its derivatives, of squared weighted errors: pseudo-Huber, and squares of the prior."""
        rho = np.stack([squares, np.ones_like(squares), np.zeros_like(squares)])
        data = slice(None, -len(start))
        z = 1.0 + squares[data] / predictions.weight
        rho[:, data] = [
            2.0 * predictions.weight * (z**0.5 - 1.0),
            z**-0.5,
            -0.5 / predictions.weight * z**-1.5,
        ]
        return rho

    low, high = problem.bounds
    inside = np.clip(start, low + 1e-9, high - 1e-9)
    found = least_squares(
        misfit, inside, derivative, bounds=(low, high), loss=loss, x_scale="jac", xtol=1e-4, ftol=1e-6, max_nfev=12
    )
    return found.x, at(found.x)
