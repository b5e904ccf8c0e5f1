"""The step of a fit, Gauss–Newton to the maximum a posteriori, and the derivatives that it needs.

The derivatives of the sensors' quantities with respect to the parameters are kept as curves over the depth of the tip,
a few steps ahead of it too. Some of the curves are simulated again each period, so that none is older than `ROUND`
periods.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.estimation.along import Bins, SensorFit, whiten
from flexneedle.estimation.fitted import (
    LASTING,
    Fitted,
    FittedInsertion,
    Perturbed,
    Simulated,
    adapt_models,
)
from flexneedle.estimation.lateral import directions
from flexneedle.simulator.control import controls
from flexneedle.types import DB_X, Floats, Laterals, X, laterals

_SHARES = (0.5, 0.2, 0.05, 0.0)  # of a step that raises the cost: the first that does not


class DueNeedles(NamedTuple):
    """The needle with some parameters, and needles with one of them larger, simulated together from their starts."""

    due: list[int]  # parameters whose curves are simulated
    begun: list[int]  # due parameters to whose depth the needle has come: larger in needles 1, 2, …
    simulated: Simulated


def improve_fit(fitted: Fitted) -> Fitted:
    """Return the insertion after a Gauss–Newton step to the maximum a posteriori within the bounds, differentiated.

    The step is shortened until the cost does not rise.
    """
    gradient, precision, variance, whitening = inform(fitted)
    fitted = fitted.change(precision=precision)
    goal = fitted.parameters + step_within(precision, gradient, fitted.prior.bounds - fitted.parameters)

    def cost(other: FittedInsertion) -> float:
        return cost_of(other, variance, whitening)

    most = cost(fitted)

    def is_worse(other: FittedInsertion) -> bool:
        return not (other.state.converged and cost(other) <= most)

    # Most often the whole step will do: the needles for the derivatives there are simulated with it.
    needles = simulate_due(fitted, goal)
    if not is_worse(trial := fitted.take(goal, needles.simulated)):
        return differentiate(trial, needles)
    shorter = [fitted.parameters + share * (goal - fitted.parameters) for share in _SHARES]
    for trial in fitted.simulate_each(shorter):
        if not is_worse(trial):
            break
    return differentiate(trial)


def inform(fitted: FittedInsertion) -> "tuple[Floats, Floats, Floats, Whitening | None]":
    """Return the downhill gradient (K,), the precision (K, K), and variances (r,) and whitening of the tip's rows."""
    prior, jacobian, variance = fitted.prior, jacobian_of(fitted), variance_of_rows(fitted)
    left, off = np.concatenate(fitted.residuals), fitted.parameters - prior.mean
    whitening = Whitening.of(fitted, variance) if fitted.has_field else None
    if whitening:
        jacobian, left, variance = (
            whitening.of_rows(jacobian),
            whitening.of_rows(left),
            np.ones_like(variance),
        )
    weighted = jacobian.conj().T / variance
    gradient = (weighted @ left).real - prior.precision @ off
    precision = (weighted @ jacobian).real + prior.precision
    if fitted.along:
        gradient, precision = inform_along(fitted, gradient, precision)
    return gradient, precision, variance, whitening


def variance_of_rows(fitted: FittedInsertion) -> Floats:
    """Return the variances (r,) of the rows of the tip's sensors."""
    both = zip(fitted.variances(), fitted.readings, fitted.laterals, strict=True)
    return np.concatenate([noise + readings.estimate_sag(tips) ** 2 for noise, readings, tips in both])


def cost_of(fitted: FittedInsertion, variance: Floats, whitening: "Whitening | None") -> float:
    """Return the negative logarithm of the posterior density, up to a constant, with variances of the tip's rows."""
    left = np.concatenate(fitted.residuals)
    squares = np.abs(whitening.of_rows(left) if whitening else left) ** 2
    own = float(0.5 * (squares / variance).sum()) + fitted.prior.cost(fitted.parameters)
    return own + cost_along(fitted) if fitted.along else own


def step_within(precision: Floats, gradient: Floats, bounds: Floats) -> Floats:
    """Return a step s (K,) to the maximum of gradient·s − s·precision·s / 2 within bounds (2, K) about 0; 0 if none.

    It goes to the maximum up to the first bound, and on from there without the parameter that stays at it, as an active
    set method does: a step that is only cut at the bounds leads correlated parameters where the fit may be worse.
    """
    step, free = np.zeros_like(gradient), np.ones(gradient.size, dtype=bool)
    while free.any():
        inner = np.ix_(free, free)
        way = np.linalg.solve(precision[inner], (gradient - precision @ step)[free])
        if not np.isfinite(way).all():
            return np.zeros_like(gradient)
        ends = np.where(way > 0.0, bounds[1, free], bounds[0, free]) - step[free]
        shares = np.divide(ends, way, out=np.full_like(way, np.inf), where=way != 0.0)
        first = int(np.argmin(shares))
        if shares[first] >= 1.0:
            step[free] += way
            break
        step[free] += shares[first] * way
        place = np.flatnonzero(free)[first]
        step[place], free[place] = bounds[int(way[first] > 0.0), place], False
    return step


