"""Intervals of fitted parameters: jackknife over insertions, profile likelihood, and what the data do not identify."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, t

from flexneedle.lab.calibration.fit import Fitted, Problem, fit
from flexneedle.types import Floats

_LEVEL = 0.95
_FAR = 1.4  # distance of the points of the profile that test whether a logarithm is identified: a factor 4


@dataclass(frozen=True)
class Interval:
    """A parameter with its interval, in the coordinate of the fit.

    identified: whether the data give it; bound: "lower" or "upper" if the fit ended there, else "".
    """

    value: float
    low: float
    high: float
    identified: bool
    bound: str = ""


def jackknife(fitted: Fitted) -> Floats:
    """Return the covariance (p + s, p + s) of the point by leaving out one recording at a time.

    Each point without a recording is one Gauss–Newton step from that of all, in which the prior keeps its weight
    (Efron and Stein 1981, doi:10.1214/aos/1176345462).
    """
    moved = fitted.without
    off = moved - moved.mean(axis=0)
    count = len(moved)
    covariance: Floats = (count - 1.0) / count * off.T @ off
    return covariance


def intervals(fitted: Fitted) -> list[Interval]:
    """Return the parameters of a fit with their intervals of 95 %.

    Their half-width is the larger one by jackknife, with Student's t, and by the information of data and prior.
    """
    problem, size = fitted.problem, len(fitted.problem.parameters)
    recordings = len(np.unique(fitted.groups))
    by_model = np.sqrt(np.diag(np.linalg.inv(fitted.information)))[:size] * t.ppf(0.5 + 0.5 * _LEVEL, 1e6)
    widths = by_model
    if recordings > 2:
        by_data = np.sqrt(np.diag(jackknife(fitted)))[:size] * t.ppf(0.5 + 0.5 * _LEVEL, recordings - 1)
        widths = np.maximum(by_model, by_data)
    useful = np.array([each.useful for each in problem.parameters])
    known = np.array(identified(fitted)) & (widths <= useful)
    low, high = problem.bounds[:, :size]
    found = []
    for k, (value, width) in enumerate(zip(fitted.point[:size].tolist(), widths.tolist(), strict=True)):
        near = 1e-3 * (high[k] - low[k])
        bound = "lower" if value - low[k] < near else "upper" if high[k] - value < near else ""
        found.append(Interval(value, value - width, value + width, bool(known[k]), bound))
    return found


def identified(fitted: Fitted) -> list[bool]:
    """Return whether the data identify each parameter, without its prior.

    A parameter is identified if the interval by the data alone is narrow enough to be useful, and, of a logarithm, if
    no value a factor 4 away fits as well once the others follow.
    """
    problem, size = fitted.problem, len(fitted.problem.parameters)
    data = fitted.information - np.diag(problem.sd**-2.0)
    found = []
    for k, parameter in enumerate(problem.parameters):
        others = [j for j in range(len(data)) if j != k]
        rest = data[np.ix_(others, others)] + np.diag(problem.sd[others] ** -2.0)
        left = data[k, k] - data[k, others] @ np.linalg.solve(rest, data[others, k])
        width = 1.96 / np.sqrt(max(left, 1e-300))
        good = bool(width <= parameter.useful)
        if good and parameter.log and parameter.name == "stiffness":
            good = all(rise > chi2.ppf(_LEVEL, 1) for rise in _rises(fitted, k))
        found.append(good)
    return found[:size]


def _rises(fitted: Fitted, k: int) -> Iterator[float]:
    """Yield the rise of the cost at parameters a factor 4 away, without the prior of the parameter."""
    for sign in (-1.0, 1.0):
        goal = fitted.point[k] + sign * _FAR
        if fitted.problem.bounds[0, k] < goal < fitted.problem.bounds[1, k]:
            yield fixed(fitted, k, goal).cost - fitted.cost


def fixed(fitted: Fitted, k: int, value: float) -> Fitted:
    """Return the fit with one parameter at a value (in its coordinate), and the others fitted again."""
    problem, parameter = fitted.problem, fitted.problem.parameters[k]
    tight = replace(parameter, start=value, sd=1e-4)
    parameters = (*problem.parameters[:k], tight, *problem.parameters[k + 1 :])
    start = fitted.point.copy()
    start[k] = value
    return fit(Problem(problem.scenario, parameters, problem.replay), fitted.criterion, start, fitted.noise)


def profile(fitted: Fitted, k: int, values: Sequence[float]) -> Floats:
    """Return the rise of −2 ln of the likelihood at values of a parameter, with all others fitted again."""
    return np.array([fixed(fitted, k, value).cost for value in values]) - fitted.cost
