"""The journal of a study: one line per finished row, append-only, so that it survives any interruption."""

import fcntl
import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flexneedle.errors import InputError
from flexneedle.files import uninterrupted
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.study.rows import TIMES
from flexneedle.trace.results import RESULT_COLUMNS

_KINDS = {name: column.kind for name, column in RESULT_COLUMNS.items()} | TIMES
_LARGEST = {int: 2**63 - 1, float: sys.float_info.max}  # in a column


class Journal:
    """An open journal, locked against other processes; `rows`: finished rows by index.

    Numbers keep all digits. An incomplete last line is dropped; its row is repeated. size: number of rows of the
    study. Raises InputError if another process has the journal open, or if it is damaged. Use as a context manager.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self._path, self._size = path, size
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
        """Add rows; returns once they are on disk."""
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
            raise InputError(f"{self._path.parent}: another process is writing to this study") from None

    def _read(self) -> None:
        self._file.seek(0)
        data = self._file.read()
        whole = data.rfind(b"\n") + 1
        for number, line in enumerate(data[:whole].splitlines(), 1):
            row = _parsed(line)
            fault = _fault(row, self._size)
            if fault is not None:
                raise InputError(f"{self._path}: damaged at line {number}: {fault}")
            self.rows[row["index"]] = row
        self._file.truncate(whole)


def _parsed(line: bytes) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _fault(row: Any, size: int) -> str | None:
    """Return why a value is not a row of a study of this size, or None for a valid row."""
    if not isinstance(row, dict):
        return "not a row in JSON"
    index = row.get("index")
    if not (isinstance(index, int) and _fits(index, int) and 0 <= index < size):
        return to_line(Problem("index", index, f"must be a whole number from 0 to {size - 1}"))
    missing = next((name for name in RESULT_COLUMNS if name not in row), None)
    if missing is not None:
        return f"{missing}: missing"
    wrong = next((name for name, kind in _KINDS.items() if not _fits(row.get(name), kind)), None)
    return None if wrong is None else to_line(Problem(wrong, row[wrong], "wrong type, or too large"))


def _fits(value: Any, kind: type) -> bool:
    """Whether a value fits a column of this kind; numbers may be None."""
    if kind is str:
        return isinstance(value, str)
    if value is None:
        return True
    numbers = (int, float) if kind is float else (int,)
    return isinstance(value, numbers) and not isinstance(value, bool) and abs(value) <= _LARGEST[kind]
