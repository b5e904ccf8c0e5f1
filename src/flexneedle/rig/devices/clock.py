"""Time that passes by itself."""

from time import monotonic, sleep


class WallClock:
    """The port `Clock` in real time, from when it was made; `speed` times as fast, for recordings that are replayed."""

    def __init__(self, speed: float = 1.0) -> None:
        self._start, self._speed = monotonic(), speed

    def now(self) -> float:
        """Seconds since the start."""
        return (monotonic() - self._start) * self._speed

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass."""
        sleep(max(0.0, seconds / self._speed))
