"""Times of measurement of frames, estimated from their numbers and the times of their requests."""

from collections import deque

_WINDOW = 400  # frames: 10 s, in which a clock error of 100 ppm adds up to 1 ms


class Timeline:
    """Times of frames that are taken at a fixed rate (Hz) and requested after they were taken.

    Frame n is requested at aₙ = t₀ + n/rate + lag with lag ≥ 0 (except for the transmission time of the command, under
    1 ms), and sometimes with a lag near its minimum. The estimated time is t₀ + n/rate with t₀ = min(a − n/rate) over
    the last 400 frames: its error is only the smallest lag. The time of arrival is not used, since a reply may be
    delayed. Times increase with the requests, and are never after them.
    """

    def __init__(self, rate: float) -> None:
        self._period = 1 / rate
        self._starts: deque[float] = deque(maxlen=_WINDOW)

    def stamp(self, number: int, requested: float) -> float:
        """Return the time of measurement (s, on the clock of `requested`) of frame `number`; numbers must increase."""
        self._starts.append(requested - number * self._period)
        # The minimum matters where a large number is rounded.
        return min(requested, min(self._starts) + number * self._period)


class Numbering:
    """Frame numbers that increase across reconnections, also if the tracker restarts its count."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._shift = 0
        self._last: tuple[int, float] | None = None

    def count(self, number: int, requested: float) -> int:
        """Return the continuous number of a frame; after a restart it is extrapolated by the elapsed time."""
        continuous = number + self._shift
        if self._last is not None and continuous <= self._last[0]:
            last, before = self._last
            continuous = last + max(1, round((requested - before) * self._rate))
            self._shift = continuous - number
        self._last = continuous, requested
        return continuous
