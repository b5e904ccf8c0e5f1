"""Sensors along the needle in the fit: their readings, predictions and derivatives, as real rows.

Readings are averaged over each move. Values of a sensor that rolls with the needle are turned back to the stage's axes
before, each by the needle's angle at its time, so that the quantity of the model is smooth over the depth; then the
offset turns instead.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.moves import Move
from flexneedle.scenario.sensors.sensor import Sensor, predict_values, turn
from flexneedle.types import Flags, Floats, Needles, Reading

DOUBT = 2.0
"""Factor on the model's error where readings are compared with their predictions."""
_ROUNDING_S = 1e-9


class SensorSlots(NamedTuple):
    """Places of a sensor's parameters: offset and where they exist gain errors, turn (rad) and clock error (s).

    drift: steps, one after another, of an error of all values that grows along the way; gain: of each pair of values.
    """

    offset: slice
    drift: slice
    place: slice
    gain: slice
    turn: int | None
    clock: int | None


class SensorPriors(NamedTuple):
    """Prior standard deviations of the errors of a sensor; 0: not fitted, but for the offset, which always is."""

    offset: float
    gain: float
    turn: float  # rad
    clock: float  # s

    @staticmethod
    def of(sensor: Sensor) -> "SensorPriors":
        """Return the scenario's."""
        return SensorPriors(
            sensor.offset_sd, sensor.gain_sd, math.radians(sensor.turn_sd_deg), sensor.delay_sd_s
        )


