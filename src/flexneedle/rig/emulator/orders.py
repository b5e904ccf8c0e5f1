"""Where the emulated tip is told to rest: lines `X Y Z` on a stream, in mm in the tracker's frame."""

import os
from collections.abc import Container
from math import isfinite

from flexneedle.errors import InputError
from flexneedle.types import Point

_FARTHEST_MM = 1000.0
_LONGEST_LINE = 4096


class Orders:
    """Lines of a stream (its descriptor, or None for none), taken as they come until it ends.

    A terminal is read in its foreground alone: a process in the background that reads there is stopped.
    """

    def __init__(self, source: int | None) -> None:
        self._source, self._heard = source, b""

    @property
    def sources(self) -> list[int]:
        """What to wait for: the descriptor, or nothing."""
        return [] if self._source is None or _in_background(self._source) else [self._source]

    def read(self, ready: Container[int]) -> list[str]:
        """Return the lines that are whole now; ready: descriptors that something can be read from."""
        if self._source is None or self._source not in ready:
            return []
        try:
            data = os.read(self._source, _LONGEST_LINE)
        except OSError:  # such as one that nohup opened for writing alone
            data = b""
        if not data:
            self._source = None
        *lines, self._heard = (self._heard + data)[-_LONGEST_LINE:].split(b"\n")
        return [line.decode("utf-8", "replace") for line in lines if line.strip()]


def _in_background(source: int) -> bool:
    try:
        return os.isatty(source) and os.tcgetpgrp(source) != os.getpgrp()
    except OSError:  # a terminal that does not control this process, and stops nobody
        return False


def parse_place(line: str) -> Point:
    """Return the place (mm) in a line. Raises InputError."""
    try:
        x, y, z = map(float, line.split())
    except ValueError:
        raise InputError(
            f"{line.strip()!r}: must be three numbers X Y Z, in mm in the tracker's frame"
        ) from None
    if not all(isfinite(part) and abs(part) <= _FARTHEST_MM for part in (x, y, z)):
        raise InputError(f"{line.strip()!r}: must be within {_FARTHEST_MM:g} mm of the field generator")
    return x, y, z
