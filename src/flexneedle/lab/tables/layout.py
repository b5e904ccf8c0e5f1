"""Layout of a CSV file: encoding, separator, decimal mark, column names, and the lines before them."""

import csv
import re
from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

from flexneedle.errors import InputError

SHOWN = 60
"""Number of characters of a line or field in a message."""
BLANKS = " "
"""The separator of a file with blanks between the columns, any number of them."""
_SEPARATORS = ",;\t|"
_SEPARATOR_LINE = re.compile(r'"?sep=([,;\t|])"?', re.IGNORECASE)  # written by Excel
COMMENT = ("#", "%", "//")
"""Starts of lines that are comments."""
_MARKS = "".join(COMMENT) + " "
_OTHER_KINDS = {
    b"\x1f\x8b": "is compressed with gzip: unpack it",
    b"PK\x03\x04": "is an Excel or ZIP file: save it as CSV",
    b"\xd0\xcf\x11\xe0": "is an Excel file: save it as CSV",
}
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_DECIMAL = re.compile(r"\s*[-+]?\d*([.,])\d+(?:[eE][-+]?\d+)?\s*")
_LONGEST_LINE = 1 << 20  # characters
_FIRST_LINES = 1000  # searched for the decimal mark


@dataclass(frozen=True)
class CsvLayout:
    """Layout of a CSV file. skipped: number of lines before the one with the column names."""

    header: tuple[str, ...]
    separator: str
    skipped: int


def open_text(path: Path) -> TextIO:
    """Open a CSV file in UTF-8, or in UTF-16 with a byte order mark; all kinds of line ends are read as LF."""
    with path.open("rb") as file:
        wide = file.read(2) in _UTF_16
    return path.open(encoding="utf-16" if wide else "utf-8-sig", errors="replace")


def find_layout(path: Path, names: Collection[str]) -> CsvLayout:
    """Return the layout of a CSV file whose header is the first line with most of these names, also a comment.

    Without a name in any line, the layout of `read_layout`. Raises InputError if there are no column names or no row.
    """
    found, most = read_layout(path), 0
    with open_text(path) as file:
        for number, line in enumerate(islice(file, _FIRST_LINES)):
            for text in dict.fromkeys((line.strip(" \n").lstrip(_MARKS), line.strip(" \n"))):
                separator = _find_separator(text)
                header = tuple(name.strip() for name in _split_loosely(text, separator))
                count = len({*names} & {*header})
                if count > most:
                    found, most = CsvLayout(header, separator, number), count
                if most == len({*names}):
                    return found
    return found


def read_layout(path: Path) -> CsvLayout:
    """Return the layout of a CSV file; lines before the header may be blank, comments (#, %, //) or `sep=;`.

    Raises InputError if there are no column names or no row.
    """
    with path.open("rb") as binary:
        start = binary.read(4)
    for kind, problem in _OTHER_KINDS.items():
        if start.startswith(kind):
            raise InputError(problem)
    separator, skipped = "", 0
    with open_text(path) as file:
        for line in iter(lambda: file.readline(_LONGEST_LINE), ""):
            text = _check_line(line).strip(" \n")
            found = _SEPARATOR_LINE.fullmatch(text)
            separator = found[1] if found else separator
            if text and not found and not text.startswith(COMMENT):
                break
            skipped += 1
        else:
            raise InputError("has no line with column names")
        if not file.read(1):
            raise InputError(f"has no rows, only the header {text[:SHOWN]!r}")
    separator = separator or _find_separator(text)
    return CsvLayout(tuple(name.strip() for name in _split_loosely(text, separator)), separator, skipped)


def has_decimal_commas(path: Path, layout: CsvLayout, columns: Container[str]) -> bool:
    """Return whether the first number with a decimal mark in these columns has a comma.

    Only files with semicolons, tabs, bars or blanks between the columns can have decimal commas.
    """
    if layout.separator == ",":
        return False
    chosen = [number for number, name in enumerate(layout.header) if name in columns]
    with open_text(path) as file:
        rows = csv.reader(islice(file, layout.skipped + 1, _FIRST_LINES), delimiter=layout.separator)
        fields = (row[number] for row in rows for number in chosen if number < len(row))
        marks = (found[1] for field in fields if (found := _DECIMAL.fullmatch(field)))
        return next(marks, ".") == ","


def split_line(text: str, separator: str) -> Sequence[str]:
    """Return the fields of a line, which may be quoted, also after blanks. Raises csv.Error."""
    return next(csv.reader([text], delimiter=separator, skipinitialspace=True, strict=True), [])


def _find_separator(text: str) -> str:
    best = max(_SEPARATORS, key=lambda each: len(_split_loosely(text, each)))
    return best if len(_split_loosely(text, best)) > 1 else BLANKS


def _split_loosely(text: str, separator: str) -> Sequence[str]:
    return next(csv.reader([text], delimiter=separator, skipinitialspace=True), [])


def _check_line(line: str) -> str:
    if "\0" in line or (len(line) == _LONGEST_LINE and not line.endswith("\n")):
        raise InputError("is neither CSV nor Parquet")
    return line
