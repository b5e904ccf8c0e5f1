"""A simulated tip tracker with jitter, at a fixed rate."""

import math
from collections.abc import Callable

import numpy as np

from flexneedle.ports import Clock, Sample


class NoisyTracker:
    """Reads `tip_at(time)` → (x, y) in mm every `period` s with white noise of `jitter` mm on each axis.

    A `Tracker`; all it shows of what it measures are noisy samples.
    """

    def __init__(
        self,
        tip_at: Callable[[float], tuple[float, float]],
        clock: Clock,
        period: float,
        jitter: float,
        rng: np.random.Generator,
    ) -> None:
        self._tip_at, self._clock = tip_at, clock
        self._period, self._jitter, self._rng = period, jitter, rng
        self._taken = 0  # readings so far; number k is taken at k periods

    def read(self) -> tuple[Sample, ...]:
        """Return the readings since the last call, oldest first."""
        due = math.floor(self._clock.now() / self._period + 1e-6)
        samples = tuple(self._sample(k * self._period) for k in range(self._taken + 1, due + 1))
        self._taken = max(due, self._taken)
        return samples

    def _sample(self, time: float) -> Sample:
        x, y = self._tip_at(time)
        noise = self._rng.normal(0.0, self._jitter, 2)
        return Sample(time, x + float(noise[0]), y + float(noise[1]))
