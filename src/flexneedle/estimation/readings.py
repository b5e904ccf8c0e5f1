"""The readings of an insertion, a mean for each move, compared with a model's tip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.estimate import Move
from flexneedle.types import Floats


@dataclass(frozen=True, eq=False)
class MoveMeans:
    """Means of the readings of each move that has any: the move, the share of it done, x, y (mm), their number, and
    the bevel's side, which changes before its move; each (r,).

    Quantities of a model are given at the ends of all m moves, the start first: (m + 1,).
    """

    index: NDArray[np.intp]
    part: Floats
    x: Floats
    y: Floats
    count: Floats
    sides: Floats

    @staticmethod
    def of(moves: Sequence[Move], bevel: float) -> "MoveMeans":
        """The means of moves with at least one reading among them; bevel: its side after the last move."""
        means = [(k, *done.mean) for k, done in enumerate(moves) if done.mean is not None]
        index, part, x, y, count = np.array(means, dtype=float).T
        sides = np.cumprod([-1.0 if done.applied[4] > 0.0 else 1.0 for done in moves])
        kept = index.astype(int)
        return MoveMeans(kept, part, x, y, count, (bevel * sides[-1] * sides)[kept])

    def between(self, ends: Floats) -> Floats:
        """A quantity interpolated to the readings (r,)."""
        between: Floats = (1.0 - self.part) * ends[self.index] + self.part * ends[self.index + 1]
        return between

    def left(self, y: Floats, run_out: float) -> Floats:
        """Lateral residuals (r,), mm: readings minus those of a model."""
        left: Floats = self.y - self.between(y) - run_out * self.sides
        return left

    def ahead(self, x: Floats) -> Floats:
        """Axial residuals (r,), mm: readings minus those of a model."""
        ahead: Floats = self.x - self.between(x)
        return ahead

    def variance(self, jitter: float, unexplained: float) -> Floats:
        """Variances (r,) of the means, mm²; jitter of a reading and model error of a mean: standard deviations, mm."""
        variance: Floats = jitter**2 / self.count + unexplained**2
        return variance

    def bent(self, y: Floats) -> Floats:
        """Possible deviation (r,) of a reading from the chord of its move, mm: the tip's path bends below the skin."""
        change = np.abs(np.diff(y, n=2, prepend=y[0], append=y[-1]))
        sag: Floats = 0.25 * np.maximum(change[self.index], change[self.index + 1])
        return sag


def shared(ahead: Floats, variance: Floats, prior_sd: float) -> tuple[float, float]:
    """A constant that all readings share (mm) and its variance, maximum a posteriori.

    ahead (r,): readings minus those predicted without it, mm, of `variance` (r,); prior: mean 0, sd (mm).
    """
    weight = 1.0 / variance
    left = 1.0 / (weight.sum() + prior_sd**-2.0)
    return float(left * (weight @ ahead)), float(left)
