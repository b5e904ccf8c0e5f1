"""Records between the processes of an emulated rig, over pipes: fixed lengths, never a wait.

A record has a time (s, monotonic clock), numbers, and whether what they describe moves from then on. While it does, it
is known up to the time of the newest record; at rest it stays as it is until the next one.
"""

import os
import struct
from collections.abc import Sequence
from typing import NamedTuple

from flexneedle.errors import RunError


class Record(NamedTuple):
    """Time (s), numbers, and whether they change from then on."""

    time: float
    values: tuple[float, ...]
    moving: bool


class StreamEnded(Exception):
    """The process at the other end has ended."""


def _layout(count: int) -> struct.Struct:
    return struct.Struct(f"<{1 + count}d?")


class Sink:
    """The writing end of a pipe (its descriptor) for records of `count` numbers; to: name of the reader in errors."""

    def __init__(self, descriptor: int, count: int, to: str) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor, self._layout, self._to = descriptor, _layout(count), to

    def write(self, time: float, values: Sequence[float], moving: bool) -> None:
        """Send a record. Raises StreamEnded, and RunError if the reader is thousands of records behind."""
        try:  # in one piece: a record is shorter than PIPE_BUF
            os.write(self._descriptor, self._layout.pack(time, *values, moving))
        except BlockingIOError:
            raise RunError(f"the {self._to} does not keep up") from None
        except BrokenPipeError:
            raise StreamEnded from None


class Source:
    """The reading end of a pipe (its descriptor) for records of `count` numbers."""

    def __init__(self, descriptor: int, count: int) -> None:
        os.set_blocking(descriptor, False)
        self.descriptor, self._layout, self._received = descriptor, _layout(count), b""

    def read(self) -> list[Record]:
        """Return the records that have arrived, oldest first, without waiting. Raises StreamEnded."""
        try:
            data = os.read(self.descriptor, 65_536)
        except BlockingIOError:
            return []
        if not data:
            raise StreamEnded
        self._received += data
        whole = len(self._received) // self._layout.size * self._layout.size
        complete, self._received = self._received[:whole], self._received[whole:]
        unpacked = self._layout.iter_unpack(complete)
        return [Record(time, tuple(values), moving) for time, *values, moving in unpacked]
