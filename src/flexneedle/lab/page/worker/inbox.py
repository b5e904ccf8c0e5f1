"""The orders of the server, read by a thread."""

import json
from queue import SimpleQueue
from threading import Thread
from typing import BinaryIO

from flexneedle.lab.page import channel
from flexneedle.lab.page.orders import Signal, Work
from flexneedle.lab.page.worker.signals import Signals

Order = tuple[Work, Signals]


class Inbox:
    """Works in order, each with its signals. When the pipe ends everything is stopped, and there is no more work."""

    def __init__(self, pipe: BinaryIO) -> None:
        self._pipe = pipe
        self._orders: SimpleQueue[Order | None] = SimpleQueue()
        self._open: dict[int, Signals] = {}
        Thread(target=self._run, name="inbox", daemon=True).start()

    def next(self) -> Order | None:
        """Wait for work; None when there will be no more."""
        return self._orders.get()

    def done(self, work: Work) -> None:
        """Forget the signals of a job that has ended."""
        self._open.pop(work.job, None)

    def _run(self) -> None:
        try:
            while (message := channel.read(self._pipe)) is not None:
                self._take(json.loads(message))
        finally:
            for job, signals in list(self._open.items()):
                signals.take(Signal(job=job, cancel=True, stop="the server of the page has ended"))
            self._orders.put(None)

    def _take(self, values: dict[str, object]) -> None:
        if "do" in values:
            work = Work.model_validate(values)
            signals = self._open[work.job] = Signals(
                pace=0.0 if work.paused else 1.0, held="not armed" if work.rig else ""
            )
            self._orders.put((work, signals))
            return
        signal = Signal.model_validate(values)
        if signal.job in self._open:
            self._open[signal.job].take(signal)
