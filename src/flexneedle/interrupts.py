"""Blocks that Ctrl-C does not interrupt, such as a block that holds a lock or writes a record.

Python raises KeyboardInterrupt between any two steps of the main thread, also in the standard library. In a condition
of `threading` the lock is then never released, and a thread that needs it waits forever.
"""

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that interrupt a command."""


@contextmanager
def delay_signals() -> Iterator[None]:
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
    """A handler that keeps the first signal of the block; after the block it calls the previous handler."""

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
