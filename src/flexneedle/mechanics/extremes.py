"""Extremes of sequences of controls, in one pass over them."""

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import kernel
from flexneedle.types import ROLL

SIZE, LEAST, MOST, ANGLE = range(4)
"""Rows of extremes."""


@kernel
def find_extremes(rows: NDArray[np.float64], roll: float, found: NDArray[np.float64]) -> None:
    """Write the extremes of controls (N, m, 9) to `found` (4, 9).

    Its rows: largest size of each column, infinite for NaN; least and greatest sum of the steps up to any step; largest
    size of the needle's angle, `roll` before the first step, and largest part of a roll beyond half turns, in them.
    """
    sums = np.empty(found.shape[1])
    for k in range(rows.shape[0]):
        sums[:], angle = 0.0, roll
        for i in range(rows.shape[1]):
            for c in range(rows.shape[2]):
                value = rows[k, i, c]
                if value == 0.0:  # most are
                    continue
                size = abs(value)
                if not size <= found[SIZE, c]:
                    found[SIZE, c] = size if size < np.inf else np.inf
                sums[c] += value
                found[LEAST, c] = min(found[LEAST, c], sums[c])
                found[MOST, c] = max(found[MOST, c], sums[c])
                if c >= ROLL:
                    angle += value
                    found[ANGLE, 0] = max(found[ANGLE, 0], abs(angle))
                if c == ROLL:
                    halves = value / np.pi
                    found[ANGLE, 1] = max(found[ANGLE, 1], abs(halves - np.rint(halves)))
