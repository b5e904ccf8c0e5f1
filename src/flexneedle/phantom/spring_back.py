"""Spring-back of the needle's base along its axis, where the advance stops in tissue (docs/theory.md section 11)."""

from collections.abc import Iterator

import numpy as np

from flexneedle.types import DB_X, STILL, Floats

_SHARE_OF_DEPTH = 0.1


class SpringBack:
    """Play between driver and base: while the needle advances, the base follows the driver; else it is `most` mm short.

    The play is a tenth of the depth at most, since the force that pushes back grows with the inserted length.
    """

    def __init__(self, most: float) -> None:
        self._most, self._play, self._advancing = most, 0.0, False

    def steps(self, row: Floats, depth: float) -> Iterator[Floats]:
        """Yield the steps of the base for a step of the driver (columns of `Control`), with the tip at a depth (mm)."""
        advances = bool(row[DB_X] > 0.0)
        if advances and self._play > 0.0:
            yield _along_axis(self._play)
            self._play = 0.0
        elif self._advancing and not advances:
            self._play = min(self._most, _SHARE_OF_DEPTH * max(0.0, depth))
            if self._play > 0.0:
                yield _along_axis(-self._play)
        self._advancing = advances
        yield row


def _along_axis(length: float) -> Floats:
    row = np.array(STILL)
    row[DB_X] = length
    return row