def jacobian_of(fitted: FittedInsertion) -> Laterals:
    """Return the derivative (r, K) of the predicted readings of all sensors, from the curves."""
    parts = []
    for k, (sensor, readings) in enumerate(zip(fitted.sensors, fitted.readings, strict=True)):
        part = fitted.slopes(readings.between(fitted.places(fitted.tips[:, X])), k)
        offset = np.multiply.outer(readings.bevel, directions(1.0, fitted.axes))
        part[:, getattr(fitted.slots, sensor.offset)] = offset
        if k == 0 and fitted.slots.bias.stop:
            part[:, fitted.slots.bias] = directions(1.0, fitted.axes)
        parts.append(part)
    return np.concatenate(parts)


class Whitening(NamedTuple):
    """Rows of the tip's position, which come first, with the correlated error of the tracker's field made white."""

    lower: Floats  # Cholesky factor (r, r) of the covariance of the position's rows
    variance: Floats  # variances of all rows without that error

    @staticmethod
    def of(fitted: FittedInsertion, variance: Floats) -> "Whitening":
        """Return the whitening of rows with variances (r,)."""
        covariance = field_covariance(fitted)
        covariance += np.diag(variance[: len(covariance)])
        return Whitening(np.linalg.cholesky(covariance).astype(np.float64), variance)

    def of_rows(self, rows: Laterals) -> Laterals:
        """Return rows (r, …) with white noise of variance 1."""
        count = len(self.lower)
        rest = (rows[count:].T / np.sqrt(self.variance[count:])).T
        return np.concatenate([np.linalg.solve(self.lower, rows[:count]), rest])


def field_covariance(fitted: FittedInsertion) -> Floats:
    """Return the covariance (r, r), mm², of the field's error in the mean readings of the tip, on an axis."""
    position = fitted.readings[0]
    path = np.cumsum(np.append(0.0, np.abs(fitted.rows[:, DB_X])))
    place = position.between(path) / fitted.nominal.scenario.tracker.field_length_mm
    since, sds = np.array(fitted.fields).T
    begun = fitted.timeline.begun[position.index]
    sd = sds[np.clip(np.searchsorted(since, begun, side="right") - 1, 0, None)]
    covariance: Floats = np.multiply.outer(sd, sd) * np.exp(-np.abs(place[:, None] - place))
    return covariance


