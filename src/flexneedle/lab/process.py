"""Child processes of the laboratory: start them, exchange messages with them, end them.

The parent starts a module as a `ChildProcess`, and the child opens the other end of the channel with `open_channel`.
Either process notices the death of the other as the end of the channel.
"""

import os
import pickle
import select
import socket
import struct
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from threading import Lock
from time import monotonic
from typing import IO, Any

from flexneedle.interrupts import delay_signals

_LENGTH = struct.Struct("<I")
_BUFFER = 1 << 20  # bytes
_CHUNK = 1 << 16
_STDERR = 2  # its descriptor: sys.stderr may be another object, without one
_LONGEST_LINE = 4096  # bytes of the last printed line


class MessageChannel:
    """One end of a socket pair for messages in both directions. No call waits, unless it has a time to wait.

    `ended` is True once the other end is closed and everything received before has been returned. `dropped` counts the
    messages that were not sent because the other end did not read. Several threads may send, one may receive.
    """

    def __init__(
        self,
        end: socket.socket,
        *,
        most_waiting: int = 256,
        longest: int = (1 << 32) - 1,
        encode: Callable[[Any], bytes] = pickle.dumps,
        decode: Callable[[bytes], Any] = pickle.loads,
    ) -> None:
        """Take over a socket.

        Args:
            end: End of a pair of stream sockets.
            most_waiting: Number of queued messages above which the oldest is dropped.
            longest: Largest number of bytes of a received message.
            encode: Function from a message to its bytes (default: pickle, for processes that trust each other).
            decode: Function from bytes to a message.
        """
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._socket, self._encode, self._decode = end, encode, decode
        self._most_waiting, self._longest = most_waiting, longest
        self.ended, self.dropped = False, 0
        self._broken = False  # nothing can be sent any more
        self._invalid: ValueError | None = None  # nothing can be received any more
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._begun = b""  # rest of a message whose first bytes have been sent
        self._received = bytearray()
        self._lock = Lock()

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    @property
    def waiting(self) -> int:
        """Number of queued messages."""
        return len(self._waiting)

    def send(self, message: object, *, keep: bool = True) -> bool:
        """Send a message, or queue it while the other end does not read; return False if the other end is closed.

        A queue that is full loses its oldest message without `keep`.
        """
        data = self._encode(message)
        with delay_signals(), self._lock:
            self._waiting.append((_LENGTH.pack(len(data)) + data, keep))
            self._pump()
            if len(self._waiting) > self._most_waiting:
                self._drop_oldest()
            return not self._broken

    def flush(self, seconds: float = 0.0) -> None:
        """Send queued messages; wait at most `seconds` for the other end to read them."""
        until = monotonic() + seconds
        while True:
            with delay_signals(), self._lock:
                self._pump()
                left = bool(self._begun or self._waiting)
            if not left or (remaining := until - monotonic()) <= 0.0:
                return
            select.select([], [self._socket], [], remaining)

    def receive(self, seconds: float | None = 0.0) -> list[Any]:
        """Return the messages that have arrived, oldest first; wait at most `seconds` for the first (None: any time).

        Raises ValueError after the last message before one that is too long or cannot be decoded.
        """
        if self._invalid is None and not self.ended and select.select([self._socket], [], [], seconds)[0]:
            self._read(_BUFFER)
        messages = list(self._complete())
        if self._invalid is not None and not messages:
            raise self._invalid
        return messages

    def receive_first(self) -> Any:
        """Wait for one message and return it; later messages remain. Raises EOFError if the other end is closed."""
        while missing := self._missing():
            if self.ended:
                raise EOFError
            select.select([self._socket], [], [])
            self._read(missing)
        return self._take_first()

    def end_sending(self) -> None:
        """Let the other end find the channel closed; messages can still be received."""
        try:
            self._socket.shutdown(socket.SHUT_WR)
        except OSError:  # it is closed already
            self._broken = True

    def close(self) -> None:
        """Close this end."""
        self._socket.close()

    def _read(self, most: int) -> None:
        """Read what has arrived, at most this number of bytes."""
        until = len(self._received) + most
        try:
            while (left := until - len(self._received)) > 0:
                data = self._socket.recv(min(left, _CHUNK))
                self._received += data
                if not data:
                    self.ended = True
                    return
        except BlockingIOError:
            return
        except OSError:  # the other process was killed
            self.ended = True

    def _missing(self) -> int:
        """Return the number of bytes to the end of the first message, or of its length."""
        have = len(self._received)
        if have < _LENGTH.size:
            return _LENGTH.size - have
        length = int(_LENGTH.unpack_from(self._received)[0])
        if length > self._longest:
            raise ValueError(f"a message of {length} bytes: must have at most {self._longest}")
        return max(0, _LENGTH.size + length - have)

    def _complete(self) -> Iterator[Any]:
        """Take the complete messages, up to one that is invalid."""
        try:
            while self._invalid is None and not self._missing():
                yield self._take_first()
        except ValueError as error:
            self._invalid = error

    def _take_first(self) -> Any:
        end = _LENGTH.size + int(_LENGTH.unpack_from(self._received)[0])
        data = bytes(self._received[_LENGTH.size : end])
        del self._received[:end]
        return self._decode(data)

    def _pump(self) -> None:
        while self._begun or self._waiting:
            if not self._begun:
                self._begun, _ = self._waiting.popleft()
            try:
                self._begun = self._begun[self._socket.send(self._begun) :]
            except BlockingIOError:
                return
            except OSError:  # the other end is closed, and nobody reads the rest
                self._begun, self._broken = b"", True
                self._waiting.clear()

    def _drop_oldest(self) -> None:
        """Drop the oldest message that need not be kept, or else the oldest of all."""
        index = next((i for i, (_, keep) in enumerate(self._waiting) if not keep), 0)
        del self._waiting[index]
        self.dropped += 1


