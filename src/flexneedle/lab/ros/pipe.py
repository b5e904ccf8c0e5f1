"""Records over a socket between a rig and its ROS node, in both directions. Nothing here waits.

A record is pickled: both ends are processes of ours, the one started by the other.
"""

import pickle
import socket
import struct
from collections import deque
from threading import Lock
from typing import Any

_LENGTH = struct.Struct("<I")
_MOST_WAITING = 256  # records
_BUFFER = 1 << 20
_CHUNK = 1 << 16


class Pipe:
    """One end of a socket; `send` and `receive` return at once. `ended` is True when the other end is closed."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self.socket, self.ended, self.dropped = end, False, 0
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._begun = b""  # what is left of a record whose first bytes are sent
        self._received = bytearray()
        self._lock = Lock()

    def send(self, record: object, *, keep: bool = True) -> None:
        """Send a record, or queue it where the other end does not read; then the oldest without `keep` is dropped."""
        data = pickle.dumps(record, protocol=pickle.HIGHEST_PROTOCOL)
        with self._lock:
            self._waiting.append((_LENGTH.pack(len(data)) + data, keep))
            self._pump()
            if len(self._waiting) > _MOST_WAITING:
                self._drop()

    def flush(self) -> None:
        """Send what is queued, as far as the other end takes it."""
        with self._lock:
            self._pump()

    def receive(self) -> list[Any]:
        """The records that have arrived, oldest first; what is beyond 1 MB waits for the next call."""
        try:
            while len(self._received) < _BUFFER:
                data = self.socket.recv(_CHUNK)
                self._received += data
                if not data:
                    self.ended = True
                    break
        except BlockingIOError:
            pass
        except OSError:  # the other end was killed
            self.ended = True
        return list(self._records())

    @property
    def waiting(self) -> int:
        """Records that are queued."""
        return len(self._waiting)

    def close(self) -> None:
        """Close this end."""
        self.socket.close()

    def _records(self) -> Any:
        begun, have = 0, len(self._received)
        while have - begun >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._received, begun)
            end = begun + _LENGTH.size + length
            if end > have:
                break
            yield pickle.loads(self._received[begun + _LENGTH.size : end])
            begun = end
        del self._received[:begun]

    def _pump(self) -> None:
        while self._begun or self._waiting:
            if not self._begun:
                self._begun, _ = self._waiting.popleft()
            try:
                self._begun = self._begun[self.socket.send(self._begun) :]
            except BlockingIOError:
                return
            except OSError:  # the other end is closed: nobody reads what is left
                self._begun = b""
                self._waiting.clear()
                self.ended = True

    def _drop(self) -> None:
        """Drop the oldest record that need not be kept, or the oldest of all."""
        index = next((i for i, (_, keep) in enumerate(self._waiting) if not keep), 0)
        del self._waiting[index]
        self.dropped += 1
