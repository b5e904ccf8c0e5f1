"""Plain copies of CSV files whose lines DuckDB alone would refuse or misread.

DuckDB reads a file of regular lines. All other files, and those in which it finds an error, are read here line by
line: the copy has the requested columns, separated by commas, with decimal points; a malformed line is refused.
"""

import csv
import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.lab.tables.layout import BLANKS, COMMENT, SHOWN, CsvLayout, open_text, split_line

EMPTY = ("", "nan", "-nan", "na", "n/a", "#n/a", "<na>", "null", "none", "missing", "-", "--")
"""Spellings of an empty value, in lower case."""

_BLOCK = 1 << 24  # bytes
_GROUPS = re.compile(rb"_(?<=[0-9]_)[0-9]")
_NUMBER = re.compile(
    r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[-+]?\d+)?|[-+]?inf(?:inity)?", re.ASCII | re.IGNORECASE
)
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}", re.ASCII)  # 1,234: perhaps 1234
_COMMENTS = tuple(f"\n{blank}{mark}".encode() for blank in ("", " ") for mark in COMMENT)


def is_regular(path: Path, layout: CsvLayout) -> bool:
    """Return whether each line has the fields of the header, all lines end alike, and none is blank or misread."""
    if layout.separator == BLANKS or not layout.header[-1]:
        return False
    with path.open("rb") as file:
        if b'"' in b"".join(file.readline() for _ in range(layout.skipped)):
            return False
        start = file.tell()
        end = b"\r\n" if file.readline().endswith(b"\r\n") else b"\n"
        file.seek(start)
        line = layout.separator.encode() * (len(layout.header) - 1) + end
        ignored = bytes({*range(256)} - {*line, *b"\r"})
        left, last = b"", b"\n"
        for block in iter(lambda: file.read(_BLOCK), b""):
            left += block.translate(None, ignored)
            count, cut = divmod(len(left), len(line))
            if _is_misread(last + block) or left[: len(left) - cut] != line * count:
                return False
            left, last = left[len(left) - cut :], block[-2:]
    return left in (b"", line.removesuffix(end))


def _is_misread(text: bytes) -> bool:
    """Return whether DuckDB may misread a text: comments, quotes after blanks, +-1 (read as -1), 1_0 (as 10)."""
    return any(part in text for part in (b' "', b"+-", *_COMMENTS)) or _GROUPS.search(text) is not None


def write_copy(
    path: Path, layout: CsvLayout, chosen: Sequence[int], numbers: Sequence[int], copy: Path
) -> "array[int]":
    """Write the chosen columns of a CSV file to a plain one, and return the number of the line of each row.

    numbers: the chosen columns that hold numbers. Raises InputError for the first malformed line.
    """
    lines, marks = array("q"), _DecimalMarks(layout)
    with copy.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(chosen)
        for line, fields in _read_rows(path, layout):
            for k in numbers:
                fields[k] = marks.to_plain(line, k, fields[k])
            row = [fields[k] for k in chosen]
            if "\ufffd" in "".join(row):
                raise InputError(f"line {line}: is not UTF-8: {','.join(row)[:SHOWN]!r}")
            writer.writerow(row)
            lines.append(line)
    marks.check()
    return lines


class _DecimalMarks:
    """Decimal marks of the columns of numbers: a column has points or commas."""

    def __init__(self, layout: CsvLayout) -> None:
        self._names, self._commas = layout.header, layout.separator != ","
        self._found: dict[int, tuple[str, int]] = {}
        self._grouped: dict[int, bool] = {}

    def to_plain(self, line: int, k: int, field: str) -> str:
        """Return a number of column k with a decimal point, or an empty text."""
        if field.lower() in EMPTY:
            return ""
        problem = f"line {line}: {self._names[k]}: {field[:SHOWN]!r}"
        if _NUMBER.fullmatch(field) is None or ("," in field and not self._commas):
            remedy = ": use a decimal point, not a comma" if "," in field else ""
            raise InputError(f"{problem} is not a number{remedy}")
        mark = "," if "," in field else "." if "." in field else ""
        before, first = self._found.setdefault(k, (mark, line)) if mark else ("", 0)
        if mark != before:
            raise InputError(
                f"{problem} has a decimal {mark!r}, line {first} has {before!r}: use points throughout"
            )
        if mark:
            self._grouped[k] = self._grouped.get(k, True) and _GROUPED.fullmatch(field) is not None
        return field.replace(",", ".")

    def check(self) -> None:
        """Raise InputError if marks may separate thousands: three digits after each, other marks in other columns."""
        if len({mark for mark, _ in self._found.values()}) < 2:
            return
        for k in (k for k, grouped in self._grouped.items() if grouped):
            (mark, line), name = self._found[k], self._names[k]
            marks = "commas" if mark == "," else "points"
            raise InputError(
                f"line {line}: {name}: {marks} may be decimal or separate thousands: use decimal points throughout"
            )


def _read_rows(path: Path, layout: CsvLayout) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the fields of each line with a row; a surplus field is empty in all rows, or refused."""
    names = len(layout.header)
    while names > 1 and not layout.header[names - 1]:
        names -= 1
    width = 0
    with open_text(path) as file:
        for line, text in enumerate(file, 1):
            if line <= layout.skipped + 1 or not text.strip(" \n"):
                continue
            fields = _split_row(line, text.strip("\n"), layout.separator)
            if text.lstrip(" ").startswith(COMMENT):
                if len(fields) < names:
                    continue
                raise InputError(
                    f"line {line}: is a comment or a row: delete or quote {text.strip()[:SHOWN]!r}"
                )
            surplus = any(fields[names:])
            width = width or max(len(fields), names)
            if surplus or len(fields) != width:
                raise InputError(f"line {line}: {_describe_width(len(fields), width, surplus, text)}")
            yield line, fields


def _split_row(line: int, text: str, separator: str) -> list[str]:
    try:
        fields = split_line(text.strip(" ") if separator == BLANKS else text, separator)
    except csv.Error as error:
        reason = "a quoted field is not closed" if "end of data" in str(error) else str(error)
        raise InputError(f"line {line}: {reason}: {text[:SHOWN]!r}") from None
    return [field.strip() for field in fields]


def _describe_width(count: int, width: int, surplus: bool, text: str) -> str:
    kind = "more" if surplus or count > width else "fewer"
    remedy = " (decimal commas need semicolons or tabs between the columns)" if kind == "more" else ""
    return f"has {kind} fields than the header{remedy}: {text.strip()[:SHOWN]!r}"
