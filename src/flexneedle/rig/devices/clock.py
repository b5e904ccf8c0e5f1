"""Real time."""

from time import monotonic, sleep


class WallClock:
    """The port `Clock` in real time from its construction; `speed` times as fast for the replay of recordings."""

    def __init__(self, speed: float = 1.0) -> None:
        self._start, self._speed = monotonic(), speed

    def now(self) -> float:
        """Seconds since the start."""
        return (monotonic() - self._start) * self._speed

    def wait(self, seconds: float) -> None:
        """Wait for `seconds`."""
        sleep(max(0.0, seconds / self._speed))
