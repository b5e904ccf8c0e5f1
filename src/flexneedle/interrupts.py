"""Blocks that Ctrl-C does not interrupt: between a lock's taking and its release, or in the middle of a record.

Python raises KeyboardInterrupt between any two steps of the main thread, also of the standard library: in a condition
of `threading`, its lock is then never released, and a thread that needs it waits without end.
"""

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""That may interrupt a command."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay the handlers of `SIGNALS` until the end of the block. Blocks may be nested."""
    if current_thread() is not main_thread():
        yield  # no KeyboardInterrupt can arise here
        return
    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    delayed = _Delayed(before)
    try:
        for number in before:
            signal.signal(number, delayed)
        yield
    finally:
        delayed.over = True
        for number, handler in before.items():
            signal.signal(number, handler)
        if delayed.pending is not None:
            before[delayed.pending[0]](*delayed.pending)


class _Delayed:
    """A handler that keeps the first signal until the block is over; from then on it acts as those before."""

    def __init__(self, before: Mapping[signal.Signals, Callable[[int, FrameType | None], Any]]) -> None:
        self._before = before
        self.over = False
        self.pending: tuple[signal.Signals, FrameType | None] | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        received = signal.Signals(number)
        if self.over:
            self._before[received](number, frame)
        elif self.pending is None:
            self.pending = received, frame
