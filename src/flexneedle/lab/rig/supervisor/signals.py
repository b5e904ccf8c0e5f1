"""Signals of client and supervisor: the system writes them into one socket, which the supervisor reads.

So a signal to the client alone also stops the motors, even while that process is busy.
"""

import signal
import socket

from flexneedle.interrupts import SIGNALS, delay_signals


class SignalLine:
    """The client's side: a socket whose two ends the supervisor inherits, so that no process gets EPIPE."""

    def __init__(self) -> None:
        self._received, self._sent = socket.socketpair()
        for end in (self._received, self._sent):
            end.setblocking(False)
        self._before: int | None = None

    @property
    def descriptors(self) -> tuple[int, int]:
        """Of the ends, for `open_signal_socket`."""
        return self._received.fileno(), self._sent.fileno()

    def take(self) -> None:
        """Write each signal of this process that has a Python handler to the socket. Call it in the main thread."""
        with delay_signals():
            self._before = signal.set_wakeup_fd(self._sent.fileno(), warn_on_full_buffer=False)

    def close(self) -> None:
        """Close the socket, and restore the signals. Call it in the thread of `take`."""
        with delay_signals():
            if self._before is not None:
                signal.set_wakeup_fd(self._before)
                self._before = None
            self._received.close()
            self._sent.close()


def open_signal_socket(received: int, sent: int) -> socket.socket:
    """Return the supervisor's side: a socket with a byte for each signal of this process and of its client.

    The client's signals are written once it takes them.
    """
    signal.set_wakeup_fd(sent, warn_on_full_buffer=False)
    for number in SIGNALS:
        signal.signal(number, lambda *_: None)
    return socket.socket(fileno=received)


def name_signals(received: bytes) -> str:
    """Return the names of the received signals that stop the motors, or "": the client may receive others."""
    return ", ".join(number.name for number in SIGNALS if number in received)