def inform_along(fitted: FittedInsertion, gradient: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Return the downhill gradient (K,) and the precision (K, K) with the readings of sensors along the needle."""
    gradient, precision = gradient.copy(), precision.copy()
    for k, one in enumerate(fitted.along):
        both = fitted.along_residuals[k], fitted.along_jacobians[k]
        for left, rows in _whitened(one, fitted.bins[k], *both):
            gradient += rows.T @ left
            precision += rows.T @ rows
    return gradient, precision


def lasting_covariance(fitted: FittedInsertion, gains: Floats) -> Floats:
    """Return the covariance (n, n) of n functions of the parameters by the errors of the model that last.

    The fit takes the errors of the model in the readings of sensors along the needle for white, but they last from move
    to move. gains: the functions' derivatives times the covariance of the parameters (n, K).
    """
    found = np.zeros((len(gains), len(gains)))
    for one, bins, jacobian in zip(fitted.along, fitted.bins, fitted.along_jacobians, strict=True):
        weights = one.sensor.model_error(bins.value) / one.variances(bins)
        errors = weights * (jacobian @ gains.T).transpose(2, 0, 1)
        apart = np.abs(bins.index[:, None] - bins.index)
        lasting = np.where(apart > 0, np.exp(-apart / LASTING), 0.0)
        found += np.einsum("nid,ij,mjd->nm", errors, lasting, errors, optimize=True)
    return found


def cost_along(fitted: FittedInsertion) -> float:
    """Return half of the weighted squares of the residuals of the sensors along the needle."""
    parts = zip(fitted.along, fitted.bins, fitted.along_residuals, strict=True)
    whitened = (left for one, bins, residuals in parts for left, *_ in _whitened(one, bins, residuals))
    return float(sum(0.5 * (left**2).sum() for left in whitened))


def _whitened(one: SensorFit, bins: Bins, *arrays: Floats) -> Iterator[list[Floats]]:
    """Yield arrays (b, d, …) as rows with white noise of variance 1, in groups of columns with the same variances."""
    variances = one.variances(bins)
    wander, distance = one.sensor.wander_sd, bins.time / one.sensor.wander_s
    if wander == 0.0:
        yield whiten(
            [each.reshape(variances.size, *each.shape[2:]) for each in arrays],
            variances.ravel(),
            0.0,
            distance,
        )
        return
    for k, variance in enumerate(variances.T):
        yield whiten([each[:, k] for each in arrays], variance, wander, distance)


ROUND = 8
"""Periods in which each curve is simulated once."""


def simulate_due(
    fitted: FittedInsertion, parameters: Floats, which: Iterable[int] | None = None
) -> DueNeedles:
    """Return the needles for the derivatives to the parameters `which` (default: those that are due)."""
    due = [k for k in (due_parameters(fitted) if which is None else which) if not fitted.slots.is_offset(k)]
    depth = float(fitted.tips[:, X].max()) + ROUND * fitted.nominal.scenario.setup.max_advance_mm
    begun = [k for k in due if depth >= fitted.prior.begins[k]]
    return DueNeedles(due, begun, fitted.simulate_all([parameters, *_enlarge(fitted, parameters, begun)]))


def _enlarge(fitted: FittedInsertion, parameters: Floats, which: Sequence[int]) -> list[Floats]:
    """Return the parameters (K,) with each of some larger by its step."""
    steps = np.diag(fitted.prior.steps)
    return [parameters + steps[k] for k in which]


def differentiate(fitted: Fitted, needles: DueNeedles | None = None) -> Fitted:
    """Return the insertion with its curves renewed from needles, a few steps ahead (default: those that are due)."""
    needles = needles or simulate_due(fitted, fitted.parameters)
    models, states, tips, shapes = needles.simulated
    others = [k for k in needles.due if k not in needles.begun]
    larger = _enlarge(fitted, fitted.parameters, others)
    unreached = zip(
        others, adapt_models(fitted.nominal, fitted.slots, fitted.settings.cell_mm, larger), strict=True
    )
    ahead = controls(ROUND, db_x=fitted.nominal.scenario.setup.max_advance_mm)
    rows = np.tile(ahead, (len(models), 1, 1))
    further = fitted.nominal.rollout(states, rows, models=models, limits=False, outputs=fitted.wanted)
    base, *moved = np.concatenate([tips, further.tips], axis=1)
    depth, curves = fitted.places(np.maximum.accumulate(base[:, X])), fitted.curves.copy()
    steps = fitted.prior.steps.tolist()
    for k, tip in zip(needles.begun, moved, strict=True):
        for curve, sensor in zip(curves[:, k], fitted.sensors, strict=True):
            change = laterals(tip, sensor.column, fitted.axes) - laterals(base, sensor.column, fitted.axes)
            curve[:] = np.interp(fitted.grid, depth, change / steps[k])
    along_curves = fitted.along_curves
    if fitted.along and needles.begun:
        length = fitted.nominal.scenario.needle.length_mm
        whole = np.concatenate([shapes, further.shapes], axis=1)
        values = (one.values(whole, length) for one in fitted.along)
        along_curves = tuple(
            _renew(
                old,
                needles.begun,
                (each[1:] - each[0]) / fitted.prior.steps[needles.begun, None, None],
                depth,
                fitted.grid,
            )
            for old, each in zip(along_curves, values, strict=True)
        )
    reached = zip(needles.begun, models[1:], states[1:], strict=True)
    perturbed = (
        *(Perturbed(k, steps[k], model, state) for k, model, state in reached),
        *(Perturbed(k, steps[k], model, fitted.state) for k, model in unreached),
    )
    return fitted.change(
        curves=curves, along_curves=along_curves, perturbed=perturbed, period=fitted.period + 1
    )


def _renew(curves: Floats, which: Sequence[int], slopes: Floats, depth: Floats, grid: Floats) -> Floats:
    """Return curves (K, g, d), renewed for some parameters by slopes (k, m, d) at depths (m,), which do not fall."""
    right = np.clip(np.searchsorted(depth, grid, side="right"), 1, depth.size - 1)
    width = depth[right] - depth[right - 1]
    part = np.clip((grid - depth[right - 1]) / np.where(width > 0.0, width, 1.0), 0.0, 1.0)[:, None]
    renewed = curves.copy()
    renewed[which] = (1.0 - part) * slopes[:, right - 1] + part * slopes[:, right]
    return renewed


def due_parameters(fitted: FittedInsertion) -> Iterator[int]:
    """Yield the parameters whose curves are simulated this period.

    Base, bend, bevel and clearance always are, together: their effects are so alike until the needle rolls that curves
    of different periods would differ by more, and tell them apart where no reading does.
    """
    yield from (*range(fitted.slots.run_out.start), fitted.slots.bevel, fitted.slots.clearance)
    for k in range(fitted.slots.modulus, fitted.slots.end or fitted.parameters.size):
        if k % ROUND == fitted.period % ROUND:
            yield k
