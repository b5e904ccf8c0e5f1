"""Orders to an emulator: positions at which the tip rests, as lines `X Y Z` in mm in the tracker's frame."""

import os
from collections.abc import Container, Sequence
from math import isfinite
from typing import Protocol

from flexneedle.errors import InputError
from flexneedle.types import Point

_FARTHEST_MM = 1000.0
_LONGEST_LINE = 4096


class OrderSource(Protocol):
    """Source of orders, one line each."""

    @property
    def sources(self) -> Sequence[int]:
        """Descriptors to wait for."""

    def read(self, ready: Container[int]) -> list[str]:
        """Return the orders received; ready: descriptors with data to read."""


class Orders:
    """Lines of a stream (its descriptor, None: no stream), read as they arrive until it ends.

    A terminal is read only in the foreground: a background process that reads it would be stopped.
    """

    def __init__(self, source: int | None) -> None:
        self._source, self._received = source, b""

    @property
    def sources(self) -> list[int]:
        """The descriptor to wait for, or none."""
        return [] if self._source is None or _in_background(self._source) else [self._source]

    def read(self, ready: Container[int]) -> list[str]:
        """Return the complete lines received; ready: descriptors with data to read."""
        if self._source is None or self._source not in ready:
            return []
        try:
            data = os.read(self._source, _LONGEST_LINE)
        except OSError:  # such as one opened by nohup for writing only
            data = b""
        if not data:
            self._source = None
        *lines, self._received = (self._received + data)[-_LONGEST_LINE:].split(b"\n")
        return [line.decode("utf-8", "replace") for line in lines if line.strip()]


def _in_background(source: int) -> bool:
    try:
        return os.isatty(source) and os.tcgetpgrp(source) != os.getpgrp()
    except OSError:  # not the controlling terminal: reading it does not stop the process
        return False


def parse_position(line: str) -> Point:
    """Return the position (mm) in a line. Raises InputError."""
    try:
        x, y, z = map(float, line.split())
    except ValueError:
        raise InputError(
            f"{line.strip()!r}: must be three numbers X Y Z, in mm in the tracker's frame"
        ) from None
    if not all(isfinite(part) and abs(part) <= _FARTHEST_MM for part in (x, y, z)):
        raise InputError(f"{line.strip()!r}: must be within {_FARTHEST_MM:g} mm of the field generator")
    return x, y, z
