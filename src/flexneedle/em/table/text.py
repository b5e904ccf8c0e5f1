"""How a CSV file is laid out, by its first line, and which row DuckDB rejected."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from duckdb import DuckDBPyConnection

from flexneedle.errors import InputError

_DELIMITERS = ",;\t"
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_NO_NUMBER = re.compile(r'Could not convert string "(.*)" to', re.DOTALL)
_FOUND = re.compile(r"Found: (\d+)")
_FIRST_LINE = 1 << 20  # bytes; more is no header
_SHOWN = 60  # characters of a line or a field
_FIRST_REJECTED = """
    SELECT line, column_idx, error_type, csv_line, error_message FROM reject_errors
    ORDER BY line, column_idx LIMIT 1
"""


@dataclass(frozen=True)
class Layout:
    """Names of the columns of a CSV file, and the character between them."""

    header: list[str]
    delimiter: str


def read_layout(path: Path) -> Layout:
    """Return the layout of a CSV file. Raises InputError if there is no header or nothing below it."""
    with path.open("rb") as file:
        first = file.readline(_FIRST_LINE)
        more = file.read(1)
    text = first.decode("utf-8-sig", errors="replace").rstrip("\r\n")
    if (not first.endswith(b"\n") and len(first) == _FIRST_LINE) or "\0" in text:
        raise InputError("neither CSV nor Parquet")
    if not text.strip():
        raise InputError("the first line must name the columns")
    if not more:
        raise InputError(f"has no rows, only one line: {text[:_SHOWN]!r}")
    delimiter = max(_DELIMITERS, key=text.count)
    return Layout([name.strip() for name in next(csv.reader([text], delimiter=delimiter))], delimiter)


def refuse_rejected(connection: DuckDBPyConnection, layout: Layout, chosen: Mapping[str, str]) -> None:
    """Raise InputError for the first row that DuckDB could not read; `chosen`: names in the file by ours."""
    rejected = connection.execute(_FIRST_REJECTED).fetchone()
    if rejected is None:
        return
    line, column, kind, text, message = rejected
    if value := _NO_NUMBER.search(message):
        reason = _no_number(layout.header[column - 1], value[1], chosen)
    elif found := _FOUND.search(message):
        shown = text.strip()[:_SHOWN]
        reason = f"has {found[1]} fields, the header has {len(layout.header)}: {shown!r}"
    else:
        reason = f"{kind.lower()}: {text.strip()[:_SHOWN]!r}"
    raise InputError(f"row {line - 1}: {reason}")


def _no_number(their: str, value: str, chosen: Mapping[str, str]) -> str:
    our = next((our for our, other in chosen.items() if other == their), their)
    name = our if our == their else f"{their!r} (for {our})"
    advice = ": write a decimal point, not a comma" if _DECIMAL_COMMA.fullmatch(value) else ""
    return f"{name}: {value[:_SHOWN]!r} is no number{advice}"
