"""The step of a fit, Gauss–Newton to the maximum a posteriori, and the derivatives that it needs.

The derivatives of the sensors' quantities with respect to the parameters are kept as curves over the depth of the tip,
a few steps ahead of it too. A few of the curves are simulated again each period, so that none is older than `ROUND`
periods.
"""

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from flexneedle.estimation.fitted import Fitted, FittedInsertion, Perturbed, adapt_models
from flexneedle.estimation.lateral import directions
from flexneedle.simulator.control import controls
from flexneedle.types import DB_X, Laterals, X, laterals

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
    fitted = fitted.change(precision=precision)
    step = np.linalg.solve(precision, gradient)
    if not np.isfinite(step).all():
        return fitted.simulate_with(fitted.parameters)
    goal = np.clip(fitted.parameters + step, *prior.bounds)

    def cost(other: FittedInsertion) -> float:
        squares = np.abs(np.concatenate(other.residuals)) ** 2
        return float(0.5 * (squares / variance).sum()) + prior.cost(other.parameters)

    most, trial = cost(fitted), fitted
    tried = [fitted.parameters + share * (goal - fitted.parameters) for share in _SHARES]
    # Most often the first will do; if not, the others take as long together as another one.
    for trial in chain(fitted.simulate_each(tried[:1]), fitted.simulate_each(tried[1:])):
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
    """Simulate curves again, a few steps ahead (default: those that are due).

    All needles are simulated together, each from its start, the present one with them.
    """
    due = [k for k in (due_parameters(fitted) if which is None else which) if not fitted.slots.is_offset(k)]
    steps = fitted.prior.steps
    parameters = [fitted.parameters + np.where(np.arange(steps.size) == k, steps, 0.0) for k in due]
    ahead = controls(ROUND, db_x=fitted.nominal.scenario.setup.max_advance_mm)
    goal = float(fitted.tips[:, X].max()) + float(ahead[:, DB_X].sum())
    begun = [j for j, k in enumerate(due) if goal >= fitted.prior.begins[k]]
    models, states, tips = fitted.simulate_all([fitted.parameters, *(parameters[j] for j in begun)])
    others = [parameters[j] for j in range(len(due)) if j not in begun]
    unreached = iter(adapt_models(fitted.nominal, fitted.slots, fitted.settings.cell_mm, others))
    rows = np.tile(ahead, (len(models), 1, 1))
    later = fitted.nominal.rollout(states, rows, models=models, limits=False).tips
    base, *moved = np.concatenate([tips, later], axis=1)
    depth, curves, members = np.maximum.accumulate(base[:, X]), fitted.curves.copy(), []
    for j, k in enumerate(due):
        step = float(steps[k])
        if j not in begun:  # the needle has not come where it matters
            members.append(Perturbed(k, step, next(unreached), fitted.state))
            continue
        place = begun.index(j)
        members.append(Perturbed(k, step, models[1 + place], states[1 + place]))
        for curve, sensor in zip(curves[:, k], fitted.sensors, strict=True):
            change = laterals(moved[place], sensor.column, fitted.axes) - laterals(
                base, sensor.column, fitted.axes
            )
            curve[:] = np.interp(fitted.grid, depth, change / step)
    return fitted.change(curves=curves, perturbed=tuple(members), period=fitted.period + 1)


def due_parameters(fitted: FittedInsertion) -> Iterator[int]:
    """Yield the parameters whose curves are simulated this period."""
    leading = (*range(fitted.slots.run_out.start), fitted.slots.bevel, fitted.slots.clearance)
    for place, k in enumerate(leading):
        if place % LEADING_ROUND == fitted.period % LEADING_ROUND:
            yield k
    for k in range(fitted.slots.modulus, fitted.parameters.size):
        if k % ROUND == fitted.period % ROUND:
            yield k
