"""Real time."""

from time import monotonic, sleep


class WallClock:
    """The port `Clock` in real time from its construction, or from `start` on the monotonic clock (s).

    speed: how many times as fast it runs, for the replay of recordings.
    """

    def __init__(self, speed: float = 1.0, start: float | None = None) -> None:
        self._start, self._speed = monotonic() if start is None else start, speed

    def now(self) -> float:
        """Seconds since the start."""
        return (monotonic() - self._start) * self._speed

    def wait(self, seconds: float) -> None:
        """Wait for `seconds`."""
        sleep(max(0.0, seconds / self._speed))
