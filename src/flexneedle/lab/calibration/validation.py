"""Validation: predictions of recorded insertions by a calibrated scenario and by simple predictors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.calibration.baselines import Pair, guide_motion, pairs_ahead, predictors
from flexneedle.lab.calibration.fit import Fitted, Problem, fit, residuals_at
from flexneedle.lab.calibration.forecast import Forecast, forecast
from flexneedle.lab.calibration.parameters import Parameter
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

MODEL = "model"
GUIDED_MM = 1.0
"""Motion of the guide from which a prediction is of a guided needle."""
_WIDTH = 1.96  # standard deviations of an interval of 95 %


@dataclass(frozen=True, eq=False)
class Predicted:
    """A prediction and its errors: pair, errors (mm) by predictor, whether each axis is within its interval."""

    pair: Pair
    session: str
    order: int
    depth: float
    guided: bool
    errors: dict[str, float]
    covered: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Row:
    """Errors of all predictors in a group of predictions: name of the group, ahead (mm), number, medians, 95 %."""

    group: str
    ahead: float
    count: int
    median: dict[str, float]
    most: dict[str, float]
    coverage: float


@dataclass(frozen=True, eq=False)
class Validation:
    """Predictions of recordings by the model and by the simple predictors.

    ends: errors (mm) at the end of insertions in which the guide rests, by predictor, from their first step.
    """

    predicted: tuple[Predicted, ...]
    ends: dict[str, Floats]
    training: int

    @cached_property
    def ahead(self) -> tuple[float, ...]:
        """Distances of the predictions."""
        return tuple(sorted({each.pair.ahead for each in self.predicted}))

    def rows(self) -> Iterator[Row]:
        """Yield the rows of the table: all, guided, by depth, by order, by session."""
        middle = np.median([each.order for each in self.predicted]) if self.predicted else 0.0
        groups = {
            "all": lambda _: True,
            "guided": lambda each: each.guided,
            "guided, to 45 mm": lambda each: each.guided and each.depth <= 45.0,
            "to 20 mm": lambda each: each.depth <= 20.0,
            "20 to 45 mm": lambda each: 20.0 < each.depth <= 45.0,
            "from 45 mm": lambda each: each.depth > 45.0,
            "first half": lambda each: each.order <= middle,
            "second half": lambda each: each.order > middle,
        }
        for name in dict.fromkeys(each.session for each in self.predicted):
            groups[name] = lambda each, name=name: each.session == name
        for group, has in groups.items():
            for ahead in self.ahead:
                chosen = [each for each in self.predicted if each.pair.ahead == ahead and has(each)]
                if chosen:
                    yield _row(group, ahead, chosen)

    def verdict(self) -> Iterator[str]:
        """Yield in plain words where the model wins and where it does not."""
        for row in self.rows():
            if row.group not in ("all", "guided"):
                continue
            best = min((name for name in row.median if name != MODEL), key=lambda name: row.median[name])
            ours, theirs = row.median[MODEL], row.median[best]
            word = "beats" if ours < theirs else "does not beat"
            yield (
                f"{row.ahead:g} mm ahead, {row.group}: the model {word} the best simple predictor, {best}: median "
                f"{ours:.2f} and {theirs:.2f} mm, 95 % {row.most[MODEL]:.2f} and {row.most[best]:.2f} mm"
            )


def _row(group: str, ahead: float, chosen: Sequence[Predicted]) -> Row:
    names = chosen[0].errors
    errors = {name: np.array([each.errors[name] for each in chosen]) for name in names}
    return Row(
        group,
        ahead,
        len(chosen),
        {name: float(np.median(values)) for name, values in errors.items()},
        {name: float(np.quantile(values, 0.95)) for name, values in errors.items()},
        float(np.mean([inside for each in chosen for inside in each.covered])),
    )


def validate(
    scenario: Scenario, test: Session, training: Session, ahead: Sequence[float] = (5.0, 10.0, 20.0, 40.0)
) -> Validation:
    """Predict the recordings of `test` with a calibrated scenario, and with simple predictors fitted to `training`.

    The errors of readings and of the model, and the axis of the sensor, are estimated from `training`, too.
    Raises InputError if a session has no recordings, or if none of `test` is long enough for a prediction.
    """
    if not training.recordings or not test.recordings:
        raise InputError(
            "validation needs recordings to train on, and others to test: at least two in a session"
        )
    prepared = fitting_scenario(scenario, replace(test, recordings=(*training.recordings, *test.recordings)))
    noise = fit(Problem(prepared, _direction_only(prepared), Replay.of(training)))
    return compare(noise, test, training, ahead)


def _direction_only(scenario: Scenario) -> tuple[Parameter, ...]:
    """Return the parameters that a scenario does not hold: none."""
    del scenario
    return ()


def compare(fitted: Fitted, test: Session, training: Session, ahead: Sequence[float]) -> Validation:
    """Return the validation of a fit on other recordings."""
    problem = replace(fitted.problem, replay=Replay.of(test))
    tips = residuals_at(problem, fitted.point, derivatives=False).tips
    problem = replace(problem, replay=problem.replay.corrected(tips))
    forecasts = forecast(replace(fitted, problem=problem))
    predicted = [
        one
        for distance in ahead
        for one in _predict(test, training, forecasts, pairs_ahead(test.recordings, distance), distance)
    ]
    if not predicted:
        raise InputError(f"ahead = {min(ahead):g}: no recording has steps that far apart")
    return Validation(tuple(predicted), _ends(test, training, forecasts), len(training.recordings))


def _predict(
    test: Session, training: Session, forecasts: Sequence[Forecast], pairs: Sequence[Pair], ahead: float
) -> Iterator[Predicted]:
    simple = predictors(training.recordings, pairs_ahead(training.recordings, ahead))
    for pair in pairs:
        one, found = test.recordings[pair.recording], forecasts[pair.recording]
        off = found.position[pair.i, pair.j] - one.position[pair.j]
        moved = one.position[pair.j] - one.position[pair.i]
        errors = {MODEL: float(np.linalg.norm(off))}
        errors |= {
            name: float(np.linalg.norm(predict(one, pair.i, pair.j) - moved))
            for name, predict in simple.items()
        }
        inside = tuple((np.abs(off) <= _WIDTH * found.sd[pair.i, pair.j]).tolist())
        yield Predicted(
            pair,
            one.session,
            test.order[pair.recording],
            float(one.depth[pair.i]),
            guide_motion(one, pair.i, pair.j) >= GUIDED_MM,
            errors,
            inside,
        )


def _ends(test: Session, training: Session, forecasts: Sequence[Forecast]) -> dict[str, Floats]:
    """Return errors at the end of insertions in which the guide rests, from their first step."""
    rests = [k for k, one in enumerate(test.recordings) if one.guide_moves < 0.05]
    whole = [
        Pair(k, 0, len(one.depth) - 1, np.ptp(one.depth))
        for k, one in enumerate(training.recordings)
        if one.guide_moves < 0.05
    ]
    if not rests or not whole:
        return {}
    simple = predictors(training.recordings, whole)
    errors: dict[str, list[float]] = {MODEL: [], **{name: [] for name in simple}}
    for k in rests:
        one = test.recordings[k]
        last, moved = len(one.depth) - 1, one.position[-1] - one.position[0]
        errors[MODEL].append(float(np.linalg.norm(forecasts[k].position[0, last] - one.position[-1])))
        for name, predict in simple.items():
            errors[name].append(float(np.linalg.norm(predict(one, 0, last) - moved)))
    return {name: np.array(values) for name, values in errors.items()}
