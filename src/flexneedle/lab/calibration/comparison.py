"""Predictions of recorded insertions by the model and by simple predictors, and their errors."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.calibration.baselines import Pairs, Predictor, pairs_ahead, predictors, whole
from flexneedle.lab.calibration.criteria import PredictionErrors
from flexneedle.lab.calibration.deviations import Noise
from flexneedle.lab.calibration.fit import Fitted, Problem, conclude, fit, paths_at, residuals_at
from flexneedle.lab.calibration.folds import Fold, sessions_of
from flexneedle.lab.calibration.forecast import Forecast, forecast
from flexneedle.lab.calibration.parameters import Parameter, parameters_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario, read_sensors, shallow
from flexneedle.lab.calibration.session import GuideOrder, Recording, Session
from flexneedle.scenario.model import Scenario
from flexneedle.types import Flags, Floats

MODEL = "model"
GUIDED_MM = 1.0
"""Motion of the guide from which a prediction is of a guided needle."""
WIDTH = 1.96
"""Standard deviations of half an interval of 95 %."""
_STEPS = 3  # of Gauss and Newton, of a path that is nearly linear in the bevel
_FIXED = 1e-6  # standard deviation of the prior of a parameter that is known


@dataclass(frozen=True, eq=False)
class Tested:
    """A recorded insertion with its predictions.

    Attributes:
        recording: The insertion.
        guide_order: When the guide moves between two of its steps.
        place: Its place in the session, from 0 for the first insertion to 1 for the last.
        forecast: Predictions of the model.
        simple: Simple predictors by distance ahead (mm).
        to_end: Simple predictors from the first step to the last, for an insertion in which the guide rests.
    """

    recording: Recording
    guide_order: GuideOrder
    place: float
    forecast: Forecast
    simple: Mapping[float, dict[str, Predictor]]
    to_end: dict[str, Predictor]


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of p predictions.

    Attributes:
        insertion: Index (p,) of the insertion.
        session: Name (p,) of its session.
        place: Place (p,) of the insertion in its session, from 0 to 1.
        depth: Depth (p,) in mm from which the prediction is.
        guided: Whether (p,) the guide moves by `GUIDED_MM` or more.
        size: Errors (p,) in mm by predictor.
        inside: Whether (p, axes) the reading is within the model's interval of 95 %.
    """

    insertion: NDArray[np.intp]
    session: NDArray[np.str_]
    place: Floats
    depth: Floats
    guided: Flags
    size: Mapping[str, Floats]
    inside: Flags

    def select(self, chosen: Flags) -> "Errors":
        """Return the predictions that are chosen."""
        return Errors(
            self.insertion[chosen],
            self.session[chosen],
            self.place[chosen],
            self.depth[chosen],
            self.guided[chosen],
            {name: each[chosen] for name, each in self.size.items()},
            self.inside[chosen],
        )

    def __len__(self) -> int:
        return len(self.depth)


def predict_fold(fold: Fold, ahead: Sequence[float]) -> Iterator[Tested]:
    """Yield the insertions of a fold's test with their predictions at distances ahead (mm)."""
    resting = [one for one in fold.training.recordings if one.rests]
    for part in sessions_of(fold):
        every = (*part.training.recordings, *part.test.recordings)
        scenario = fitting_scenario(fold.scenario, replace(part.test, recordings=every))
        fitted = fit_nuisances(scenario, part.training, fold.drift)
        training = part.training.recordings
        simple = {
            distance: predictors(training, [pairs_ahead(one, distance) for one in training])
            for distance in ahead
        }
        still = [one for one in training if one.rests] or resting
        to_end = predictors(still, [whole(one) for one in still]) if still else {}
        last = max(1, *part.training.order, *part.test.order)
        forecasts = forecast(fitted, part.test)
        for one, order, found in zip(part.test.recordings, part.test.order, forecasts, strict=True):
            yield Tested(one, part.test.guide_order, order / last, found, simple, to_end if one.rests else {})


def fit_nuisances(scenario: Scenario, training: Session, drift: float) -> Fitted:
    """Return the fit of all that a scenario does not hold to a session: direction of the bevel, sensor's axis, noise.

    drift: change of ln of the moduli from an insertion to the next.
    """
    used = shallow(training)
    replay, sensors = Replay.of(used), read_sensors(scenario, used)
    fixed = [_fix(each, drift) for each in parameters_of(scenario, ("drift",), 0.0) if drift != 0.0]
    free = parameters_of(scenario, ("bevel",), 0.0) if scenario.needle.bevel.offset_mm > 0.0 else ()
    start = _fit_direction(Problem(scenario, (*free, *fixed), replay, sensors), len(free))
    known = [_fix(each, value) for each, value in zip(free, start.tolist(), strict=False)]
    return fit(Problem(scenario, (*known, *fixed), replay, sensors), PredictionErrors, start)


