"""Interface of all observers: the estimated needle, corrected by delayed readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import nan
from statistics import fmean
from typing import Protocol

import numpy as np

from flexneedle.estimation.sensor import Sensor
from flexneedle.estimation.sensors import SENSORS
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import THETA, Control, Floats, Measurement, Motion, Point, Pose, X, Y, Z


@dataclass(frozen=True)
class Move:
    """A motion from `begun` to `ended` (s) as applied by the driver, and the good readings taken during it."""

    begun: float
    ended: float
    applied: Control
    measurements: tuple[Measurement, ...] = ()

    @cached_property
    def means(self) -> Mapping[str, tuple[float, ...]]:
        """Means over its readings by sensor: share of the move done, x (mm), y and z of the measured quantity, their
        number, and the variances of the means of y or z and of x where all readings report them, else NaN. Sensors
        without readings are left out.
        """
        means = ((sensor.name, self._mean(sensor)) for sensor in SENSORS.values())
        return {name: mean for name, mean in means if mean is not None}

    def _mean(self, sensor: Sensor) -> tuple[float, ...] | None:
        read = [(one, sensor.read(one)) for one in self.measurements]
        known = [(one, value) for one, value in read if value is not None]
        if not known:
            return None
        part, x = (
            fmean(column)
            for column in zip(*((self.part(one.time), place(one)[0]) for one, _ in known), strict=True)
        )
        y, z = (fmean(column) for column in zip(*(value for _, value in known), strict=True))
        across = _variance_of_mean([sensor.variance(one) for one, _ in known])
        ahead = _variance_of_mean([one.covariance[0][0] if one.covariance else None for one, _ in known])
        return part, x, y, z, float(len(known)), across, ahead

    def part(self, time: float) -> float:
        """Share of the move that is done at `time`."""
        if self.ended <= self.begun:
            return 1.0
        return min(1.0, max(0.0, (time - self.begun) / (self.ended - self.begun)))

    @staticmethod
    def of(motion: Motion) -> "Move":
        """A motion before its readings."""
        return Move(motion.begun, motion.ended, motion.control)


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
        """Present pose (5,) of the tip, as a tracker without errors would measure it."""
        ...

    @property
    def innovation(self) -> Point:
        """The last reading minus its prediction (mm)."""
        ...

    @property
    def measured(self) -> Point | None:
        """Tip x, y, z measured at the end of the last move with a reading (mm), None before the first."""
        ...

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip."""
        ...

    def shape_sd(self, nodes: Floats) -> Floats:
        """Standard deviations (n, 2), mm, of y and z at predicted nodes (n, 5) of the needle at the target."""
        ...

    def tip_at(self, time: float) -> Point:
        """Estimated position of the tip (mm) at `time`, with constant velocity in each move."""
        ...

    def move(self, motion: Motion) -> "Estimate":
        """The estimate after a motion, as the driver carried it out: without limits, which are those of commands."""
        ...

    def observe(self, measurements: Sequence[Measurement]) -> "Estimate":
        """The estimate corrected by good readings, the newest last."""
        ...

    def without_reading(self) -> "Estimate":
        """The estimate of a period without a good reading: innovation 0."""
        ...


def described(estimate: Estimate) -> str:
    """Return one line about an estimate, for its `repr`."""
    axes, tip = estimate.simulator.scenario.setup.axes, estimate.tip
    position = ", ".join(f"{value:.3f}" for value in tip[: 1 + axes])
    slope = ", ".join(f"{1e3 * value:.2f}" for value in tip[THETA : THETA + axes])
    where = f"tip ({position}) mm ± {estimate.tip_sd:.3f} mm, slope {slope} mrad"
    return f"<{type(estimate).__name__} {where}>"


def after(simulator: Simulator, state: State, applied: Control) -> State:
    """The state after a motion as the driver carried it out, which may exceed a limit of commands a little."""
    return simulator.replay(state, np.array([applied]))[0]


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


def along(moves: tuple[Move, ...], tips: Floats, time: float) -> Point:
    """Position (mm) at `time` on the path through tips (k + 1, 5), at the ends of k moves, at rest between them."""
    if not moves:
        return Pose.of(tips[-1]).point
    times = [limit for done in moves for limit in (done.begun, done.ended)]
    at = [end for k in range(len(moves)) for end in (k, k + 1)]
    x, y, z = (float(np.interp(time, times, tips[at, column])) for column in (X, Y, Z))
    return x, y, z


def _variance_of_mean(variances: Sequence[float | None]) -> float:
    """Variance of the mean of readings with these variances; NaN unless all are known."""
    known = [value for value in variances if value is not None]
    return sum(known) / len(known) ** 2 if len(known) == len(variances) else nan


def place(measurement: Measurement) -> Point:
    """Measured tip (mm) of a good measurement, z = 0 if it is not measured. Raises ValueError for an empty one."""
    if measurement.x is None or measurement.y is None:
        raise ValueError("an empty measurement was not removed")
    return measurement.x, measurement.y, measurement.z or 0.0