class ChildProcess:
    """A Python module in a separate process, with a channel to it. The process and the channel are open at first.

    `python -m MODULE CHANNEL [DESCRIPTOR…] [ARGUMENT…]` is its command, with descriptors as numbers.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        descriptors: tuple[int, ...] = (),
        own_session: bool = True,
        keep_printed: bool = False,
        channel: Callable[[socket.socket], MessageChannel] = MessageChannel,
    ) -> None:
        """Start the process.

        Args:
            module: Name of the module.
            *arguments: Further arguments of the command.
            descriptors: Open descriptors that the child inherits.
            own_session: Keep Ctrl-C on the terminal from the child, so that only this process gets it.
            keep_printed: Keep what the child prints for `last_line`, instead of printing it on stderr.
            channel: Function that makes this end of the channel from a socket.
        """
        self._printed: IO[bytes] | None = tempfile.TemporaryFile() if keep_printed else None  # noqa: SIM115  closed with the channel
        ours, theirs = socket.socketpair()
        with theirs:
            passed = (theirs.fileno(), *descriptors)
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, passed), *arguments],
                pass_fds=passed,
                stdin=subprocess.DEVNULL,
                # A device's module may print, and must not print into what a command prints, such as JSON.
                stdout=self._printed or _STDERR,
                stderr=self._printed,
                start_new_session=own_session,
            )
        self.channel = channel(ours)

    @property
    def pid(self) -> int:
        """Identifier of the process."""
        return self._process.pid

    def wait(self, seconds: float | None = None) -> int | None:
        """Return the exit code of the process; None if it has not ended within `seconds` (None: wait any time)."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def end(self, seconds: float, *, terminate: bool = False) -> int:
        """End the process and return its exit code: the channel ends, and after `seconds` the process is killed.

        terminate: send SIGTERM, too.
        """
        self.channel.end_sending()
        if terminate:
            self._process.terminate()
        code = self.wait(seconds)
        if code is None:
            self._process.kill()
            code = self._process.wait()
        return code

    def last_line(self) -> str:
        """Return the last line that the process has printed, "" without one or without `keep_printed`."""
        if self._printed is None:
            return ""
        self._printed.seek(max(0, self._printed.seek(0, os.SEEK_END) - _LONGEST_LINE))
        lines = self._printed.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def close(self) -> None:
        """Close the channel of a process that has ended."""
        self.channel.close()
        if self._printed is not None:
            self._printed.close()


def run_module(
    module: str, *arguments: str, niceness: int, seconds: float
) -> subprocess.CompletedProcess[bytes] | None:
    """Run a Python module to its end in a separate process; return exit code and output, None if it lasts longer.

    niceness: added to the niceness of this process; seconds: time after which the process is killed.
    """
    try:
        return subprocess.run(
            ["nice", "-n", str(niceness), sys.executable, "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=seconds,
            start_new_session=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None


def open_channel(descriptor: int, **settings: Any) -> MessageChannel:
    """Open the child's end of the channel, the first descriptor of its command."""
    return MessageChannel(socket.socket(fileno=descriptor), **settings)
