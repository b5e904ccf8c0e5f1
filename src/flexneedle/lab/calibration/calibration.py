"""Calibration: a scenario fitted to recorded insertions, with intervals, and what it does not identify."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from flexneedle.errors import InputError
from flexneedle.lab.calibration.criteria import Criterion, Likelihood, PredictionErrors
from flexneedle.lab.calibration.deviations import KINDS
from flexneedle.lab.calibration.findings import find_notes, find_problems
from flexneedle.lab.calibration.fit import Fitted, Problem, fit, reading_share
from flexneedle.lab.calibration.intervals import SAME_COST, Interval, fixed, intervals, profile
from flexneedle.lab.calibration.parameters import (
    Parameter,
    Trial,
    at_same_curvature,
    find_parameter,
    parameters_of,
    trial_of,
    with_trial,
)
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario, read_sensors, shallow
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

DEFAULT_FIT = ("stiffness", "bevel", "guide")
_FACTORS = (1.0, 0.1, 10.0, 100.0)
"""On the stiffness, from which fits start."""
_YIELDS = (0.3,)
"""Factors on the yield, likewise."""
_READINGS = 0.1  # share of errors of readings from which the likelihood is used; recorded gels: below 0.01
_FIRST_ROUNDS = 2  # until the noise decides on the criterion
_PROFILED = 1.5  # half-widths of the interval, to either side
_ADVICE = {
    "stiffness": "move the guide by ±{guide:g} mm at depths of {depths} mm",
    "guide": "move the guide by ±{guide:g} mm at depths of {depths} mm",
    "clearance": "move the guide to and fro by {guide:g} mm with the tip near the skin",
    "yield": "move the guide by ±{guide:g} and ±{more:g} mm at depths of {depths} mm",
    "drift": "repeat the first insertion at the end of the session",
}


class Profile(NamedTuple):
    """A profile likelihood: values (k,) of a parameter, and the rise (k,) of the loss with all others fitted again."""

    parameter: Parameter
    values: Floats
    rise: Floats


@dataclass(frozen=True, eq=False)
class Calibration:
    """A scenario fitted to a session.

    Attributes:
        start: The scenario before the fit.
        session: The insertions.
        fitted: The fit of all parameters with the least loss.
        others: The fits from other starts.
        final: The fit with parameters that the data do not identify at their values in the scenario.
        intervals: Intervals of 95 % by label, in the coordinates of the fit.
        tears: Whether a model that lacks something predicts the recordings better with tissue that tears.
    """

    start: Scenario
    session: Session
    fitted: Fitted
    others: tuple[Fitted, ...]
    final: Fitted
    intervals: dict[str, Interval]
    tears: bool

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The fitted parameters."""
        return self.fitted.problem.parameters

    @cached_property
    def unidentified(self) -> dict[str, str]:
        """Parameters that the data do not identify, by label, each with the experiment that would."""
        deepest = max(float(one.depth.max()) for one in self.session.recordings)
        values = {
            "guide": 3.0, "more": 6.0,
            "depths": ", ".join(f"{share * deepest:.0f}" for share in (0.15, 0.3, 0.5)),
        }  # fmt: skip
        return {
            each.label: _ADVICE[each.name].format(**values)
            for each in self.parameters
            if not self.intervals[each.label].identified
        }

    @cached_property
    def trial(self) -> Trial:
        """Values of all parameters: the scenario's for those that are not identified."""
        return trial_of(self.start, self.parameters, self.final.point[: len(self.parameters)])

    @property
    def direction(self) -> float:
        """Angle (rad) of the bevel from y towards z in the recordings, at the roll 0."""
        return float(np.angle(complex(*self.trial.bevel)))

    @cached_property
    def scenario(self) -> Scenario:
        """The calibrated scenario, with priors of `adaptive-mpc` from the intervals."""
        return with_trial(self.start, self.trial).with_values(dict(self._priors()))

    def _priors(self) -> Iterator[tuple[str, float]]:
        """Yield the priors of the controller: interval, and variation from insertion to insertion.

        A bevel that belongs to a stiffness which is not identified has none.
        """
        gain = float(self.final.noise.sd[KINDS.index("gain")])
        found: dict[str, list[float]] = {}
        for each in self.parameters:
            sd = np.inf if each.label in self.unidentified else self._sd(each)
            found.setdefault(each.name, []).append(sd)
        modulus = max(found.get("stiffness", [np.inf]))
        if np.isfinite(modulus):
            yield "control.adaptive_mpc.modulus_log_sd", round(float(np.hypot(modulus, gain)), 3)
        if "bevel" in found and not np.isinf(found.get("stiffness", [0.0])).any():
            size = max(float(np.linalg.norm(self.trial.bevel)), 1e-3)
            sd = float(np.linalg.norm(found["bevel"] * self.trial.bevel)) / size**2
            yield "control.adaptive_mpc.bevel_sd", round(float(np.clip(np.hypot(sd, gain), 0.05, 1.0)), 3)
        if np.isfinite(clearance := max(found.get("clearance", [np.inf]))):
            yield "control.adaptive_mpc.clearance_sd_mm", round(clearance, 4)

    def _sd(self, parameter: Parameter) -> float:
        """Return the standard deviation of a parameter in its coordinate."""
        interval = self.intervals[parameter.label]
        return 0.5 * (interval.high - interval.low) / 1.96

    @cached_property
    def problems(self) -> tuple[str, ...]:
        """Reasons not to trust the fit: not settled or converged, at a bound, not moved, two minima."""
        return tuple(find_problems(self))

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Lines on data that are not used, values that the recordings do not determine, and tissue that tears."""
        return tuple(find_notes(self))

    def __repr__(self) -> str:
        values = ", ".join(f"{label} {value}" for label, value, _ in self.table())
        return f"<Calibration with {len(self.session.recordings)} insertions: {values}>"

    def profile(self, name: str, count: int = 9) -> Profile:
        """Return the profile of a parameter, by its name or its label. Raises InputError for another."""
        k = find_parameter(self.parameters, name)
        parameter = self.parameters[k]
        interval = self.intervals[parameter.label]
        width = _PROFILED * (interval.high - interval.value)
        at = np.clip(interval.value + width * np.linspace(-1.0, 1.0, count), parameter.low, parameter.high)
        values = np.array([parameter.value(each) for each in at.tolist()])
        return Profile(parameter, values, profile(self.fitted, k, at.tolist()))

    def table(self) -> list[tuple[str, str, str]]:
        """Return rows of a table: parameter, value, interval of 95 %."""
        rows = []
        for each in self.parameters:
            interval = self.intervals[each.label]
            if not interval.identified:
                rows.append((each.label, "not identified", self.unidentified[each.label]))
                continue
            value, low, high = (each.value(x) for x in (interval.value, interval.low, interval.high))
            rows.append((each.label, f"{value:.4g} {each.unit}".rstrip(), f"{low:.4g} to {high:.4g}"))
        return rows

    def by_readings(self) -> list[tuple[str, ...]]:
        """Return rows of a table: parameter, half-width of its interval of 95 % by the tip, by sensors, and by both.

        With the errors at the fit of all parameters, before the scatter of insertions; none without sensors along the
        needle.
        """
        fitted = self.fitted
        if not fitted.problem.sensors:
            return []
        parts = slice(fitted.tip_errors), slice(fitted.tip_errors, None), slice(None)
        widths = np.stack([1.96 * fitted.sds_by(part)[: len(self.parameters)] for part in parts], axis=1)
        return [
            (each.label, *(each.format_width(width) for width in row))
            for each, row in zip(self.parameters, widths.tolist(), strict=True)
        ]


def calibrate(
    scenario: Scenario | str | Path, session: Session, fit: Sequence[str] = DEFAULT_FIT
) -> Calibration:
    """Fit a scenario to a session.

    Args:
        scenario: Start of the fit, and priors; as for `load_scenario`.
        session: Recorded insertions, from `load_session`.
        fit: Parameters: stiffness, bevel, guide, clearance, yield, drift.

    Raises:
        InputError: The session is empty, or a parameter cannot be fitted in this scenario.
        ScenarioError: The scenario cannot be used for these recordings.
    """
    if not session.recordings:
        raise InputError("session: has no recordings")
    loaded = load_scenario(scenario)
    problem = make_problem(loaded, session, fit)
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: more threads wait for each other
        best, others = _minimize(problem)
        return Calibration(loaded, session, best, others, *_identify(best), _tears(best))


def make_problem(scenario: Scenario, session: Session, names: Sequence[str]) -> Problem:
    """Return the fit of parameters by name. Raises as `calibrate`."""
    used = shallow(session)
    prepared, replay = fitting_scenario(scenario, used), Replay.of(used)
    parameters = parameters_of(prepared, names, replay.reached)
    return Problem(prepared, parameters, replay, read_sensors(prepared, used))


def _minimize(problem: Problem) -> tuple[Fitted, tuple[Fitted, ...]]:
    """Return the fit of the least loss, and those from other starts.

    By the likelihood if predictions have more error from the readings than from what the model lacks, else by their
    errors.
    """
    coarse = [fit(problem, Likelihood, start, rounds=1) for start in _starts(problem)]
    lead, *others = sorted(coarse, key=attrgetter("cost"))
    first = fit(problem, Likelihood, lead.point, lead.noise, rounds=_FIRST_ROUNDS)
    criterion: type[Criterion]
    if reading_share(first) > _READINGS:
        criterion, starts = Likelihood, [first.point, *(each.point for each in others[:1])]
    else:
        criterion, starts = PredictionErrors, [problem.start, first.point, *_starts(problem, _YIELDS)]
    best, *rest = sorted(
        (fit(problem, criterion, start, first.noise) for start in starts), key=attrgetter("cost")
    )
    return best, tuple(rest)


def _starts(problem: Problem, yields: Sequence[float] = (1.0,)) -> Iterator[Floats]:
    """Yield starts of a fit: factors on the stiffness at the same curvature of the path, or on the yield."""
    names = [each.name for each in problem.parameters]
    stiffness, torn = (np.array([name == wanted for name in names]) for wanted in ("stiffness", "yield"))
    factors = _FACTORS if stiffness.any() and yields == (1.0,) else (1.0,)
    for factor, share in product(factors, yields if torn.any() else (1.0,)):
        start = at_same_curvature(problem.parameters, problem.start, math.log(factor))
        start[: len(names)][stiffness] += math.log(factor)
        start[: len(names)][torn] += math.log(share)
        yield np.clip(start, *problem.bounds)


def _tears(fitted: Fitted) -> bool:
    """Return whether a model that lacks something predicts the recordings better with a yield."""
    problem = fitted.problem
    fits_yield = any(each.name == "yield" for each in problem.parameters)
    if fitted.criterion is not PredictionErrors or fits_yield or not problem.moves:
        return False
    (torn,) = parameters_of(problem.scenario, ("yield",), problem.replay.reached)
    start = np.insert(fitted.point, len(problem.parameters), torn.start)
    wider = replace(problem, parameters=(*problem.parameters, torn))
    return fitted.cost - fit(wider, PredictionErrors, start, fitted.noise).cost > SAME_COST


def _identify(fitted: Fitted) -> tuple[Fitted, dict[str, Interval]]:
    """Return the fit with what the data do not identify at the scenario's values, and the intervals of all parameters.

    One parameter is fixed at a time, the least identified first: another may be identified once it is. A parameter
    stays free if the data contradict its value in the scenario. Where the scenario has no value, none or the prior's
    mean is taken, whichever fits better.
    """
    found: dict[str, Interval] = {}
    while True:
        labels = [each.label for each in fitted.problem.parameters]
        now = dict(zip(labels, intervals(fitted), strict=True))
        open_ones = [label for label in labels if label not in found and not now[label].identified]
        if not open_ones:
            return fitted, now | found
        widths = {each.label: each.useful for each in fitted.problem.parameters}
        worst = max(open_ones, key=lambda label: (now[label].high - now[label].low) / widths[label])
        k = labels.index(worst)
        parameter = fitted.problem.parameters[k]
        without = min(
            (fixed(fitted, k, value) for value in {parameter.own, parameter.start}), key=attrgetter("cost")
        )
        refuted = without.cost - fitted.cost > SAME_COST and fitted.problem.moves
        found[worst] = replace(now[worst], refuted=refuted)
        fitted = fitted if refuted else without
