"""Tip and needle that follow the records of the true needle: sources of an emulated tracker and fibre."""

from collections import deque
from collections.abc import Callable, Iterable
from math import floor
from time import monotonic

import numpy as np

from flexneedle.geometry.quaternion import along
from flexneedle.lab.emulators.emulated_rig.stream import Record
from flexneedle.lab.emulators.motion import RATE_HZ
from flexneedle.phantom.phantom import to_poses
from flexneedle.phantom.shapes import ShapeHistory
from flexneedle.types import Floats, Point, Quaternion

_LONGEST = 4000  # records: 16 s of motion
_MOST_SHAPES = 1000


class TipHistory:
    """Pose of the tip's sensor between records, linear in time. Frame n is taken n periods after `power_on` (s).

    The roll, which one coil does not measure, is the roll of the shortest rotation from the z axis to the needle's
    direction. The numbers of a record are position x, y, z (mm) and direction of the needle, in the tracker's frame.
    A frame exists once a record of its time or later has arrived, without extrapolation: a few milliseconds after it
    was taken, or later on a busy computer. A needle at rest may move by a record that is still to come.
    """

    def __init__(self, power_on: float, first: Record) -> None:
        self._power_on = power_on
        self._records = deque([first], maxlen=_LONGEST)
        self._last: tuple[int, tuple[Point, Quaternion]] | None = None

    def add(self, records: Iterable[Record]) -> None:
        """Add records, oldest first."""
        self._records.extend(records)

    def newest(self, number: int) -> int:
        """Return the number of the newest frame, up to this one, in which the pose is known; it never decreases."""
        return min(number, floor((self._records[-1].time - self._power_on) * RATE_HZ))

    def at(self, number: int) -> tuple[Point, Quaternion]:
        """Return position (mm) and orientation in a frame up to the newest, of the last 16 s of motion."""
        if self._last is None or self._last[0] != number:
            self._last = number, self._between(self._power_on + number / RATE_HZ)
        return self._last[1]

    def _between(self, time: float) -> tuple[Point, Quaternion]:
        after = self._records[-1]
        for before in reversed(self._records):
            if before.time <= time:
                break
            after = before
        span = after.time - before.time
        part = min(1.0, max(0.0, time - before.time) / span) if span > 0.0 else 0.0
        values = np.array(before.values) + part * np.subtract(after.values, before.values)
        x, y, z = values[:3].tolist()
        w, i, j, k = along(values[3:] / np.linalg.norm(values[3:])).tolist()
        return (x, y, z), (w, i, j, k)


class NeedleHistory:
    """The true needle for a `VirtualSensor`, in s after `power_on`. A record has the values of `DrivenNeedle.shape`.

    After the newest record the needle counts as at rest: with a `delay_s` of a few milliseconds or more all is known.
    Shapes of the last 4 s of motion are kept.

    Attributes:
        late: Time (s) by which its clock is slow, so that readings arrive later.
    """

    def __init__(self, power_on: float, first: Record, clock: Callable[[], float] = monotonic) -> None:
        self._power_on, self._clock, self._shapes = power_on, clock, ShapeHistory(_MOST_SHAPES)
        self.late = 0.0
        self.add([first])

    def add(self, records: Iterable[Record]) -> None:
        """Add records, oldest first."""
        for time, (roll, *nodes), _ in records:
            self._shapes.add(time - self._power_on, roll, to_poses(np.reshape(nodes, (-1, 3))))

    def now(self) -> float:
        """Return the time (s)."""
        return self._clock() - self._power_on - self.late

    def tip_at(self, time: float) -> Point:
        """Return the end of the needle's axis x, y, z (mm) at a time."""
        x, y, z = self.shape_at(time)[0][-1, :3].tolist()
        return x, y, z

    def shape_at(self, time: float) -> tuple[Floats, float]:
        """Return the poses (n, 5) along the needle, and its roll (rad) at a time."""
        return self._shapes.at(time)
