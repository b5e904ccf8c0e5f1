"""Shapes of the true needle over time, for sensors along it."""

import cmath
import math
from bisect import bisect_right

from flexneedle.types import THETA, Floats, Y

ARC = 8
"""Parts of the needle's path in a roll."""
_NO_ROLL = 1e-9


class ShapeHistory:
    """Poses along the needle and its roll, linear between the times of the added ones.

    most: number of shapes that are kept (default: all).
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._kept: list[tuple[float, float, Floats]] = []  # time, roll and poses

    def add(self, time: float, roll: float, poses: Floats) -> None:
        """Add the poses (n, 5) and the roll (rad, up to whole turns) at a time (s), later than the ones before."""
        before = self._kept[-1][1] if self._kept else roll
        self._kept.append((time, before + math.remainder(roll - before, 2.0 * math.pi), poses))
        if self._most is not None:
            del self._kept[: -self._most]

    def add_turn(self, begun: float, ended: float, angle: float, poses: Floats, *, flat: bool) -> None:
        """Add the poses (n, 5) after a turn by `angle` (rad) between two times (s), and on the arcs before.

        flat: whether the needle stays in the plane.
        """
        _, roll, before = self._kept[-1]
        self.add(begun, roll, before)
        for k in range(1, ARC + 1):
            part = k / ARC
            share = of_arc(angle, part)
            made = before + part * (poses - before)
            for axis in (Y, THETA):
                first, last = (one[:, axis] + 1j * one[:, axis + 1] for one in (before, poses))
                lateral = first + (share.real if flat else share) * (last - first)
                made[:, axis], made[:, axis + 1] = lateral.real, lateral.imag
            self.add(begun + part * (ended - begun), roll + part * angle, made)

    def at(self, time: float) -> tuple[Floats, float]:
        """Return the poses (n, 5) and the roll (rad) at a time (s): before the first and after the last, theirs."""
        k = bisect_right(self._kept, time, key=lambda one: one[0])
        if k in (0, len(self._kept)):
            _, roll, poses = self._kept[min(k, len(self._kept) - 1)]
            return poses, roll
        (t0, roll, poses), (t1, later, after) = self._kept[k - 1 : k + 1]
        part = (time - t0) / (t1 - t0) if t1 > t0 else 1.0
        return poses + part * (after - poses), roll + part * (later - roll)


def of_arc(roll: float, part: float) -> complex:
    """Return the share of the chord, as a lateral quantity, at a part of an arc by `roll` (rad)."""
    whole = cmath.exp(1j * roll) - 1.0
    return (cmath.exp(1j * roll * part) - 1.0) / whole if abs(whole) > _NO_ROLL else complex(part)
