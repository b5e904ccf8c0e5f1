"""Shapes of the true needle over time, for sensors along it."""

import math
from bisect import bisect_right

from flexneedle.types import Floats


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

    def at(self, time: float) -> tuple[Floats, float]:
        """Return the poses (n, 5) and the roll (rad) at a time (s): before the first and after the last, theirs."""
        k = bisect_right(self._kept, time, key=lambda one: one[0])
        if k in (0, len(self._kept)):
            _, roll, poses = self._kept[min(k, len(self._kept) - 1)]
            return poses, roll
        (t0, roll, poses), (t1, later, after) = self._kept[k - 1 : k + 1]
        part = (time - t0) / (t1 - t0) if t1 > t0 else 1.0
        return poses + part * (after - poses), roll + part * (later - roll)
