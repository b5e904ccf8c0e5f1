"""Interface of all observers: the estimated needle, corrected by delayed readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import nan
from statistics import fmean
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.sensor import Sensor
from flexneedle.estimation.sensors import SENSORS
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL, THETA, Control, Floats, Measurement, Motion, Point, Pose, X, Y, Z

_KEPT = 100  # readings of a move at rest that are kept one by one
_ROUNDING_S = 1e-9


@dataclass(frozen=True)
class Move:
    """A motion from `begun` to `ended` (s) as applied by the driver, and the good readings taken during it.

    turned: end of the roll before the travel (s); None: there was no roll. earlier: means over readings of a needle at
    rest that are no longer kept one by one.
    """

    begun: float
    ended: float
    applied: Control
    measurements: tuple[Measurement, ...] = ()
    turned: float | None = None
    earlier: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @cached_property
    def means(self) -> Mapping[str, tuple[float, ...]]:
        """Means over its readings by sensor: share of the move done, x (mm), y and z of the measured quantity, their
        number, and the variances of the means of y or z and of x where all readings report them, else NaN. Sensors
        without readings are left out.
        """
        means = ((sensor.name, self._mean(sensor)) for sensor in SENSORS.values())
        newer = {name: mean for name, mean in means if mean is not None}
        both = {name: _joined(self.earlier[name], newer[name]) for name in self.earlier.keys() & newer.keys()}
        return {**self.earlier, **newer, **both}

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
        """Share of the travel that is done at `time`."""
        if self.ended <= self.travel_begun:
            return 1.0
        return min(1.0, max(0.0, (time - self.travel_begun) / (self.ended - self.travel_begun)))

    @property
    def travel_begun(self) -> float:
        """Start of the travel (s), after the roll."""
        return self.begun if self.turned is None else self.turned

    def with_readings(self, new: tuple[Measurement, ...]) -> "Move":
        """The move with further readings, of which a needle at rest keeps the newest, and the mean of the others."""
        every = self.measurements + new
        count = len(every) - _KEPT if self.applied == STILL else 0
        if count <= 0:
            return replace(self, measurements=every)
        older = replace(self, measurements=every[:count])
        return replace(self, measurements=every[count:], earlier=older.means)

    @staticmethod
    def of(motion: Motion) -> "Move":
        """A motion before its readings."""
        return Move(motion.begun, motion.ended, motion.control, turned=motion.turned)


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
    """Assign each measurement to the last move that had begun, earlier ones to the first: between moves it rests."""
    owner = _owners(moves, measurements)
    return tuple(
        done.with_readings(new)
        if (new := tuple(one for one, k in zip(measurements, owner, strict=True) if k == j))
        else done
        for j, done in enumerate(moves)
    )


def outside_rolls(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> list[Measurement]:
    """The measurements without those of a roll, whose tip is between two sides of the needle's axis.

    Their time tells the roll's share only if the motor turns evenly; without them nothing has to be known of it.
    """
    if not moves:
        return list(measurements)
    owned = zip(measurements, _owners(moves, measurements), strict=True)
    return [
        one for one, k in owned if moves[k].turned is None or one.time > moves[k].travel_begun - _ROUNDING_S
    ]


def _owners(moves: tuple[Move, ...], measurements: Sequence[Measurement]) -> NDArray[np.intp]:
    """The number of the last move that had begun before each measurement, 0 for earlier ones."""
    starts = np.array([done.begun for done in moves[1:]])
    owners: NDArray[np.intp] = np.searchsorted(starts, [one.time - _ROUNDING_S for one in measurements])
    return owners


def along(moves: tuple[Move, ...], tips: Floats, time: float) -> Point:
    """Position (mm) at `time` on the path through tips (k + 1, 5), at the ends of k moves, at rest between them."""
    if not moves:
        return Pose.of(tips[-1]).point
    times = [limit for done in moves for limit in (done.travel_begun, done.ended)]
    at = [end for k in range(len(moves)) for end in (k, k + 1)]
    x, y, z = (float(np.interp(time, times, tips[at, column])) for column in (X, Y, Z))
    return x, y, z


def _joined(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    """The means of two sets of readings as those of both, as `Move.means` has them."""
    *_, count, _, _ = one
    *_, more, _, _ = other
    shares = count / (count + more), more / (count + more)
    means = [shares[0] * a + shares[1] * b for a, b in zip(one[:4], other[:4], strict=True)]
    variances = [shares[0] ** 2 * a + shares[1] ** 2 * b for a, b in zip(one[5:], other[5:], strict=True)]
    return *means, count + more, *variances


def _variance_of_mean(variances: Sequence[float | None]) -> float:
    """Variance of the mean of readings with these variances; NaN unless all are known."""
    known = [value for value in variances if value is not None]
    return sum(known) / len(known) ** 2 if len(known) == len(variances) else nan


def place(measurement: Measurement) -> Point:
    """Measured tip (mm) of a good measurement, z = 0 if it is not measured. Raises ValueError for an empty one."""
    if measurement.x is None or measurement.y is None:
        raise ValueError("an empty measurement was not removed")
    return measurement.x, measurement.y, measurement.z or 0.0
