"""What the server changes about the job at work: taken by a thread, read by the job."""

from collections.abc import Callable
from threading import Condition
from time import monotonic

from flexneedle.lab.page.messages import Disturb
from flexneedle.lab.page.orders import Signal


class Cancelled(Exception):
    """The job is cancelled."""


class Signals:
    """Signals of one job. pace: as in `orders.Signal`; stopped: why the insertion is to end as interrupted, or "".

    held: why the needle of a rig is to rest, "" if it may go. heard: when the last signal came (monotonic, s).
    on_stop: called at once, in the thread that reads orders, with the reason when the job is stopped or cancelled.
    """

    def __init__(self, pace: float = 1.0, held: str = "") -> None:
        self.pace, self.held = pace, held
        self.stopped = ""
        self.heard = monotonic()
        self.on_stop: Callable[[str], None] = lambda _why: None
        self._cancelled = False
        self._advances = 0
        self._disturbs: list[Disturb] = []
        self._changed = Condition()

    def take(self, signal: Signal) -> None:
        """Take a signal of the server."""
        with self._changed:
            self.heard = monotonic()
            self._cancelled |= signal.cancel
            self.stopped = self.stopped or signal.stop
            self.held = signal.hold or ("" if signal.go else self.held)
            self._advances += signal.advance
            if signal.pace is not None:
                self.pace = signal.pace
                self._advances = 0
            if signal.disturb is not None:
                self._disturbs.append(signal.disturb)
            self._changed.notify_all()
        if signal.cancel or signal.stop:
            self.on_stop(signal.stop or "cancelled")

    def check(self) -> None:
        """Raise Cancelled if the job is cancelled."""
        if self._cancelled:
            raise Cancelled

    def wait(self, seconds: float | None) -> None:
        """Wait for a signal, at most this time."""
        with self._changed:
            if not (self._cancelled or self.stopped or self._advances or self._disturbs):
                self._changed.wait(seconds)

    def advance(self) -> bool:
        """Whether a single period was asked for; it is used up."""
        with self._changed:
            if self._advances == 0:
                return False
            self._advances -= 1
            return True

    def disturbs(self) -> list[Disturb]:
        """Disturbances since the last call."""
        with self._changed:
            taken, self._disturbs = self._disturbs, []
            return taken
