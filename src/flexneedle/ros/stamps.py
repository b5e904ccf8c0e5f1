"""When a received message was measured: its stamp is of a clock of another computer."""

from collections import deque

from flexneedle.errors import InputError

_WINDOW_S = 10.0
_MOST = 1000  # messages in the window


class Stamps:
    """Time of measurement on our own clock, from the stamps and arrivals of one topic.

    The clock of the sender differs from ours by an unknown amount. The smallest difference of arrival and stamp in the
    last 10 s is taken for it: that of the message with the least delay. So a message that was held up on its way has
    its own, earlier time, and none has a time after its arrival. Two messages in order with stamps before the last one
    are of a clock that was set back: the differences from before are forgotten, while messages are refused until then.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque(maxlen=_MOST)
        self._last: float | None = None
        self._back: float | None = None  # stamp of the last message that was refused as old, until one is not

    def measured(self, stamp: float, arrival: float) -> float:
        """Time (s) of `arrival`'s clock at which a message with `stamp` (s) was measured.

        Raises InputError if the message is not newer than the one before, or has no stamp, so that old data could not
        be recognised.
        """
        if stamp == 0.0:
            raise InputError("no time stamp: old data could not be recognised")
        if self._last is not None and stamp <= self._last:
            back = self._last - stamp
            if self._back is not None and stamp > self._back:
                self._differences.clear()
            self._back = stamp
            raise InputError(f"old data: its stamp is {back:.3f} s before that of the last message")
        self._last, self._back = stamp, None
        self._differences.append((arrival, arrival - stamp))
        while self._differences[0][0] < arrival - _WINDOW_S:
            self._differences.popleft()
        return stamp + min(difference for _, difference in self._differences)
