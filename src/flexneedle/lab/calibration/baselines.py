"""Simple predictors of a path, fitted to the same recordings as the model: what a calibration has to beat.

Each predicts the displacement (axes,) of the tip from a step i to a step j of a recording, on each axis from the
readings up to i and the motions of the guide.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.lab.calibration.session import Recording
from flexneedle.types import Floats

Predictor = Callable[[Recording, int, int], Floats]
_DEPTH_SCALE_MM = 50.0


class Pair(NamedTuple):
    """A prediction: from step i of a recording to step j, `ahead` mm deeper."""

    recording: int
    i: int
    j: int
    ahead: float


def pairs_ahead(recordings: Sequence[Recording], ahead: float) -> list[Pair]:
    """Return pairs of steps whose distance in depth is about `ahead` (mm): the nearest, within a third of it."""
    found = []
    for n, one in enumerate(recordings):
        for i, depth in enumerate(one.depth[:-1].tolist()):
            j = i + 1 + int(np.argmin(np.abs(one.depth[i + 1 :] - depth - ahead)))
            if abs(one.depth[j] - depth - ahead) <= ahead / 3.0:
                found.append(Pair(n, i, j, ahead))
    return found


def guide_motion(one: Recording, i: int, j: int) -> float:
    """Return the largest distance (mm) of the guide, after step i up to step j, from its position at step i."""
    return float(np.linalg.norm(one.guide[i + 1 : j + 1] - one.guide[i], axis=1).max())


def predictors(training: Sequence[Recording], pairs: Sequence[Pair]) -> dict[str, Predictor]:
    """Return the predictors by name, fitted to pairs of steps of the training recordings."""
    offset = _axis_offset(training)
    found = {"straight": _straight(offset), "stays": _stays, "mean path": _mean_path(training)}
    found["circle"] = _regression(training, pairs, _circle, found["straight"])
    found["circle, no slope"] = _regression(training, pairs, _circle)
    found["regression"] = _regression(training, pairs, _guide_moves)
    return found


def _axis_offset(training: Sequence[Recording]) -> Floats:
    """Return the mean of the sensor's slope less that of the path (axes,), in insertions in which the guide rests."""
    gaps = []
    for one in training:
        rests = (np.abs(np.diff(one.guide, axis=0)) < 0.05).all(axis=1) & (np.diff(one.depth) > 0.5)
        path = np.diff(one.position, axis=0)[rests] / np.diff(one.depth)[rests, None]
        gaps.append(0.5 * (one.slope[1:] + one.slope[:-1])[rests] - path)
    every = np.concatenate(gaps)
    every = every[np.isfinite(every).all(axis=1)]
    return np.median(every, axis=0) if len(every) else np.zeros(training[0].axes)


def _straight(offset: Floats) -> Predictor:
    def predict(one: Recording, i: int, j: int) -> Floats:
        return np.nan_to_num(one.slope[i] - offset) * (one.depth[j] - one.depth[i])

    return predict


def _stays(one: Recording, _i: int, _j: int) -> Floats:
    return np.zeros(one.axes)


def _mean_path(training: Sequence[Recording]) -> Predictor:
    """The mean displacement of the training recordings between the same depths."""

    def at(one: Recording, depth: float) -> Floats:
        return np.array([np.interp(depth, one.depth, column) for column in one.position.T])

    def predict(one: Recording, i: int, j: int) -> Floats:
        moved: Floats = np.mean(
            [at(each, one.depth[j]) - at(each, one.depth[i]) for each in training], axis=0
        )
        return moved

    return predict


_Features = Callable[[Recording, int, int], Floats]


def _circle(one: Recording, i: int, j: int) -> Floats:
    """Return features (axes, 1): curvature times the square of the advance."""
    return np.full((one.axes, 1), (one.depth[j] - one.depth[i]) ** 2)


def _guide_moves(one: Recording, i: int, j: int) -> Floats:
    """Return features (axes, 4): advance, slope times advance, motion of the guide, and that times the depth."""
    length, moved = one.depth[j] - one.depth[i], one.guide[j] - one.guide[i]
    slope = np.nan_to_num(one.slope[i]) * length
    return np.stack([np.full(one.axes, length), slope, moved, moved * one.depth[i] / _DEPTH_SCALE_MM], axis=1)


def _regression(
    training: Sequence[Recording], pairs: Sequence[Pair], features: _Features, known: Predictor = _stays
) -> Predictor:
    """Return a predictor that adds to a known one what is linear in features (axes, f), on each axis by itself."""
    rows = [features(training[each.recording], each.i, each.j) for each in pairs]
    moved = [
        training[each.recording].position[each.j]
        - training[each.recording].position[each.i]
        - known(training[each.recording], each.i, each.j)
        for each in pairs
    ]
    axes = training[0].axes
    weights = [
        np.linalg.lstsq(np.array(rows)[:, axis], np.array(moved)[:, axis], rcond=None)[0] for axis in range(axes)
    ] if rows else [np.zeros(1)] * axes  # fmt: skip

    def predict(one: Recording, i: int, j: int) -> Floats:
        given = features(one, i, j)
        change: Floats = np.array([given[axis] @ weights[axis] for axis in range(axes)])
        return known(one, i, j) + change

    return predict
