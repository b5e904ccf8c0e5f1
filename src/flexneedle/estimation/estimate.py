"""Interface of all observers: the estimated needle, corrected by delayed readings."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Protocol

import numpy as np

from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import Command, Floats, Measurement


@dataclass(frozen=True)
class Move:
    """A motion from `begun` to `ended` (s) as applied by the driver, and the good readings taken during it."""

    begun: float
    ended: float
    applied: Command
    measurements: tuple[Measurement, ...] = ()

    @cached_property
    def mean(self) -> tuple[float, float, float, float] | None:
        """Means over its readings: share of the move done, x, y (mm); and their number. None without any."""
        if not self.measurements:
            return None
        part = [self.part(one.time) for one in self.measurements]
        x, y = zip(*map(place, self.measurements), strict=True)
        return fmean(part), fmean(x), fmean(y), float(len(part))

    def part(self, time: float) -> float:
        """Share of the move that is done at `time`."""
        if self.ended <= self.begun:
            return 1.0
        return min(1.0, max(0.0, (time - self.begun) / (self.ended - self.begun)))


class Estimate(Protocol):
    """A frozen estimate of the present state of the insertion."""

    @property
    def simulator(self) -> Simulator:
        """The model of the prediction, with the estimated constants."""
        ...

    @property
    def state(self) -> State:
        """Present state of that model."""
        ...

    @property
    def tip(self) -> Floats:
        """Present pose (3,) of the tip, as a tracker without errors would measure it."""
        ...

    @property
    def innovation(self) -> tuple[float, float]:
        """The last reading minus its prediction (mm)."""
        ...

    @property
    def measured(self) -> tuple[float, float] | None:
        """Tip (x, y) measured at the end of the last move with a reading (mm), None before the first."""
        ...

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip."""
        ...

    def tip_at(self, time: float) -> tuple[float, float]:
        """Estimated position of the tip (mm) at `time`, with constant velocity in each move."""
        ...

    def move(self, applied: Command, begun: float, ended: float) -> "Estimate":
        """The estimate after a motion `applied` by the driver from `begun` to `ended` (s)."""
        ...

    def observe(self, measurements: Sequence[Measurement]) -> "Estimate":
        """The estimate corrected by good readings, the newest last."""
        ...

    def without_reading(self) -> "Estimate":
        """The estimate of a period without a good reading: innovation 0."""
        ...


def described(estimate: Estimate) -> str:
    """Return one line about an estimate, for its `repr`."""
    x, y, slope = estimate.tip
    where = f"tip ({x:.3f}, {y:.3f}) mm ± {estimate.tip_sd:.3f} mm, slope {1e3 * slope:.2f} mrad"
    return f"<{type(estimate).__name__} {where}>"


def assigned(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> tuple[Move, ...]:
    """Assign each measurement to the move in which it was taken, earlier ones to the first, later ones to the last."""
    ends = np.array([done.ended for done in moves[:-1]])
    owner = np.searchsorted(ends, [one.time - 1e-9 for one in measurements])
    return tuple(
        done
        if not (new := tuple(one for one, k in zip(measurements, owner, strict=True) if k == j))
        else Move(done.begun, done.ended, done.applied, done.measurements + new)
        for j, done in enumerate(moves)
    )


def along(moves: tuple[Move, ...], tips: Floats, time: float) -> tuple[float, float]:
    """Position (mm) at `time` on the path through tips (k + 1, 3), before and after each of k moves."""
    if not moves:
        return float(tips[-1, 0]), float(tips[-1, 1])
    times = [moves[0].begun, *(done.ended for done in moves)]
    return float(np.interp(time, times, tips[:, 0])), float(np.interp(time, times, tips[:, 1]))


def place(measurement: Measurement) -> tuple[float, float]:
    """Measured tip (mm) of a good measurement. Raises ValueError for an empty one."""
    if measurement.x is None or measurement.y is None:
        raise ValueError("an empty measurement was not removed")
    return measurement.x, measurement.y
