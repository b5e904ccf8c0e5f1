"""The pace of an insertion: real time or another, paused, or one period at a time."""

from collections.abc import Callable
from time import monotonic

from flexneedle.errors import StoppedError
from flexneedle.lab.page.worker.signals import Signals

_AT_ONCE_S = 1e-6


Wait = Callable[[float | None], None]
"""Waits for a signal, at most a time (s; None: any)."""


class Pacer:
    """Lets an insertion continue when it is time.

    wait: for a signal; each_time: called after each wait, for signals that are not about the pace; on_pause: called
    with whether the insertion is paused, when that changes.
    """

    def __init__(
        self,
        signals: Signals,
        wait: Wait,
        each_time: Callable[[], None],
        on_pause: Callable[[bool], None],
        now: Callable[[], float] = monotonic,
    ) -> None:
        self._signals, self._wait, self._each_time = signals, wait, each_time
        self._on_pause, self._now = on_pause, now
        self._since, self._rate = now(), signals.pace
        self._paused: bool | None = None

    def start(self) -> None:
        """Wait until the first period may begin."""
        self._since = self._now()
        self._until(0.0)

    def after(self, seconds: float) -> None:
        """Wait after a period that has taken a time (s) of the insertion, less what it has taken to compute.

        Raises Cancelled or StoppedError after such a signal.
        """
        self._until(seconds)

    def _until(self, left: float) -> None:
        while True:
            self._each_time()
            self._check()
            now = self._now()
            left -= (now - self._since) * self._rate  # at the pace until now
            self._since, self._rate = now, (pace := self._signals.pace)
            if pace == 0.0:
                self._note(paused=True)
                if self._signals.advance():
                    return
                self._wait(None)
                self._since = self._now()
            elif left > _AT_ONCE_S:
                self._note(paused=False)
                self._wait(left / pace)
            else:
                self._note(paused=False)
                return

    def _check(self) -> None:
        self._signals.check()
        if self._signals.stopped:
            raise StoppedError(f"stopped: {self._signals.stopped}")

    def _note(self, *, paused: bool) -> None:
        if paused != self._paused:
            self._paused = paused
            self._on_pause(paused)
