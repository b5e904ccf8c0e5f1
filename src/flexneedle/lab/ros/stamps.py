"""When a received message was measured: its stamp is of a clock of another computer."""

import math
from collections import deque

from flexneedle.errors import InputError

_WINDOW_S = 10.0
_MOST = 1000  # messages in the window
_OBSERVED_S = 0.5  # for which a clock that was set back is observed before a time is taken from it


class Stamps:
    """Time of measurement on our own clock, from the stamps and arrivals of one topic.

    The clock of the sender differs from ours by an unknown amount. The smallest difference of arrival and stamp in the
    last 10 s is taken for it: that of the message with the least delay. So a message that was held up on its way has
    its own, earlier time, and none has a time after its arrival. Messages with stamps before the last one are refused.
    Two of them in order are of a clock that was set back, or were held up: the differences from before are forgotten,
    and later messages are refused, too, until those of half a second are known. A single one may be held up.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque(maxlen=_MOST)
        self._last = -math.inf  # the largest stamp that was not old
        self._newest = -math.inf  # that since the clock was last set back
        self._behind: float | None = None  # stamp of the message before, if that was behind the newest
        self._since = -math.inf  # arrival from which on the clock is observed

    def measured(self, stamp: float, arrival: float) -> float:
        """Time (s) of `arrival`'s clock at which a message with `stamp` (s) was measured.

        Raises InputError if the message is not newer than the one before, or has no stamp, so that old data could not
        be recognised.
        """
        if stamp == 0.0:
            raise InputError("no time stamp: old data could not be recognised")
        if stamp <= self._newest and self._behind is not None and stamp > self._behind:
            self._newest, self._since = -math.inf, arrival
            self._differences.clear()
        self._behind = stamp if stamp <= self._newest else None
        if self._behind is None:
            self._newest = stamp
            self._differences.append((arrival, arrival - stamp))
            while self._differences[0][0] < arrival - _WINDOW_S:
                self._differences.popleft()
        if stamp <= self._last:
            back = self._last - stamp
            raise InputError(f"old data: its stamp is {back:.3f} s before that of the last message")
        self._last = stamp
        if arrival < self._since + _OBSERVED_S:
            raise InputError(f"its clock was set back: refused until that was observed for {_OBSERVED_S:g} s")
        return stamp + min(difference for _, difference in self._differences)
