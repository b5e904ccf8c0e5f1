"""Intervals of fitted parameters: jackknife over insertions, profile likelihood, and what the data do not identify."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, t

from flexneedle.lab.calibration.fit import Fitted, fit
from flexneedle.lab.calibration.parameters import at_same_curvature
from flexneedle.types import Floats

_LEVEL = 0.95
LEAST_RECORDINGS = 3
"""Insertions from which a jackknife is made."""
_NORMAL = (
    1.96  # standard deviations; with three insertions Student's t would leave every stiffness unidentified
)
SAME_COST = float(chi2.ppf(_LEVEL, 1))
"""Rise of the cost up to which two values of a parameter fit alike."""
_BY_MOTION = ("stiffness", "guide", "clearance", "yield")
_NARROWED = 0.8  # of the prior's standard deviation
_FAR = 1.4  # distance of the points of the profile that test whether a logarithm is identified: a factor 4


@dataclass(frozen=True)
class Interval:
    """A parameter with its interval, in the coordinate of the fit.

    identified: whether the data give it; bound: "lower" or "upper" if the fit ended there, else ""; refuted: whether
    the data do not give it, but contradict the scenario's value.
    """

    value: float
    low: float
    high: float
    identified: bool
    bound: str = ""
    refuted: bool = False


def jackknife(fitted: Fitted) -> Floats:
    """Return the covariance (p + s, p + s) of the point by leaving out one recording at a time.

    Each point without a recording is one Gauss–Newton step from the point of all, in which the prior keeps its weight
    (Efron and Stein 1981, doi:10.1214/aos/1176345462).
    """
    moved = fitted.without
    off = moved - moved.mean(axis=0)
    covariance: Floats = (len(moved) - 1.0) / len(moved) * off.T @ off
    return covariance


def intervals(fitted: Fitted) -> list[Interval]:
    """Return the parameters of a fit with their intervals of 95 %.

    The variance is the sum of those by the information of data and prior and by jackknife, with Student's t: on
    synthetic insertions each alone covers 70 to 90 % (studies/calibration.py).
    """
    problem, size = fitted.problem, len(fitted.problem.parameters)
    recordings = len(problem.replay.recordings)
    variance, freedom = np.diag(np.linalg.inv(fitted.information)), 1e6
    if recordings >= LEAST_RECORDINGS:
        variance, freedom = variance + np.diag(jackknife(fitted)), recordings - 1.0
    sd = np.sqrt(variance)[:size]
    widths = sd * t.ppf(0.5 + 0.5 * _LEVEL, freedom)
    low, high = problem.bounds[:, :size]
    found = []
    for k, (value, width) in enumerate(zip(fitted.point[:size].tolist(), widths.tolist(), strict=True)):
        near = 1e-3 * (high[k] - low[k])
        # A clearance of 0 is a result.
        bound = (
            "lower" if low[k] != 0.0 and value - low[k] < near else "upper" if high[k] - value < near else ""
        )
        found.append(
            Interval(
                value,
                value - width,
                value + width,
                _is_identified(fitted, k, _NORMAL * float(sd[k])),
                bound,
            )
        )
    return found


def _is_identified(fitted: Fitted, k: int, width: float) -> bool:
    """Return whether an interval is useful, and, of a stiffness, no value a factor 4 away fits as well.

    The prior of a length is a measurement of it; a stiffness and a bevel have very wide priors. Without motion across
    the needle the entry alone identifies nothing but the bevel.
    """
    parameter = fitted.problem.parameters[k]
    if width > parameter.useful or (parameter.name in _BY_MOTION and not _is_informed(fitted, k)):
        return False
    return parameter.name != "stiffness" or all(rise > SAME_COST for rise in _rises(fitted, k))


def _is_informed(fitted: Fitted, k: int) -> bool:
    """Return whether guide or base moves, or sensors along the needle give a parameter without the tip."""
    along = fitted.sds_by(slice(fitted.tip_errors, None))[k]
    useful = fitted.problem.parameters[k].useful
    return fitted.problem.moves or bool(_NORMAL * along < useful and along < _NARROWED * fitted.problem.sd[k])


def _rises(fitted: Fitted, k: int) -> Iterator[float]:
    """Yield the rise of the cost at parameters a factor 4 away, without the prior of the parameter."""
    for sign in (-1.0, 1.0):
        goal = fitted.point[k] + sign * _FAR
        if fitted.problem.bounds[0, k] < goal < fitted.problem.bounds[1, k]:
            yield fixed(fitted, k, goal, rounds=1).cost - fitted.cost


def fixed(fitted: Fitted, k: int, value: float, **limits: int) -> Fitted:
    """Return the fit with one parameter at a value (in its coordinate), and the others fitted again."""
    problem, parameter = fitted.problem, fitted.problem.parameters[k]
    tight = replace(parameter, start=value, sd=1e-4)
    parameters = (*problem.parameters[:k], tight, *problem.parameters[k + 1 :])
    start = fitted.point.copy()
    if parameter.name == "stiffness":
        layers = sum(each.name == "stiffness" for each in parameters)
        start = at_same_curvature(parameters, start, (value - start[k]) / layers)
    start[k] = value
    return fit(replace(problem, parameters=parameters), fitted.criterion, start, fitted.noise, **limits)


def profile(fitted: Fitted, k: int, values: Sequence[float]) -> Floats:
    """Return the rise of the loss above its least at values of a parameter, with all others fitted again."""
    costs = np.array([fixed(fitted, k, value).cost for value in values])
    rise: Floats = costs - costs.min()
    return rise