def _fit_direction(problem: Problem, axes: int) -> Floats:
    """Return the point whose bevel, its first numbers (axes,), has the direction that fits and the known offset."""
    point = problem.start
    for _ in range(_STEPS if axes else 0):
        found = residuals_at(problem, point)
        paths = paths_at(problem, found.tips)
        ended = conclude(problem, PredictionErrors, paths, Noise.first(), point, found)
        pull = (problem.start - point) / problem.sd**2
        point = point + np.linalg.solve(ended.information, ended.slopes.T @ ended.errors + pull)
    size = max(float(np.linalg.norm(point[:axes])), 1e-9)
    bevel = point[:axes] * (problem.scenario.needle.bevel.offset_mm / size)
    return np.append(bevel, point[axes:])


def _fix(parameter: Parameter, value: float) -> Parameter:
    return replace(parameter, start=value, sd=_FIXED)


def errors_ahead(tested: Sequence[Tested], distance: float) -> Errors:
    """Return the errors of all predictions at a distance ahead (mm)."""
    return _join(
        _errors(n, one, pairs_ahead(one.recording, distance), one.simple[distance])
        for n, one in enumerate(tested)
    )


def errors_at_end(tested: Sequence[Tested]) -> Errors:
    """Return the errors at the last step, predicted from the first, of insertions in which the guide rests."""
    return _join(
        _errors(n, one, whole(one.recording), one.to_end) for n, one in enumerate(tested) if one.to_end
    )


def _errors(number: int, tested: Tested, pairs: Pairs, simple: Mapping[str, Predictor]) -> Errors:
    one, found, (i, j) = tested.recording, tested.forecast, pairs
    off, moved = found.position[i, j] - one.position[j], one.position[j] - one.position[i]
    size = {MODEL: np.linalg.norm(off, axis=1)}
    size |= {
        name: np.linalg.norm(predict(one, i, j) - moved, axis=1) if len(i) else np.zeros(0)
        for name, predict in simple.items()
    }
    return Errors(
        np.full(len(i), number),
        np.full(len(i), one.session),
        np.full(len(i), tested.place),
        one.depth[i],
        guide_motion(one)[i, j] >= GUIDED_MM,
        size,
        np.abs(off) <= WIDTH * found.sd[i, j],
    )


class SensorRow(NamedTuple):
    """Readings of a sensor along the needle beside the model's needle: rms of the errors, and as expected, in a unit.

    insertions, values: number of the insertions that have readings, and of values at their steps.
    """

    sensor: str
    unit: str
    insertions: int
    values: int
    rms: float
    expected: float

    def __str__(self) -> str:
        size = f"{self.rms:.2g} {self.unit}".rstrip()
        return (
            f"Readings of {self.sensor} in {self.insertions} insertions: {size} (rms) from the model's needle, "
            f"{self.rms / self.expected:.2g} times its noise and model error"
        )


def sensor_rows(tested: Sequence[Tested]) -> Iterator[SensorRow]:
    """Yield a row for each sensor along the needle that has readings."""
    every = [each for one in tested for each in one.forecast.along]
    for name in dict.fromkeys(each.sensor for each in every):
        own = [each for each in every if each.sensor == name]
        errors = np.concatenate([(each.size, each.expected) for each in own], axis=1)
        rms, expected = np.sqrt(np.mean(errors**2, axis=1)).tolist()
        yield SensorRow(name, own[0].unit, len(own), errors.shape[1], rms, expected)


def guide_motion(one: Recording) -> Floats:
    """Return the largest distance (k, k) in mm of the guide, after step i up to step j, from its position at i."""
    apart = np.linalg.norm(one.guide[None, :] - one.guide[:, None], axis=2)
    return np.maximum.accumulate(np.triu(apart), axis=1)


def _join(parts: Iterable[Errors]) -> Errors:
    every = list(parts)
    if not every:
        none = np.zeros(0)
        return Errors(none.astype(np.intp), none.astype(np.str_), none, none, none > 0, {}, none[:, None] > 0)
    return Errors(
        np.concatenate([each.insertion for each in every]),
        np.concatenate([each.session for each in every]),
        np.concatenate([each.place for each in every]),
        np.concatenate([each.depth for each in every]),
        np.concatenate([each.guided for each in every]),
        {name: np.concatenate([each.size[name] for each in every]) for name in every[0].size},
        np.concatenate([each.inside for each in every]),
    )
