"""Times of measurement on the clock of this computer, from the time stamps of messages."""

import math
from collections import deque

from flexneedle.errors import InputError

_WINDOW_S = 10.0
_MOST_IN_WINDOW = 1000
_OBSERVED_S = 0.5  # of a clock that was set back, before a time is derived from it


class StampClock:
    """Times of measurement on the clock of this computer, from the stamps and arrivals of one sender.

    The sender's clock differs by an unknown amount, estimated as the smallest difference of arrival and stamp in the
    last 10 s (the message with the least delay). A delayed message thus keeps its earlier time, and no time is later
    than the arrival. Messages with a stamp before the last one are refused. If two of them are in order, the clock was
    set back or both were delayed: earlier differences are forgotten, and messages are refused until differences of half
    a second are known. A single old message has no effect, because it may be a delayed one.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque(maxlen=_MOST_IN_WINDOW)
        self._last = -math.inf  # the largest stamp that was not old
        self._newest = -math.inf  # the largest stamp since the clock was last set back
        self._behind: float | None = None  # stamp of the previous message, if it was before the newest
        self._since = -math.inf  # arrival at which observation of the clock began

    def to_time(self, stamp: float, arrival: float) -> float:
        """Return the time (s) of measurement, on the clock of `arrival`, of a message with `stamp` (s).

        Raises InputError if the message is not newer than the one before, or has no stamp to detect old data by.
        """
        if stamp == 0.0:
            raise InputError("no time stamp: old data could not be recognised")
        if stamp <= self._newest and self._behind is not None and stamp > self._behind:
            self._newest, self._since = -math.inf, arrival
            self._differences.clear()
        self._behind = stamp if stamp <= self._newest else None
        if self._behind is None:
            self._newest = stamp
            self._add(arrival, stamp)
        if stamp <= self._last:
            back = self._last - stamp
            raise InputError(f"old data: its stamp is {back:.3f} s before the last message's")
        self._last = stamp
        if arrival < self._since + _OBSERVED_S:
            raise InputError(f"its clock was set back: refused until observed for {_OBSERVED_S:g} s")
        return stamp + min(difference for _, difference in self._differences)

    def _add(self, arrival: float, stamp: float) -> None:
        self._differences.append((arrival, arrival - stamp))
        while self._differences[0][0] < arrival - _WINDOW_S:
            self._differences.popleft()
