"""Design of experiments: the insertions that shrink the intervals of a calibration most."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import compress, product

import numpy as np

from flexneedle.lab.calibration.criteria import Likelihood
from flexneedle.lab.calibration.deviations import KINDS, Noise
from flexneedle.lab.calibration.fit import Problem, paths_at, residuals_at
from flexneedle.lab.calibration.parameters import Parameter, parameters_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.session import Recording, Session
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_STEPS = 20  # of an insertion
_SHARES = (0.1, 0.2, 0.35, 0.5)  # of the depth, at which the guide moves
_SIZES = (0.25, 0.5, 1.0)  # of motions of the guide, as shares of the largest
_LARGEST_MM = 6.0
_MODEL_ERROR = {
    "heading": 5e-4,
    "lateral": 0.03,
    "turn": 0.2,
    "response": 0.2,
    "gain": 0.15,
    "curvature": 1e-4,
}
"""Errors of the model in recorded gels (docs/decisions/0036)."""
_WIDE = 1.96


@dataclass(frozen=True)
class Proposal:
    """A proposed insertion.

    Attributes:
        depth: Its depth (mm).
        moves: Depths (mm) at which the guide moves, each with its position y and, in space, z (mm) from there on.
        widths: Half-widths of intervals of 95 % after this and all earlier proposals, in the coordinates of the fit.
    """

    depth: float
    moves: tuple[tuple[float, ...], ...]
    widths: tuple[tuple[Parameter, float], ...]


def propose(scenario: Scenario, names: Sequence[str], count: int) -> list[Proposal]:
    """Return `count` insertions, the one first that shrinks the intervals of parameters most, then the next.

    They end at the depth of the target. The noise is the tracker's, with the errors of the model in recorded gels.
    Raises InputError for unknown parameters.
    """
    depth = scenario.target.depth_mm
    session = Session(tuple(_candidates(scenario, depth)))
    prepared = fitting_scenario(scenario, session)
    parameters = parameters_of(prepared, names, depth)
    problem = Problem(prepared, parameters, Replay.of(session))
    gains = _informations(problem, _usual_noise(scenario))
    information, proposals = np.diag(problem.sd**-2.0), list[Proposal]()
    for _ in range(count):
        best = min(range(len(gains)), key=lambda n: _size(information + gains[n], parameters))
        information = information + gains[best]
        one, widths = session.recordings[best], _WIDE * _deviations(information, parameters)
        proposals.append(
            Proposal(depth, tuple(_moves(one)), tuple(zip(parameters, widths.tolist(), strict=True)))
        )
    return proposals


def _candidates(scenario: Scenario, depth: float) -> Iterator[Recording]:
    """Yield an insertion with the guide at rest, and others with motions to and fro by size, direction and depths."""
    axes, steps = scenario.setup.axes, np.linspace(0.0, depth, _STEPS + 1)
    largest = min(_LARGEST_MM, scenario.setup.max_guide_travel_mm) if scenario.setup.has_guide else 0.0
    directions = np.array([[1.0], [-1.0]]) if axes == 1 else np.array([[1.0, 0.0], [0.0, 1.0], [-0.7, 0.7]])
    places = [round(share * _STEPS) for share in _SHARES]
    zero = np.zeros((len(steps), axes))
    slope = zero if scenario.tracker.direction_jitter else np.full_like(zero, np.nan)
    guides = [zero]
    if largest > 0.0:
        patterns = [pattern for pattern in product((False, True), repeat=len(places)) if any(pattern)]
        for size, direction, pattern in product(_SIZES, directions, patterns):
            guides.append(zero.copy())
            for k, place in enumerate(compress(places, pattern)):
                guides[-1][place:] = (-1.0) ** k * size * largest * direction
    for guide in guides:
        yield Recording("design", "", 0.0 * steps, steps, zero, slope, guide, zero, 0.0 * steps)


def _informations(problem: Problem, noise: Noise) -> list[Floats]:
    """Return the information (p + s, p + s) of each recording, by the likelihood."""
    found = residuals_at(problem, problem.start)
    paths = paths_at(problem, found.tips)
    rows = Likelihood.of(paths, noise, found.values).rows
    parts = [each @ slope for each, slope in zip(rows, found.slopes, strict=True)]
    axes = problem.replay.axes
    return [
        sum((part.T @ part for part in parts[n : n + axes]), np.zeros((len(problem.start),) * 2))
        for n in range(0, len(parts), axes)
    ]


def _deviations(information: Floats, parameters: Sequence[Parameter]) -> Floats:
    found: Floats = np.sqrt(np.diag(np.linalg.inv(information)))[: len(parameters)]
    return found


def _size(information: Floats, parameters: Sequence[Parameter]) -> float:
    """Return the sum of the logarithms of all standard deviations of parameters."""
    return float(np.log(_deviations(information, parameters)).sum())


def _moves(one: Recording) -> Iterator[tuple[float, ...]]:
    """Yield depth and position of the guide where it moves."""
    for k in np.flatnonzero(one.moved).tolist():
        yield float(one.depth[k]), *one.guide[k].tolist()


def _usual_noise(scenario: Scenario) -> Noise:
    """Return the noise of a scenario's tracker, and the errors of the model in recorded gels."""
    tracker = scenario.tracker
    readings = {"position": tracker.jitter_per_axis, "slope": tracker.direction_jitter or 0.0}
    sd = dict.fromkeys(KINDS, 1e-4) | {"shift": 5.0} | _MODEL_ERROR | readings
    return Noise(np.array([max(sd[kind], 1e-4) for kind in KINDS]))
