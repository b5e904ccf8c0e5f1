"""Time that passes by itself."""

from time import monotonic, sleep

__all__ = ["WallClock"]


class WallClock:
    """The port `Clock` in real time, from when it was made."""

    def __init__(self) -> None:
        self._start = monotonic()

    def now(self) -> float:
        """Seconds since the start."""
        return monotonic() - self._start

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass."""
        sleep(max(0.0, seconds))
