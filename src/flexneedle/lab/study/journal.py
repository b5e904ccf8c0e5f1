"""The journal of a study: one line per finished row, append-only, so that it survives any interruption."""

import fcntl
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flexneedle.errors import InputError
from flexneedle.interrupts import delay_signals
from flexneedle.record.results import RESULT_COLUMNS
from flexneedle.scenario.problems import Problem, to_line

_READ = ("true_error_mm", "outcome", "reason")
"""Columns that every reader of rows needs; rows of another version may lack others."""


class StudyJournal:
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
        with delay_signals():
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
        self.rows = _parse_rows(data, self._path, self._size, tuple(RESULT_COLUMNS))
        self._file.truncate(_complete_length(data))


def read_rows(path: Path, size: int) -> dict[int, dict[str, Any]]:
    """Return the rows of a journal by index, also while a study writes to it. size: number of rows of the study.

    Raises InputError if it cannot be read or is damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return _parse_rows(data, path, size, _READ)


def _parse_rows(data: bytes, path: Path, size: int, needed: Sequence[str]) -> dict[int, dict[str, Any]]:
    """Return the rows of the complete lines of a journal."""
    rows = {}
    for number, line in enumerate(data[: _complete_length(data)].splitlines(), 1):
        row = _parse_line(line)
        fault = _find_fault(row, size, needed)
        if fault is not None:
            raise InputError(f"{path}: damaged at line {number}: {fault}")
        rows[row["index"]] = row
    return rows


def _complete_length(data: bytes) -> int:
    """Return the length of the complete lines."""
    return data.rfind(b"\n") + 1


def _parse_line(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None


def _find_fault(row: Any, size: int, needed: Sequence[str]) -> str | None:
    """Return why a value is not a row with the needed columns of a study of this size, or None for a valid row."""
    if not isinstance(row, dict):
        return "not a row in JSON"
    index = row.get("index")
    if type(index) is not int or not 0 <= index < size:
        return to_line(Problem("index", index, f"must be a whole number from 0 to {size - 1}"))
    missing = next((name for name in needed if name not in row), None)
    return None if missing is None else f"{missing}: missing"
