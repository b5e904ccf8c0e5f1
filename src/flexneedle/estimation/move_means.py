"""Means of the readings of each move, compared with a model's tip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.moves import Move
from flexneedle.types import Floats, Laterals


@dataclass(frozen=True, eq=False)
class MoveMeans:
    """Means of a sensor's readings, for each of r moves that has any; (r,) each.

    Lateral quantities are complex in space. Quantities of a model are given at the ends of all m moves, the start
    first: (m + 1,).
    """

    index: NDArray[np.intp]  # index of the move
    part: Floats  # share of the move that is done
    x: Floats  # x of the tip (mm)
    y: Laterals  # measured quantity
    count: Floats
    reported: Floats  # reported variance of y on an axis (NaN: not reported)
    reported_x: Floats  # reported variance of x (NaN: not reported)
    bevel: Laterals  # mean of the bevel's direction
    turns: NDArray[np.bool_]  # whether the move is a roll

    @staticmethod
    def of(moves: Sequence[Move], sensor: str, bevel: complex, axes: int) -> "MoveMeans":
        """Return the means of a sensor's readings; bevel: its direction after the last move."""
        found = {k: done.means[sensor] for k, done in enumerate(moves) if sensor in done.means}
        kept = np.array([*found], dtype=int)
        part, x, y, z, facing_y, facing_z, count, reported, ahead = (
            np.array([*found.values()]).reshape(-1, 9).T
        )
        commands = [done.motion.control for done in moves]
        turned = np.cumsum([command.roll + command.spin for command in commands])
        after = bevel * np.exp(1j * (turned - turned[-1]))[kept]
        turns = np.array([moves[k].is_roll for k in kept], dtype=bool)
        if axes == 1:
            facing = np.rint(after.real) * facing_y
            return MoveMeans(kept, part, x, y, count, reported, ahead, facing, turns)
        facing = after * (facing_y + 1j * facing_z)
        return MoveMeans(kept, part, x, y + 1j * z, count, reported, ahead, facing, turns)

    def between(self, ends: Laterals) -> Laterals:
        """Return a quantity interpolated to the readings (r,)."""
        between: Laterals = (1.0 - self.part) * ends[self.index] + self.part * ends[self.index + 1]
        return between

    def compute_residuals(self, y: Laterals, offset: complex) -> Laterals:
        """Return lateral residuals (r,): readings minus a model's, with an offset that turns with the bevel."""
        residuals: Laterals = self.y - self.between(y) - offset * self.bevel
        return residuals

    def ahead(self, x: Floats) -> Floats:
        """Return axial residuals (r,), mm: readings minus a model's x."""
        ahead: Floats = self.x - self.between(x)
        return ahead

    def variance(self, jitter: float, unexplained: float) -> Floats:
        """Return the variances (r,) of the means of y on an axis.

        jitter, unexplained: standard deviations of a reading and of the model error of a mean.
        """
        return self._variance(self.reported, jitter, unexplained)

    def axial_variance(self, jitter: float, unexplained: float) -> Floats:
        """Return the variances (r,) of the means of x, with arguments as for `variance`."""
        return self._variance(self.reported_x, jitter, unexplained)

    def _variance(self, reported: Floats, jitter: float, unexplained: float) -> Floats:
        noise = np.where(np.isnan(reported), jitter**2 / self.count, reported)
        variance: Floats = noise + unexplained**2
        return variance

    def estimate_sag(self, y: Laterals) -> Floats:
        """Return the possible deviation (r,) of a reading from the chord of its move: in tissue the path bends."""
        change = np.abs(np.diff(y, n=2, prepend=y[0], append=y[-1]))
        sag: Floats = 0.25 * np.maximum(change[self.index], change[self.index + 1])
        return sag
