"""Layout of a CSV file: separator, decimal mark, column names, and the lines before them."""

import csv
import re
from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from flexneedle.errors import InputError

SHOWN = 60
"""Number of characters of a line or field in a message."""
_SEPARATORS = ",;\t"
_SEPARATOR_LINE = re.compile(r"sep=([,;\t])")  # written by Excel
_DECIMAL = re.compile(r"\s*[-+]?\d*([.,])\d+(?:[eE][-+]?\d+)?\s*")
_LONGEST_LINE = 1 << 20  # bytes
_FIRST_LINES = 1000  # searched for the decimal mark


@dataclass(frozen=True)
class CsvLayout:
    """Layout of a CSV file. skipped: number of lines before the one with the column names."""

    header: tuple[str, ...]
    separator: str
    skipped: int


def read_layout(path: Path) -> CsvLayout:
    """Return the layout of a CSV file; lines before the header may be blank, comments (#) or `sep=;`.

    Raises InputError if there are no column names or no row.
    """
    separator, skipped = "", 0
    with path.open("rb") as file:
        for line in iter(lambda: file.readline(_LONGEST_LINE), b""):
            text = _decode_line(line, first=skipped == 0)
            found = _SEPARATOR_LINE.fullmatch(text)
            separator = found[1] if found else separator
            if text and not found and not text.startswith("#"):
                break
            skipped += 1
        else:
            raise InputError("has no line with column names")
        if not file.read(1):
            raise InputError(f"has no rows, only the header {text[:SHOWN]!r}")
    separator = separator or max(_SEPARATORS, key=lambda each: len(_split_line(text, each)))
    return CsvLayout(tuple(name.strip() for name in _split_line(text, separator)), separator, skipped)


def has_decimal_commas(path: Path, layout: CsvLayout, columns: Container[str]) -> bool:
    """Return whether the first number with a decimal mark in these columns has a comma.

    Only files with semicolons or tabs between the columns can have decimal commas.
    """
    if layout.separator == ",":
        return False
    chosen = [number for number, name in enumerate(layout.header) if name in columns]
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        rows = csv.reader(islice(file, layout.skipped + 1, _FIRST_LINES), delimiter=layout.separator)
        fields = (row[number] for row in rows for number in chosen if number < len(row))
        marks = (found[1] for field in fields if (found := _DECIMAL.fullmatch(field)))
        return next(marks, ".") == ","


def find_line(path: Path, layout: CsvLayout, row: int) -> int:
    """Return the number of the line with a row; rows count from 1, and blank lines are no rows."""
    with path.open("rb") as file:
        rows = (k for k, line in enumerate(file, 1) if k > layout.skipped + 1 and line.rstrip(b"\r\n"))
        return next(islice(rows, row - 1, None))


def _split_line(text: str, separator: str) -> Sequence[str]:
    return next(csv.reader([text], delimiter=separator), [])


def _decode_line(line: bytes, first: bool) -> str:
    text = line.decode("utf-8-sig" if first else "utf-8", errors="replace")
    if "\0" in text or (len(line) == _LONGEST_LINE and not line.endswith(b"\n")):
        raise InputError("is neither CSV nor Parquet")
    return text.strip(" \r\n")
