"""Criteria of a fit: the likelihood of the readings, or the errors of predictions ahead (docs/theory.md, 13).

The likelihood uses all readings best if the model lacks nothing. A model that lacks something is better identified by
the errors of the predictions that it is used for, over the horizon of a controller (Shook, Mohtadi and Shah 1991,
doi:10.1049/ip-d.1991.0010). A calibration takes the likelihood if errors of readings are most of what is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from scipy.linalg import solve_triangular

from flexneedle.lab.calibration.deviations import GAIN_KINDS, Noise, Whitened
from flexneedle.types import Floats

HORIZONS = (0.1, 0.2, 0.4, 1.0)
"""Horizons of predictions, as shares of the depth that is reached."""
_NEAR = 1.0 / 3.0  # largest difference of a prediction's length from its horizon, relative to it
_LEAST_SD = 0.01  # mm; of the errors of predictions


class Criterion(Protocol):
    """A loss of residuals, (r,) for each path on an axis, by errors (m,) that are linear in them."""

    @classmethod
    def of(cls, paths: Sequence[Whitened], noise: Noise, residuals: Sequence[Floats]) -> Self:
        """Return the criterion for a noise, scaled by the errors at some residuals."""
        ...

    @property
    def rows(self) -> Sequence[Floats]:
        """Matrices (a, r) for each path: errors by residuals, scaled and weighted."""
        ...

    @property
    def constant(self) -> float:
        """Part of the loss by the scales of the errors."""
        ...

    def rho(self, squares: Floats) -> Floats:
        """Return the loss, and its first and second derivatives (3, m), by squared errors (m,)."""
        ...


@dataclass(frozen=True, eq=False)
class Likelihood:
    """−2 ln of the likelihood of all readings."""

    rows: list[Floats]
    constant: float

    @classmethod
    def of(cls, paths: Sequence[Whitened], noise: Noise, residuals: Sequence[Floats]) -> Self:
        """Return the criterion for a noise."""
        del residuals
        roots = [np.linalg.cholesky(path.covariance(noise)) for path in paths]
        rows = [solve_triangular(root, np.eye(len(root)), lower=True, check_finite=False) for root in roots]
        return cls(rows, 2.0 * sum(float(np.log(np.diag(root)).sum()) for root in roots))

    def rho(self, squares: Floats) -> Floats:
        """Return squares; heavy tails are in the covariance."""
        return np.stack([squares, np.ones_like(squares), np.zeros_like(squares)])


@dataclass(frozen=True, eq=False)
class PredictionErrors:
    """Pseudo-Huber loss of the errors of predictions ahead, relative to their root mean square in each class.

    Classes are horizons, with and without motions of guide, base or roll.
    Errors of overlapping predictions are not independent: each has the weight of the advance that is its alone.
    """

    rows: list[Floats]
    weight: float
    constant: float

    @classmethod
    def of(cls, paths: Sequence[Whitened], noise: Noise, residuals: Sequence[Floats]) -> Self:
        """Return the criterion for a noise, scaled by the errors at some residuals."""
        depths = [path.deviations.depth for path in paths]
        reached = max(float(np.ptp(depth)) for depth in depths)
        spacing = float(np.mean(np.concatenate([np.diff(depth) for depth in depths])))
        overlap = float(np.exp(np.mean(np.log(HORIZONS)))) * reached / spacing
        weight = 1.0 / (len(HORIZONS) * max(overlap, 1.0))
        predictions = [predict_ahead(path, noise, reached) for path in paths]
        sd = np.maximum(root_mean_squares(predictions, residuals), _LEAST_SD)
        rows = [np.sqrt(weight) * each / sd[kind, None] for each, kind in predictions]
        logs = sum(float(np.log(sd[kind]).sum()) for _, kind in predictions)
        return cls(rows, weight, 2.0 * weight * logs)

    def rho(self, squares: Floats) -> Floats:
        """Return the pseudo-Huber loss."""
        z = 1.0 + squares / self.weight
        return np.stack([2.0 * self.weight * (np.sqrt(z) - 1.0), z**-0.5, -0.5 / self.weight * z**-1.5])


def root_mean_squares(predictions: Sequence[tuple[Floats, Floats]], residuals: Sequence[Floats]) -> Floats:
    """Return root mean squares (2 h,) of the errors (mm) in each class, 0 where there are none."""
    errors = np.concatenate([rows @ left for (rows, _), left in zip(predictions, residuals, strict=True)])
    kinds = np.concatenate([each for _, each in predictions])
    counts = np.bincount(kinds, minlength=2 * len(HORIZONS))
    found: Floats = np.sqrt(np.bincount(kinds, errors**2, 2 * len(HORIZONS)) / np.maximum(counts, 1))
    return found


def predict_ahead(path: Whitened, noise: Noise, reached: float) -> tuple[Floats, Floats]:
    """Return predictions of positions from all readings up to a step: rows (a, r) of their errors, classes (a,).

    Errors that an insertion has as a whole are not estimated from its first steps: the parameters have to give them.
    """
    covariance = path.covariance(noise.without(GAIN_KINDS))
    depth, moved = path.deviations.depth, path.deviations.moved
    count = len(depth)
    steps = np.tile(np.arange(count), 2)[path.known]
    place = np.full(2 * count, -1)
    place[path.known] = np.arange(len(steps))
    rows, kinds = list[Floats](), list[int]()
    for k, share in enumerate(HORIZONS):
        for i, j in steps_ahead(depth, share * reached):
            before, at = np.flatnonzero(steps <= i), place[j]
            if at >= 0 and len(before):
                row = np.zeros(len(steps))
                row[at] = 1.0
                row[before] = -np.linalg.solve(covariance[np.ix_(before, before)], covariance[before, at])
                rows.append(row)
                kinds.append(k + len(HORIZONS) * bool(moved[i + 1 : j + 1].any()))
    return np.array(rows).reshape(-1, len(steps)), np.array(kinds, dtype=int)


def steps_ahead(depth: Floats, length: float) -> list[tuple[int, int]]:
    """Return pairs of steps i < j whose distance in depth is nearest to `length` (mm), and within a third of it."""
    pairs = []
    for i in range(len(depth) - 1):
        j = i + 1 + int(np.argmin(np.abs(depth[i + 1 :] - depth[i] - length)))
        if abs(depth[j] - depth[i] - length) <= _NEAR * length:
            pairs.append((i, j))
    return pairs
