"""Whether the computer was suspended: the monotonic clock stands still meanwhile, so that no other check sees it."""

import time

LONGEST_S = 0.5
"""After a longer one nothing goes on by itself, as after ticks that were late."""


class Suspension:
    """How long the computer was suspended."""

    def __init__(self) -> None:
        self._before = asleep()

    def since(self) -> float:
        """Time (s) for which it was since the last call."""
        before, self._before = self._before, asleep()
        return self._before - before


def asleep() -> float:
    """Time (s) that the monotonic clock leaves out; constant where the system does not tell it (Linux does)."""
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return 0.0 if clock is None else time.clock_gettime(clock) - time.monotonic()
