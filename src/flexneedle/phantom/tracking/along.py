"""Virtual sensors along the needle, on the true needle, with errors that the observer does not know."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from flexneedle.scenario.sensors.sensor import Fault, Sensor, predict_values, turn
from flexneedle.types import VISIBLE, Floats, Matrix, Needles, Point, Reading, X


class MeasuredNeedle(Protocol):
    """The true needle as sensors measure it: a `Phantom` that keeps its shapes, or a needle with such a history."""

    def now(self) -> float:
        """Return the time (s) since the start."""
        ...

    def tip_at(self, time: float, /) -> Point:
        """Return the true tip x, y, z (mm) at a time (s)."""
        ...

    def shape_at(self, time: float, /) -> tuple[Floats, float]:
        """Return the true poses (n, 5), at equal distances along the needle, and its roll (rad) at a time (s)."""
        ...


class VirtualSensor:
    """A `NeedleSensor` that measures the phantom.

    Args:
        sensor: The sensor as the scenario describes it.
        phantom: The phantom.
        axes: Lateral axes.
        depth: Depth (mm) of the target, at which a drift is complete.
        length: Length of the needle (mm).
        rng: Random numbers.
    """

    def __init__(
        self,
        sensor: Sensor,
        phantom: MeasuredNeedle,
        axes: int,
        depth: float,
        length: float,
        rng: np.random.Generator,
    ) -> None:
        # Each quantity has its own generator, so that a change of one does not change the others.
        places, errors, self._rng, faults = rng.spawn(4)
        self._sensor, self._phantom = sensor, phantom
        self._axes, self._depth, self._length = axes, depth, length
        self._mounted = sensor.mounted(places)
        pairs = axes if sensor.paired else 1
        self._gain = 1.0 + np.repeat(errors.normal(0.0, sensor.gain_sd, sensor.size(axes) // pairs), pairs)
        self._turn = errors.normal(0.0, math.radians(sensor.turn_sd_deg))
        self._offset = sensor.drawn_offset(errors, axes)
        self._drift = sensor.drawn_drift(errors, axes)
        self._clock = errors.uniform(-1.0, 1.0) * sensor.phantom.clock_s
        self._faulty_way = faults.choice([-1.0, 1.0], axes if sensor.paired else 1)
        self._wander = errors.normal(0.0, 1.0, self._offset.size)
        self._taken = -1
        self._last: Matrix | None = None
        self._lost = False

    @property
    def clock_error(self) -> float:
        """Error of the time stamps (s)."""
        return self._clock

    @property
    def status(self) -> str:
        """VISIBLE, or that it is lost."""
        return "no more readings" if self._lost else VISIBLE

    def read(self) -> tuple[Reading, ...]:
        """Return the readings that arrived since the last call, oldest first."""
        period, now = 1.0 / self._sensor.rate_hz, self._phantom.now()
        taken: list[tuple[float, Fault | None, float]] = []
        while True:
            time = (self._taken + 1) * period
            fault = self._fault_at(time)
            late = fault.size if fault and fault.kind == "delayed" else 0.0
            if time + self._sensor.delay_s + late > now + 1e-9:
                break
            self._taken += 1
            self._lost = fault is not None and fault.kind == "lost"
            if not self._lost:
                taken.append((time, fault, time + self._clock + late))
        if not taken:
            return ()
        levels = self._values([time for time, *_ in taken])
        return tuple(self._measure(level, *one) for level, one in zip(levels, taken, strict=True))

    def _fault_at(self, time: float) -> Fault | None:
        """Return the fault, if it has begun."""
        fault = self._sensor.phantom.fault
        return fault if fault and self._phantom.tip_at(time)[X] >= fault.depth_mm else None

    def _measure(self, level: Floats, time: float, fault: Fault | None, stamp: float) -> Reading:
        errors, sensor = self._sensor.phantom, self._sensor
        noise = self._rng.normal(0.0, sensor.noise, self._offset.size)
        chance, outlying, side = self._rng.random(3).tolist()
        self._step_wander()
        if fault and fault.kind == "frozen" and self._last is not None:
            return Reading(stamp, self._last)
        if chance < errors.missing_fraction:
            return Reading(stamp, (), "missing")
        values = level + noise + sensor.wander_sd * self._wander
        if fault and fault.kind == "drift":
            gone = self._phantom.tip_at(time)[X] - fault.depth_mm
            values += fault.size * sensor.noise * gone * np.tile(self._faulty_way, values.size)[: values.size]
        share = fault.size if fault and fault.kind == "outliers" else errors.outlier_fraction
        if outlying < share:
            values += math.copysign(errors.outlier_size * sensor.noise, side - 0.5)
        self._last = rows = sensor.report(values, self._axes)
        return Reading(stamp, rows)

    def _step_wander(self) -> None:
        kept = math.exp(-1.0 / (self._sensor.rate_hz * self._sensor.wander_s))
        fresh = self._rng.normal(0.0, math.sqrt(1.0 - kept**2), self._wander.size)
        self._wander = kept * self._wander + fresh

    def _values(self, times: Sequence[float]) -> Floats:
        """Return the values (r, d) at times (r,) without noise, NaN where the sensor does not see the needle."""
        shapes, rolls = zip(*(self._phantom.shape_at(time) for time in times), strict=True)
        poses = np.stack(shapes)
        needles = Needles(poses, self._length / (poses.shape[1] - 1))
        seen = self._mounted.sees(needles, self._axes)
        level = self._gain * predict_values(self._mounted, needles, self._axes)
        if self._sensor.paired:
            angles = self._turn - (np.array(rolls) if self._sensor.rolls else np.zeros(len(times)))
            level = turn(level, np.exp(1j * angles), self._axes)
        grown = np.maximum(0.0, poses[:, -1, X]) / self._depth
        return np.where(seen, level + self._offset + np.multiply.outer(grown, self._drift), np.nan)