class Timeline(NamedTuple):
    """Times (m,), s, of moves, the needle's angle (rad) at their start, its change, and which of them roll (m,)."""

    begun: Floats
    travel_begun: Floats
    ended: Floats
    angle: Floats
    turned: Floats
    rolls: Flags

    @staticmethod
    def of(moves: Sequence[Move], roll: float) -> "Timeline":
        """Return the timeline of moves from a needle's angle."""
        rows = np.array(
            [
                (one.begun, one.travel_begun, one.ended, one.control.roll, one.control.spin)
                for one in (done.motion for done in moves)
            ]
        ).reshape(-1, 5)
        turned = rows[:, 3] + rows[:, 4]
        begun, travel_begun, ended = rows[:, :3].T
        angle = roll + np.cumsum(turned) - turned
        return Timeline(begun, travel_begun, ended, angle, turned, rows[:, 3] != 0.0)

    def at(self, times: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Return move, share of it done, and angle of the needle (r,), at times (r,)."""
        index = np.searchsorted(self.begun[1:], times - _ROUNDING_S, side="left")
        begun, ended = self.travel_begun[index], self.ended[index]
        length = np.where(ended > begun, ended - begun, 1.0)
        part = np.where(ended > begun, np.clip((times - begun) / length, 0.0, 1.0), 1.0)
        return index, part, self.angle[index] + part * self.turned[index]


@dataclass(frozen=True, eq=False)
class Bins:
    """Means of readings over b moves, in the stage's axes."""

    index: NDArray[np.intp]  # moves (b,)
    part: Floats  # share of the move that is done (b,)
    value: Floats  # (b, d), 0 where nothing was measured
    count: Floats  # readings (b, d)
    facing: NDArray[Any]  # mean direction (b,) of the sensor's axes, 1 for one that does not roll
    time: Floats  # (b,), s


@dataclass(frozen=True, eq=False)
class Comparison:
    """Readings (r,) of a sensor beside their predictions."""

    value: Floats  # (r, d), NaN where nothing was measured
    residual: Floats  # value minus prediction (r, d)
    covariance: (
        Floats  # of the prediction (d, d), with twice the model's error, which lasts from reading to reading
    )
    noise: float  # standard deviation of the white noise of a value

    @property
    def sds(self) -> Floats:
        """Residuals (r, d) over the standard deviation of each."""
        sds: Floats = self.residual / np.sqrt(np.diag(self.covariance) + self.noise**2)
        return sds

    def nis(self, good: Flags) -> float:
        """Return the normalised square of the mean residual of good readings (r,), 1 on average; NaN without any."""
        kept = self.residual[good]
        count = np.isfinite(kept).sum(axis=0)
        seen = count > 0
        if not seen.any():
            return np.nan
        mean = np.nansum(kept, axis=0)[seen] / count[seen]
        covariance = self.covariance[np.ix_(seen, seen)] + np.diag(self.noise**2 / count[seen])
        square: float = mean @ np.linalg.solve(covariance, mean)
        return square / int(mean.size)


def without_prediction(readings: Sequence[Reading]) -> Comparison:
    """Return readings (r,) that are compared with nothing, of an estimate that does not predict them."""
    known = [any(math.isfinite(value) for row in one.rows for value in row) for one in readings]
    value = np.where(known, 0.0, np.nan)[:, None]
    return Comparison(value, np.full_like(value, np.nan), np.eye(1), 0.0)


@dataclass(frozen=True, eq=False)
class SensorFit:
    """A sensor in the fit, and its readings until now."""

    sensor: Sensor
    slots: SensorSlots
    axes: int
    size: int  # number of values d
    depths: Floats  # of the tip at the knots of the drift (k,), mm, behind the skin
    time: Floats  # (r,), s
    value: Floats  # (r, d), NaN where nothing was measured
    used: Flags  # readings (r,) that correct the model

    @staticmethod
    def begin(
        sensor: Sensor, axes: int, first: int, priors: SensorPriors, depths: Floats
    ) -> "tuple[SensorFit, list[float]]":
        """Return a sensor without readings, whose parameters begin at `first`, and their prior standard deviations.

        depths: knots (k,) of its drift.
        """
        size, lateral = sensor.size(axes), axes if sensor.paired else 1
        step = sensor.drift_sd / math.sqrt(max(1, depths.size))
        groups = (
            [priors.offset] * (lateral if sensor.common_offset else size),
            [step] * (depths.size * lateral),
            sensor.place_sds,
            [priors.gain] * (size // lateral if priors.gain else 0),
            [priors.turn] * (sensor.paired and axes == 2 and priors.turn > 0.0),
            [priors.clock] * (priors.clock > 0.0),
        )
        ends = first + np.cumsum([0, *map(len, groups)])
        offset, drift, place, gain, turned, clock = (
            slice(*pair) for pair in itertools.pairwise(ends.tolist())
        )
        slots = SensorSlots(
            offset,
            drift,
            place,
            gain,
            turned.start if groups[4] else None,
            clock.start if groups[5] else None,
        )
        none = np.zeros(0), np.zeros((0, size)), np.zeros(0, dtype=bool)
        return SensorFit(sensor, slots, axes, size, depths, *none), [sd for group in groups for sd in group]

    @property
    def name(self) -> str:
        """Name of the sensor."""
        return self.sensor.title

    def add(self, time: Floats, value: Floats) -> "SensorFit":
        """Return the sensor with further readings (n,) and (n, d)."""
        return replace(
            self,
            time=np.append(self.time, time),
            value=np.concatenate([self.value, value]),
            used=np.append(self.used, np.ones(len(time), dtype=bool)),
        )

    def without(self, since: float) -> "SensorFit":
        """Return the sensor whose readings from a time (s) on do not count."""
        return replace(self, used=self.used & (self.time < since))

    def clock(self, parameters: Floats) -> float:
        """Return the clock error (s) of parameters (K,); 0 where it is not estimated."""
        place: int | None = self.slots.clock
        return 0.0 if place is None else float(parameters[place])

    @cached_property
    def _known(self) -> tuple[Floats, Floats]:
        return self.time[self.used], self.value[self.used]

    def bins(self, line: Timeline, clock: float) -> Bins:
        """Return the means over moves of the readings that count, which were taken `clock` (s) before their time."""
        time, value = self._known
        index, part, angle = line.at(time - clock)
        order = np.argsort(index, kind="stable")
        index, part, value, time = index[order], part[order], value[order], time[order]
        facing = np.exp(1j * angle[order]) if self.sensor.rolls else np.ones(len(index), dtype=complex)
        first = np.flatnonzero(np.diff(index, prepend=-1))
        seen = np.isfinite(value)

        def total(rows: NDArray[Any]) -> NDArray[Any]:
            return np.add.reduceat(rows, first) if len(first) else rows

        if self.sensor.rolls and self.axes == 2:  # a pair is turned as a whole
            seen = np.repeat(seen[:, ::2] & seen[:, 1::2], 2, axis=1)
        if self.sensor.rolls:  # between the ends of a roll its axes and the needle turn unevenly
            seen &= ~line.rolls[index][:, None]
        number, count = total(np.ones(len(index))), total(seen.astype(float))
        level = np.where(seen, value, 0.0)
        mean = total(self._turned(level, facing)) / np.maximum(count, 1.0)
        return Bins(
            index[first], total(part) / number, mean, count, total(facing) / number, total(time) / number
        )

    def values(self, poses: Floats, length: float) -> Floats:
        """Return the values (…, d) of an error-free sensor on poses (…, n, 5) of needles, by their length (mm)."""
        return self._of_each(poses, length, lambda needles: predict_values(self.sensor, needles, self.axes))

    def quantities(self, poses: Floats, length: float) -> Floats:
        """Return `values`, followed by their derivatives to the places of the sensor: (…, d, 1 + p)."""
        values = self.values(poses, length)[..., None]
        if not self.sensor.place_sds:
            return values
        slopes = self._of_each(poses, length, lambda needles: self.sensor.slopes(needles, self.axes))
        return np.concatenate([values, slopes], axis=-1)

    @staticmethod
    def _of_each(poses: Floats, length: float, compute: Callable[[Needles], Floats]) -> Floats:
        flat = poses.reshape(-1, *poses.shape[-2:])
        found = compute(Needles(flat, length / (flat.shape[1] - 1)))
        return found.reshape(*poses.shape[:-2], *found.shape[1:])

    def placed(self, ends: Floats, parameters: Floats) -> Floats:
        """Return the values (m, d) of the sensor at its estimated places, of `quantities` (m, d, 1 + p)."""
        level = ends[:, :, 0]
        return level + ends[:, :, 1:] @ parameters[self.slots.place] if ends.shape[2] > 1 else level

    def predict_at(
        self, time: Floats, ends: Floats, depth: float, line: Timeline, parameters: Floats
    ) -> Floats:
        """Return the predicted values (r, d) at times (r,), with the tip at a depth (mm).

        ends (m + 1, d, 1 + p): `quantities` at the ends of the moves.
        """
        index, part, angle = line.at(time - self.clock(parameters))
        ends = self.placed(ends, parameters)
        level = (1.0 - part)[:, None] * ends[index] + part[:, None] * ends[index + 1]
        return self._turned(self._with_gain(level, parameters), np.exp(-1j * angle)) + self._errors(
            np.array([depth]), parameters
        )

    def bin_at(self, time: Floats, line: Timeline) -> Bins:
        """Return bins (b,) of one reading each, at times (b,)."""
        index, part, angle = line.at(time)
        none = np.zeros((len(time), self.size))
        facing = np.exp(1j * angle) if self.sensor.rolls else np.ones(len(time), dtype=complex)
        return Bins(index, part, none, none, facing, time)

    def _spread(self, depth: Floats) -> Floats:
        """Return the drift (b, d, k · c) of values by the components of its steps, with the tip at depths (b,), mm.

        It is 0 up to the skin, and changes by a step from knot to knot, linearly: a random walk.
        """
        size = self.size
        width = self.axes if self.sensor.paired else 1
        begins = np.append(0.0, self.depths[:-1])
        ramps = np.clip((depth[:, None] - begins) / (self.depths - begins), 0.0, 1.0)
        units = np.tile(np.eye(width), (size // width, 1))
        spread: Floats = np.einsum("bk,dc->bdkc", ramps, units).reshape(
            len(depth), size, len(self.depths) * width
        )
        return spread

    def variances(self, bins: Bins) -> Floats:
        """Return the variances (b, d) of means, infinite where nothing was measured."""
        noise = self.sensor.noise**2 / np.maximum(bins.count, 1.0) + self.sensor.model_error(bins.value) ** 2
        return np.where(bins.count > 0.0, noise, np.inf)

    def expected(self, bins: Bins, ends: Floats, depth: Floats, parameters: Floats) -> Floats:
        """Return the predicted means (b, d), with the tip at depths (b,), mm; ends: as for `predict_at`."""
        level = self._with_gain(between(bins, self.placed(ends, parameters)), parameters)
        return level + self._turned(self._errors(depth, parameters), bins.facing)

    def _errors(self, depth: Floats, parameters: Floats) -> Floats:
        """Return offset and drift (b, d), with the tip at depths (b,), mm."""
        own = parameters[self.slots.offset]
        offset = np.broadcast_to(np.tile(own, self.size // own.size), (len(depth), self.size))
        if self.slots.drift.stop == self.slots.drift.start:
            return offset
        return offset + self._spread(depth) @ parameters[self.slots.drift]

    def _turned(self, value: Floats, facing: Any) -> Floats:
        """Return values (r, d) of a sensor that rolls in the stage's axes, others as they are."""
        return turn(value, facing, self.axes) if self.sensor.rolls else value

    def in_its_axes(self, rows: Floats, bins: Bins) -> Floats:
        """Return rows (…, b, d) in the sensor's own axes."""
        flat = rows.reshape(-1, self.size)
        facing = np.tile(bins.facing.conj(), len(flat) // max(1, len(bins.facing)))
        return self._turned(flat, facing).reshape(rows.shape)

    def _gains(self, parameters: Floats) -> Floats:
        """Return the gains (d,), or (1,) where their error is not estimated."""
        errors = parameters[self.slots.gain]
        return 1.0 + (np.repeat(errors, self.size // errors.size) if errors.size else np.zeros(1))

    def _with_gain(self, level: Floats, parameters: Floats) -> Floats:
        scaled = self._gains(parameters) * level
        if self.slots.turn is None:
            return scaled
        return turn(scaled, np.exp(1j * parameters[self.slots.turn]), self.axes)

    def jacobian(
        self, bins: Bins, ends: Floats, depth: Floats, slopes: Floats, parameters: Floats, line: Timeline
    ) -> Floats:
        """Return derivatives (b, d, K) of the predicted means, from those (b, K, d) of the quantities.

        Other arguments: as for `expected`.
        """
        slopes_of_places, ends = ends[:, :, 1:], self.placed(ends, parameters)
        level = between(bins, ends)
        jacobian = self._gains(parameters)[:, None] * slopes.transpose(0, 2, 1)
        for k, unit in enumerate(np.eye(self.slots.offset.stop - self.slots.offset.start)):
            each = np.broadcast_to(np.tile(unit, self.size // unit.size), level.shape)
            jacobian[:, :, self.slots.offset.start + k] = self._turned(each, bins.facing)
        if self.slots.drift.stop > self.slots.drift.start:
            spread = self._spread(depth)
            for k in range(spread.shape[2]):
                jacobian[:, :, self.slots.drift.start + k] = self._turned(spread[:, :, k], bins.facing)
        for k in range(slopes_of_places.shape[2]):
            jacobian[:, :, self.slots.place.start + k] = between(bins, slopes_of_places[:, :, k])
        if count := self.slots.gain.stop - self.slots.gain.start:
            jacobian[:, :, self.slots.gain] = level[:, :, None] * np.repeat(
                np.eye(count), level.shape[1] // count, axis=0
            )
        if self.slots.turn is not None:
            jacobian[:, :, self.slots.turn] = turn(level, np.array(1j), self.axes)
        if self.slots.clock is not None:
            jacobian[:, :, self.slots.clock] = self._rates(bins, level, ends, line)
        return jacobian

    def _rates(self, bins: Bins, level: Floats, ends: Floats, line: Timeline) -> Floats:
        """Return the derivatives (b, d) of predicted minus measured means to the clock error (s)."""
        length = (line.ended - line.travel_begun)[bins.index]
        moving = (length > 0.0) & (bins.part < 1.0)
        rate = np.where(moving, 1.0, 0.0) / np.where(length > 0.0, length, 1.0)
        change = -(ends[bins.index + 1] - ends[bins.index]) * rate[:, None]
        if self.sensor.rolls and self.axes == 2:
            return change + turn(level, 1j * line.turned[bins.index] * rate, self.axes)
        return change


def between(bins: Bins, ends: Floats) -> Floats:
    """Return quantities (b, d) of means, from those (m + 1, d) at the ends of the moves."""
    part = bins.part[:, None]
    level: Floats = (1.0 - part) * ends[bins.index] + part * ends[bins.index + 1]
    return level


def whiten(rows: Sequence[NDArray[Any]], variance: Floats, sd: float, distance: Floats) -> list[NDArray[Any]]:
    """Return arrays (b, …) with the noise of their rows made white, of variance 1.

    Its covariance is sd² e^(−|d_i − d_j|), and `variance` (b,) more on the diagonal; distance (b,) is over the
    correlation's. Rows without a finite variance become 0.
    """
    known = np.isfinite(variance)
    if sd == 0.0:
        scale = np.where(known, 1.0 / np.sqrt(np.where(known, variance, 1.0)), 0.0)
        return [(one.T * scale).T for one in rows]
    off = np.abs(distance[known, None] - distance[known])
    lower = np.linalg.cholesky(np.diag(variance[known]) + sd**2 * np.exp(-off))
    found = []
    for one in rows:
        white = np.zeros_like(one)
        white[known] = np.linalg.solve(lower, one[known])
        found.append(white)
    return found
