"""A simulated tip tracker: jitter, bias, missing readings, and a delay, at a fixed rate."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from flexneedle.ports import Clock
from flexneedle.types import VISIBLE, Measurement, Point


class NoisyTracker:
    """Simulated tip tracker with white noise: a `TipTracker`. With one lateral axis z is not measured.

    Args:
        tip_at: Returns the true tip x, y, z (mm) at a time.
        clock: Clock of the run.
        period: Time between two readings (s).
        jitter: Standard deviation of the noise on each axis (mm).
        rng: Random numbers.
        delay: Time (s) from a reading to its arrival; a reading has the time of measurement.
        missing: Share of readings without a tip, except the first, which is available at the start.
        bias: Constant error x, y, z (mm).
        axes: Lateral axes.
        direction_at: Returns the slopes θ, ψ of the tip (rad) at a time (default: not measured).
        direction_jitter: Standard deviation of the noise of the slopes (rad).
        lost_at: Returns True for a time from which the tip is not measured any more (default: never).
    """

    def __init__(
        self,
        tip_at: Callable[[float], Point],
        clock: Clock,
        period: float,
        jitter: float,
        rng: np.random.Generator,
        *,
        delay: float = 0.0,
        missing: float = 0.0,
        bias: Point = (0.0, 0.0, 0.0),
        axes: int = 1,
        direction_at: Callable[[float], Sequence[float]] | None = None,
        direction_jitter: float = 0.0,
        lost_at: Callable[[float], bool] | None = None,
    ) -> None:
        self._lost_at = lost_at
        self._tip_at, self._clock = tip_at, clock
        self._period, self._jitter = period, jitter
        # Readings before the start have their own generator, so that the delay does not change the noise of later ones.
        self._rng, self._rng_before, self._rng_first = rng.spawn(3)
        self._delay, self._missing, self._bias, self._axes = delay, missing, bias, axes
        self._direction_at, self._direction_jitter = direction_at, direction_jitter
        self._rng_direction = rng.spawn(1)[0]
        self._first = -math.ceil(delay / period - 1e-6)  # number k is taken at k periods
        self._taken = self._first - 1  # the last reading

    def read(self) -> tuple[Measurement, ...]:
        """Return the readings that arrived since the last call, oldest first."""
        due = math.floor((self._clock.now() - self._delay) / self._period + 1e-6)
        measurements = tuple(self._measurement(k) for k in range(self._taken + 1, due + 1))
        self._taken = max(due, self._taken)
        return measurements

    @property
    def status(self) -> str:
        """VISIBLE: it never stops."""
        return VISIBLE

    def _measurement(self, number: int) -> Measurement:
        time, is_first = number * self._period, number == self._first
        x, y, z = self._tip_at(time)
        rng = self._rng_first if is_first else self._rng if time > 0.0 else self._rng_before
        noise = rng.normal(0.0, self._jitter, 1 + self._axes).tolist()
        missing = rng.random() < self._missing and not is_first
        if missing or (self._lost_at is not None and self._lost_at(time)):
            return Measurement(time, None, None)
        tip = x + self._bias[0] + noise[0], y + self._bias[1] + noise[1]
        return Measurement(
            time,
            *tip,
            z + self._bias[2] + noise[2] if self._axes > 1 else None,
            direction=self._direction(time),
        )

    def _direction(self, time: float) -> tuple[float, float] | None:
        if self._direction_at is None:
            return None
        theta, psi = self._direction_at(time)
        noise = self._rng_direction.normal(0.0, self._direction_jitter, 2).tolist()
        return theta + noise[0], psi + noise[1]
