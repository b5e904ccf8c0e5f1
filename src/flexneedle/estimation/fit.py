"""The step of a fit: Gauss–Newton to the maximum a posteriori."""

from dataclasses import replace

import numpy as np

from flexneedle.estimation.fitted import Fitted, FittedInsertion
from flexneedle.estimation.lateral import directions
from flexneedle.types import Laterals, X

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
