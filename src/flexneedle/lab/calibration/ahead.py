"""Predictions ahead as linear functions of the residuals of a path: what a fit minimizes (docs/theory.md, 13).

A model that lacks something is best identified by the errors of the predictions that it is used for, over the horizon of
a controller (Shook, Mohtadi and Shah 1991, doi:10.1049/ip-d.1991.0010), not by those of one step.
"""

from typing import NamedTuple

import numpy as np

from flexneedle.lab.calibration.deviations import GAIN_KINDS, Noise, Whitened
from flexneedle.types import Floats

HORIZONS = (0.1, 0.2, 0.4, 0.8)
"""Horizons of predictions, as shares of the depth that is reached."""
_NEAR = 1.0 / 3.0  # largest difference of a prediction's length from its horizon, relative to it


class Rows(NamedTuple):
    """Predictions of a path: rows (a, r), whose products with residuals (r,) are errors (mm); horizon (a,) of each."""

    rows: Floats
    horizon: Floats


def steps_ahead(depth: Floats, length: float) -> list[tuple[int, int]]:
    """Return pairs of steps i < j whose distance in depth is nearest to `length` (mm), and within a third of it."""
    pairs = []
    for i in range(len(depth) - 1):
        j = i + 1 + int(np.argmin(np.abs(depth[i + 1 :] - depth[i] - length)))
        if abs(depth[j] - depth[i] - length) <= _NEAR * length:
            pairs.append((i, j))
    return pairs


def predict_ahead(path: Whitened, noise: Noise, reached: float) -> Rows:
    """Return the predictions of a path's positions from all readings up to a step, over each of the horizons.

    The errors that an insertion has as a whole are not estimated from its first steps: the parameters have to give them.
    """
    covariance = path.covariance(noise.without(GAIN_KINDS))
    count = len(path.deviations.depth)
    steps = np.tile(np.arange(count), 2)[path.known]
    place = np.full(2 * count, -1)
    place[path.known] = np.arange(len(steps))
    rows, horizons = [], []
    for k, share in enumerate(HORIZONS):
        for i, j in steps_ahead(path.deviations.depth, share * reached):
            before, at = np.flatnonzero(steps <= i), place[j]
            if at >= 0 and len(before):
                row = np.zeros(len(steps))
                row[at] = 1.0
                row[before] = -np.linalg.solve(covariance[np.ix_(before, before)], covariance[before, at])
                rows.append(row)
                horizons.append(k)
    return Rows(np.array(rows).reshape(-1, len(steps)), np.array(horizons, dtype=int))
