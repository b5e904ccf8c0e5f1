"""Real time, and time for which the computer was suspended."""

import time
from time import monotonic, sleep


class WallClock:
    """The port `Clock` in real time from its construction, or from `start` on the monotonic clock (s)."""

    def __init__(self, start: float | None = None) -> None:
        self._start = monotonic() if start is None else start

    def now(self) -> float:
        """Return the seconds since the start."""
        return monotonic() - self._start

    def wait(self, seconds: float) -> None:
        """Wait for `seconds`."""
        sleep(max(0.0, seconds))


class Suspension:
    """Time for which the computer was suspended. The monotonic clock stops then: no other check notices it."""

    def __init__(self) -> None:
        self._before = suspended_s()

    def since(self) -> float:
        """Return the time (s) of suspension since the last call."""
        before, self._before = self._before, suspended_s()
        return self._before - before


def suspended_s() -> float:
    """Return the time (s) that the monotonic clock leaves out; constant where the system does not report it."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return 0.0 if boot is None else time.clock_gettime(boot) - time.monotonic()
