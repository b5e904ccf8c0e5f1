"""When frames were taken, from when they were asked for: number by number, on a line that no asking is earlier than."""

from collections import deque

_WINDOW = 400  # frames: 10 s, over which a clock that is off by 100 ppm drifts by 1 ms


class Timeline:
    """Times of frames that are taken at a fixed rate (Hz) and asked for a little later, not before.

    Frame n is asked for at aₙ = t₀ + n/rate + lag, lag ≥ 0 (but for the way of a command to the tracker, under a
    millisecond) and now and then near its least. The time told is t₀ + n/rate with t₀ = min(a − n/rate) over the last
    400 frames: late by the least lag alone, whatever the others were. When the answer arrived does not matter: an old
    frame that comes late is not new. Times rise strictly and are never after the asking.
    """

    def __init__(self, rate: float) -> None:
        self._period = 1 / rate
        self._starts: deque[float] = deque(maxlen=_WINDOW)
        self._last: float | None = None

    def stamp(self, number: int, asked: float) -> float:
        """Return when frame `number` was taken (s, on the clock of `asked`). Call it with rising numbers."""
        self._starts.append(asked - number * self._period)
        time = min(self._starts) + number * self._period
        if self._last is not None:  # an earlier start was learnt: let the time go on nevertheless
            time = min(asked, max(time, self._last + self._period / 2))
        self._last = time
        return time


class Numbering:
    """Frame numbers that go on over reconnections, also where the tracker counts from the start again."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._shift = 0
        self._last: tuple[int, float] | None = None

    def count(self, number: int, asked: float) -> int:
        """Return the number of a frame; one not above the last goes on by the time that has passed."""
        told = number + self._shift
        if self._last is not None and told <= self._last[0]:
            last, before = self._last
            told = last + max(1, round((asked - before) * self._rate))
            self._shift = told - number
        self._last = told, asked
        return told
