"""Check of many sequences of controls by their extremes, in one pass over them."""

import numpy as np

from flexneedle.mechanics.compile import kernel
from flexneedle.simulator.control import MOVES, SLACK, Limits
from flexneedle.types import COLUMNS, ROLL, SPIN, Floats

_SIZE, _LEAST, _MOST, _ANGLE = range(4)


def are_within(limits: Limits, moved: Floats, rows: Floats, roll: float) -> bool:
    """Return whether controls (N, m, 9) break no limit, for certain; arguments as for `Limits.check`.

    False leaves it open: `Limits.check` decides.
    """
    found = np.zeros((4, len(COLUMNS)))
    _find_extremes(rows, roll, found)
    sizes, least, most, (angle, uneven, *_) = found
    used = sizes[:MOVES] > 0.0
    low, high = limits.travel.T - moved
    moves = (
        np.isfinite(sizes).all()
        and (sizes[:MOVES] <= limits.step).all()
        and not (used & [bool(reason) for reason in limits.fixed]).any()
        and ((low <= least[:MOVES]) & (most[:MOVES] <= high))[used].all()
    )
    if limits.half_turns:
        return bool(moves and uneven <= SLACK and sizes[SPIN] == 0.0)
    return bool(moves and angle <= limits.rotation)


@kernel
def _find_extremes(rows: Floats, roll: float, found: Floats) -> None:
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
                if not size <= found[_SIZE, c]:
                    found[_SIZE, c] = size if size < np.inf else np.inf
                sums[c] += value
                found[_LEAST, c] = min(found[_LEAST, c], sums[c])
                found[_MOST, c] = max(found[_MOST, c], sums[c])
                if c >= ROLL:
                    angle += value
                    found[_ANGLE, 0] = max(found[_ANGLE, 0], abs(angle))
                if c == ROLL:
                    halves = value / np.pi
                    found[_ANGLE, 1] = max(found[_ANGLE, 1], abs(halves - np.rint(halves)))
