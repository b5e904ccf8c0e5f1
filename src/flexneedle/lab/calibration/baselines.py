"""Simple predictors of a path, fitted to the same recordings as the model: a calibration has to beat them.

Each predicts displacements (p, axes) of the tip from steps i (p,) to steps j (p,) of a recording, on each axis from the
readings up to i and, in the regression, the motions of the guide.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.calibration.criteria import steps_ahead
from flexneedle.lab.calibration.session import Recording
from flexneedle.types import Floats

Indices = NDArray[np.intp]
Predictor = Callable[[Recording, Indices, Indices], Floats]
Pairs = tuple[Indices, Indices]
"""Steps i and j of predictions of a recording."""
REGRESSION = "regression"
"""Name of the predictor that knows the motion of the guide after step i."""
_STILL_MM = 0.05
_DEPTH_SCALE_MM = 50.0
_LEAST_ADVANCE_MM = 0.5


def pairs_ahead(one: Recording, ahead: float) -> Pairs:
    """Return pairs of steps whose distance in depth is about `ahead` (mm)."""
    i, j = np.array(steps_ahead(one.depth, ahead), dtype=np.intp).reshape(-1, 2).T
    return i, j


def whole(one: Recording) -> Pairs:
    """Return the pair of the first and the last step."""
    return np.array([0]), np.array([len(one.depth) - 1])


def predictors(training: Sequence[Recording], pairs: Sequence[Pairs]) -> dict[str, Predictor]:
    """Return the predictors by name, fitted to pairs of steps of each training recording."""
    straight = _straight(axis_offset(training))
    return {
        "straight": straight,
        "stays": _stay,
        "circle": _fit(training, pairs, _square, straight),
        "circle, no slope": _fit(training, pairs, _square, _stay),
        "mean path": _mean_path(training),
        REGRESSION: _fit(training, pairs, _guide_moves, _stay),
    }


def axis_offset(training: Sequence[Recording]) -> Floats:
    """Return the median of the sensor's slope less the path's (axes,), in insertions in which the guide rests."""
    gaps = []
    for one in training:
        advance = np.diff(one.depth)
        still = (np.abs(np.diff(one.guide, axis=0)) < _STILL_MM).all(axis=1) & (advance > _LEAST_ADVANCE_MM)
        path = np.diff(one.position, axis=0)[still] / advance[still, None]
        gaps.append(0.5 * (one.slope[1:] + one.slope[:-1])[still] - path)
    every = np.concatenate(gaps)
    every = every[np.isfinite(every).all(axis=1)]
    return np.median(every, axis=0) if len(every) else np.zeros(training[0].axes)


def heading(one: Recording, offset: Floats) -> Floats:
    """Return the slope (k, axes) of the path: of the measured axis, else from the step before, else 0."""
    advance = np.diff(one.depth)
    path = np.zeros_like(one.position)
    forward = advance > _LEAST_ADVANCE_MM
    path[1:][forward] = np.diff(one.position, axis=0)[forward] / advance[forward, None]
    return np.nan_to_num(np.where(np.isfinite(one.slope), one.slope - offset, path))


def _straight(offset: Floats) -> Predictor:
    def predict(one: Recording, i: Indices, j: Indices) -> Floats:
        moved: Floats = heading(one, offset)[i] * (one.depth[j] - one.depth[i])[:, None]
        return moved

    return predict


def _stay(one: Recording, i: Indices, _j: Indices) -> Floats:
    return np.zeros((len(i), one.axes))


def _mean_path(training: Sequence[Recording]) -> Predictor:
    """Return the mean displacement of the training recordings between the same depths, of those that reach them."""

    def predict(one: Recording, i: Indices, j: Indices) -> Floats:
        moved = np.array([_at(each, one.depth[j]) - _at(each, one.depth[i]) for each in training])
        known = np.isfinite(moved)
        total = np.where(known, moved, 0.0).sum(axis=0)
        mean: Floats = total / np.maximum(known.sum(axis=0), 1)
        return mean

    return predict


def _at(one: Recording, depth: Floats) -> Floats:
    """Return the position (p, axes) at depths, NaN beyond the last; before the first step, the first position."""
    reached = np.maximum.accumulate(one.depth)
    limit = reached[-1] + 0.5 * np.median(np.diff(reached)) if len(reached) > 1 else -np.inf
    at = np.stack([np.interp(depth, reached, column) for column in one.position.T], axis=1)
    return np.where((depth <= limit)[:, None], at, np.nan)


Features = Callable[[Recording, Indices, Indices], Floats]
"""Features (p, axes, f) of pairs of steps."""


def _square(one: Recording, i: Indices, j: Indices) -> Floats:
    """Return the square of the advance, whose coefficient is half of the curvature."""
    return np.tile((one.depth[j] - one.depth[i])[:, None, None] ** 2, (1, one.axes, 1))


def _guide_moves(one: Recording, i: Indices, j: Indices) -> Floats:
    """Return advance, slope times advance, motion of the guide, and the motion times the depth."""
    length, moved = (one.depth[j] - one.depth[i])[:, None], one.guide[j] - one.guide[i]
    slope = heading(one, np.zeros(one.axes))[i] * length
    depth = one.depth[i][:, None] / _DEPTH_SCALE_MM
    return np.stack([length + 0.0 * moved, slope, moved, moved * depth], axis=2)


def _fit(
    training: Sequence[Recording], pairs: Sequence[Pairs], features: Features, known: Predictor
) -> Predictor:
    """Return a predictor that adds to a known one a linear function of features, on each axis by itself.

    With fewer pairs than coefficients it adds nothing.
    """
    rows = np.concatenate([features(one, *pair) for one, pair in zip(training, pairs, strict=True)])
    left = np.concatenate(
        [
            one.position[pair[1]] - one.position[pair[0]] - known(one, *pair)
            for one, pair in zip(training, pairs, strict=True)
        ]
    )
    if len(rows) < rows.shape[2]:
        return known
    weights = np.stack(
        [np.linalg.lstsq(rows[:, axis], left[:, axis], rcond=None)[0] for axis in range(left.shape[1])]
    )

    def predict(one: Recording, i: Indices, j: Indices) -> Floats:
        change: Floats = np.einsum("paf,af->pa", features(one, i, j), weights)
        return known(one, i, j) + change

    return predict
