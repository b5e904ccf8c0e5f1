"""The step of a fit, Gauss–Newton to the maximum a posteriori, and the derivatives that it needs.

The derivatives of the sensors' quantities with respect to the parameters are kept as curves over the depth of the tip,
a few steps ahead of it too. A few of the curves are simulated again each period, so that none is older than `ROUND`
periods.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from flexneedle.estimation.axial import replay_scaled
from flexneedle.estimation.fitted import Fitted, FittedInsertion, Perturbed, adapt_model
from flexneedle.estimation.lateral import directions
from flexneedle.simulator.control import controls
from flexneedle.types import Floats, Laterals, X, laterals

_SHARES = (1.0, 0.5, 0.2, 0.05, 0.0)  # of a step: the first that does not raise the cost


def improve_fit(fitted: Fitted) -> Fitted:
    """Return the insertion after a Gauss–Newton step to the maximum a posteriori within the bounds.

    The step is shortened until the cost does not rise.
    """
    prior = fitted.prior
    jacobian = jacobian_of(fitted)
    both = zip(fitted.variances(), fitted.readings, fitted.laterals, strict=True)
    variance = np.concatenate([noise + readings.estimate_sag(tips) ** 2 for noise, readings, tips in both])
    weighted = jacobian.conj().T / variance
    off = fitted.parameters - prior.mean
    gradient = (weighted @ np.concatenate(fitted.residuals)).real - prior.precision @ off
    precision = (weighted @ jacobian).real + prior.precision
    fitted = replace(fitted, precision=precision)
    step = np.linalg.solve(precision, gradient)
    if not np.isfinite(step).all():
        return fitted.simulate_with(fitted.parameters)
    goal = np.clip(fitted.parameters + step, *prior.bounds)

    def cost(other: FittedInsertion) -> float:
        squares = np.abs(np.concatenate(other.residuals)) ** 2
        return float(0.5 * (squares / variance).sum()) + prior.cost(other.parameters)

    most, trial = cost(fitted), fitted
    for share in _SHARES:
        trial = fitted.simulate_with(fitted.parameters + share * (goal - fitted.parameters))
        if trial.state.converged and cost(trial) <= most:
            break
    return trial


def jacobian_of(fitted: FittedInsertion) -> Laterals:
    """Return the derivative (r, K) of the predicted readings of all sensors, from the curves."""
    parts = []
    for k, (sensor, readings) in enumerate(zip(fitted.sensors, fitted.readings, strict=True)):
        part = fitted.slopes(readings.between(fitted.tips[:, X]), k)
        offset = np.multiply.outer(readings.bevel, directions(1.0, fitted.axes))
        part[:, getattr(fitted.slots, sensor.offset)] = offset
        parts.append(part)
    return np.concatenate(parts)


ROUND = 8
"""Periods in which each curve is simulated once."""
LEADING_ROUND = 2
"""Periods in which the curves of base, bend, bevel and clearance are."""


def differentiate(fitted: Fitted, which: Sequence[int] | None = None) -> Fitted:
    """Simulate curves again, a few steps ahead (default: those that are due)."""
    ahead = controls(ROUND, db_x=fitted.nominal.scenario.setup.max_advance_mm)
    base = np.concatenate([fitted.tips, fitted.simulator.replay(fitted.state, ahead)[1]])
    depth = np.maximum.accumulate(base[:, X])
    curves, members = fitted.curves.copy(), []
    for k in due_parameters(fitted) if which is None else which:
        if fitted.slots.is_offset(k):
            continue
        parameters = fitted.parameters.copy()
        parameters[k] += fitted.prior.steps[k]
        if depth[-1] < fitted.prior.begins[k]:
            simulator = adapt_model(fitted.nominal, fitted.settings, parameters)
            members.append(Perturbed(k, float(fitted.prior.steps[k]), simulator, fitted.state))
            continue
        member, tips = _perturb(fitted, parameters, k, ahead)
        members.append(member)
        for curve, sensor in zip(curves[:, k], fitted.sensors, strict=True):
            moved = laterals(tips, sensor.column, fitted.axes) - laterals(base, sensor.column, fitted.axes)
            curve[:] = np.interp(fitted.grid, depth, moved / fitted.prior.steps[k])
    return replace(fitted, curves=curves, perturbed=tuple(members), period=fitted.period + 1)


def due_parameters(fitted: FittedInsertion) -> Iterator[int]:
    """Yield the parameters whose curves are simulated this period."""
    leading = (*range(fitted.slots.run_out.start), fitted.slots.bevel, fitted.slots.clearance)
    for place, k in enumerate(leading):
        if place % LEADING_ROUND == fitted.period % LEADING_ROUND:
            yield k
    for k in range(fitted.slots.modulus, fitted.parameters.size):
        if k % ROUND == fitted.period % ROUND:
            yield k


def _perturb(fitted: FittedInsertion, parameters: Floats, k: int, ahead: Floats) -> tuple[Perturbed, Floats]:
    """Return the needle with another value of parameter k, and its tips (m + 1 + a, 5), including a steps `ahead`.

    Moves before the parameter has an effect are not simulated again.
    """
    simulator = adapt_model(fitted.nominal, fitted.settings, parameters)
    begins = float(fitted.prior.begins[k])
    reached = int(np.argmax(np.append(fitted.tips[:, X], np.inf) > begins))  # by the move before this one
    first, state = max((stop for stop in fitted.stops if stop[0] < max(1, reached)), key=lambda stop: stop[0])
    if first == 0:
        state = fitted.settle_start(simulator, parameters)
    before = np.concatenate([fitted.tips[:first], state.tip[None]])
    now, tips = replay_scaled(simulator, state, fitted.rows[first:], fitted.axial_scale)
    later = simulator.replay(now, ahead)[1]
    member = Perturbed(k, float(fitted.prior.steps[k]), simulator, now)
    return member, np.concatenate([before, tips, later])
