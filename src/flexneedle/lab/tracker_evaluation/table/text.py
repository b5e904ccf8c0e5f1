"""The layout of a CSV file, from its first line, and the message on a row that DuckDB rejected."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from duckdb import DuckDBPyConnection

from flexneedle.errors import InputError

_DELIMITERS = ",;\t"
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_NOT_A_NUMBER = re.compile(r'Could not convert string "(.*)" to', re.DOTALL)
_FOUND = re.compile(r"Found: (\d+)")
_FIRST_LINE = 1 << 20  # bytes; the longest header
_SHOWN = 60  # characters shown of a line or field
_FIRST_REJECTED = """
    SELECT line, column_idx, error_type, csv_line, error_message FROM reject_errors
    ORDER BY line, column_idx LIMIT 1
"""


@dataclass(frozen=True)
class Layout:
    """Column names and delimiter of a CSV file."""

    header: list[str]
    delimiter: str


def read_layout(path: Path) -> Layout:
    """Return the layout of a CSV file. Raises InputError if there is no header or no row."""
    with path.open("rb") as file:
        first = file.readline(_FIRST_LINE)
        more = file.read(1)
    text = first.decode("utf-8-sig", errors="replace").rstrip("\r\n")
    if (not first.endswith(b"\n") and len(first) == _FIRST_LINE) or "\0" in text:
        raise InputError("is neither CSV nor Parquet")
    if not text.strip():
        raise InputError("the first line must contain the column names")
    if not more:
        raise InputError(f"has no rows, only the header {text[:_SHOWN]!r}")
    delimiter = max(_DELIMITERS, key=text.count)
    return Layout([name.strip() for name in next(csv.reader([text], delimiter=delimiter))], delimiter)


def refuse_rejected(connection: DuckDBPyConnection, layout: Layout, chosen: Mapping[str, str]) -> None:
    """Raise InputError for the first row that DuckDB rejected. chosen: names in the header by column."""
    rejected = connection.execute(_FIRST_REJECTED).fetchone()
    if rejected is None:
        return
    line, column, kind, text, message = rejected
    if value := _NOT_A_NUMBER.search(message):
        reason = _not_a_number(layout.header[column - 1], value[1], chosen)
    elif found := _FOUND.search(message):
        shown = text.strip()[:_SHOWN]
        reason = f"has {found[1]} fields, the header has {len(layout.header)}: {shown!r}"
    else:
        reason = f"{kind.lower()}: {text.strip()[:_SHOWN]!r}"
    raise InputError(f"row {line - 1}: {reason}")


def _not_a_number(header: str, value: str, chosen: Mapping[str, str]) -> str:
    column = next((column for column, other in chosen.items() if other == header), header)
    name = column if column == header else f"{header!r} (for {column})"
    remedy = ": use a decimal point, not a comma" if _DECIMAL_COMMA.fullmatch(value) else ""
    return f"{name}: {value[:_SHOWN]!r} is not a number{remedy}"
