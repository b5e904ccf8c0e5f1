"""The journal of a study: finished rows, a line each, added and never changed; it outlives any way to end."""

import fcntl
import json
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flexneedle.errors import InputError
from flexneedle.trace.shield import uninterrupted

__all__ = ["Journal"]


class Journal:
    """An open journal, which no other process can open; `rows` are the finished ones by index.

    Numbers come back with all their digits. A last line that was torn is dropped: its row is done again.
    Raises InputError if another process writes it, or if it is damaged. Use it as a context.
    """

    def __init__(self, path: Path) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self._path = path
        self._file = path.open("a+b")
        try:
            self._lock()
            self._read()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trail: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Add rows, and return when they are on the disk."""
        added = list(rows)
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in added)
        with uninterrupted():
            self._file.write(text.encode())
            self._file.flush()
            os.fsync(self._file.fileno())
            self.rows |= {row["index"]: row for row in added}

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{self._path.parent}: another process is at work on this study") from None

    def _read(self) -> None:
        self._file.seek(0)
        data = self._file.read()
        whole = data.rfind(b"\n") + 1
        for number, line in enumerate(data[:whole].splitlines(), 1):
            try:
                row = json.loads(line)
                self.rows[row["index"]] = row
            except (ValueError, TypeError, KeyError):
                raise InputError(f"{self._path}: damaged at line {number}") from None
        self._file.truncate(whole)
