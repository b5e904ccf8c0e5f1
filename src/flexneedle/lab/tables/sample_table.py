"""A table in a CSV or Parquet file as a DuckDB view.

The first bytes of the file, not its name, decide its format. No rows are held in memory: each query reads the file.
"""

import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError
from flexneedle.lab.tables.columns import choose_columns
from flexneedle.lab.tables.layout import SHOWN, find_line, has_decimal_commas, read_layout

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

TEXT = ("point_id", "sensor", "environment", "status")
"""Columns of text; numbers in them are converted, so that 1 and "1" are the same. All other columns hold numbers."""
EMPTY = ("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none", "missing")
"""Spellings of an empty value, in lower case."""
MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}
Rule = tuple[str, str]
"""An SQL condition that invalid rows of `samples` meet, and the message."""

_MAGIC = b"PAR1"
_THREADS = 4  # at most; each buffers 32 MB of a CSV file
_NOT_NUMERIC = ("VARCHAR", "BOOLEAN", "BLOB", "DATE", "TIME", "STRUCT", "MAP", "UUID")
_EMPTY_FIELDS = ["", "NA", "N/A", "#N/A", "null", "NULL", "None", "missing", "MISSING"]  # and nan
_MOST_REJECTED = 10_000
_REASONS = {
    "MISSING COLUMNS": "has fewer fields than the header",
    "TOO MANY COLUMNS": "has more fields than the header",
}
_FIELD = re.compile('string "(.*)" to', re.DOTALL)
_Choose = Callable[[Sequence[str]], dict[str, str]]
_Opened = tuple[dict[str, str], Callable[[int], str]]


@dataclass(frozen=True)
class SampleTable:
    """An open table. Its view `samples` has the requested columns and a row for each row of the file.

    Text is without surrounding blanks, empty in any of the spellings `EMPTY`. Numbers are DOUBLE with lengths in mm,
    NULL if empty or if the table lacks the column. fields: the requested columns that the table has, with their SQL
    names in the file; find_row: "line 5" of a row.
    """

    connection: "DuckDBPyConnection"
    fields: Mapping[str, str]
    find_row: Callable[[int], str]

    def arrays(self, query: str, **values: Any) -> dict[str, NDArray[Any]]:
        """Return the columns (r,) of the result of a query, with NaN for NULL.

        Raises InputError for the first row of the file that is no CSV, or has text in a column of numbers.
        """
        found = self.connection.execute(query, values or None).fetchnumpy()
        self._refuse_rejected()
        return {name: _fill(column) for name, column in found.items()}

    def refuse(self, rules: Sequence[Rule], chosen: str = "true", **values: Any) -> None:
        """Raise InputError for the first row that meets `chosen` and violates a rule."""
        query = f"""
            SELECT row, rule FROM (
                SELECT row_number() OVER () AS row, {first_violation(rules)} AS rule, {chosen} AS chosen FROM samples
            ) WHERE rule IS NOT NULL AND chosen ORDER BY row LIMIT 1
        """
        found = self.arrays(query, **values)
        for row, rule in zip(found["row"], found["rule"], strict=True):
            raise InputError(f"{self.find_row(int(row))}: {rules[int(rule)][1]}")

    def _refuse_rejected(self) -> None:
        """Raise InputError for the first row that DuckDB rejected."""
        tables = "SELECT table_name FROM duckdb_tables() WHERE table_name = 'reject_errors'"
        if self.connection.execute(tables).fetchone() is None:
            return
        query = "SELECT line, error_type, column_name, csv_line, error_message FROM reject_errors ORDER BY line LIMIT 1"
        rejected = self.connection.execute(query).fetchone()
        if rejected is not None:
            line, kind, field, text, message = rejected
            reason = f"{_REASONS.get(kind, kind.lower())}: {text.strip()[:SHOWN]!r}"
            if kind == "CAST":
                reason = _explain_field(next(c for c, f in self.fields.items() if f == field), message)
            raise InputError(f"line {line}: {reason}")


def first_violation(rules: Sequence[Rule]) -> str:
    """Return the SQL for the index of the first rule that a row violates, else NULL."""
    cases = " ".join(f"WHEN {condition} THEN {number}" for number, (condition, _) in enumerate(rules))
    return f"CASE {cases} END" if cases else "NULL"


@contextmanager
def open_table(
    path: Path,
    required: Iterable[str],
    optional: Iterable[str],
    *,
    mapping: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    unit: str = "mm",
) -> Iterator[SampleTable]:
    """Open a table with the extra `em`.

    mapping: see `map_columns`; labels: value for all rows by column, for columns that the table lacks.
    Raises InputError if the file cannot be read, lacks a column, or has a column given in `labels`. The message of
    every InputError raised inside the context is prefixed with the path.
    """
    require_extra("em", "duckdb")
    from duckdb import Error, connect

    settings: dict[str, Any] = {
        "threads": min(os.cpu_count() or 1, _THREADS),
        "temp_directory": tempfile.gettempdir(),
    }
    requested, scale = (tuple(required), tuple(optional)), MILLIMETRES_IN[unit]
    try:
        with connect(config=settings) as connection:
            yield _open(connection, path, requested, mapping, labels or {}, scale)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Error as error:
        reason = str(error).splitlines()[0]
        if "state machine" in reason:
            reason = "lines end in LF and in CRLF, or a quoted field is not closed"
        raise InputError(f"{path}: cannot be read: {reason}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _open(
    connection: "DuckDBPyConnection",
    path: Path,
    requested: tuple[tuple[str, ...], tuple[str, ...]],
    mapping: Mapping[str, str] | None,
    labels: Mapping[str, str],
    scale: float,
) -> SampleTable:
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise InputError("is empty")
    opened = _open_parquet if start == _MAGIC else _open_csv
    fields, find_row = opened(connection, path, lambda header: choose_columns(header, mapping, *requested))
    given = [name for name in labels if name in fields]
    if given:
        raise InputError(f"has a column {given[0]}: --{given[0]} is only for a table without it")
    names = dict.fromkeys((*requested[0], *requested[1], *labels))
    values = (f"{_value(name, fields.get(name), labels.get(name, ''), scale)} AS {name}" for name in names)
    connection.execute(f"CREATE TEMP VIEW samples AS SELECT {', '.join(values)} FROM file")
    return SampleTable(connection, fields, find_row)


def _value(name: str, field: str | None, label: str, scale: float) -> str:
    """Return the SQL for the value of a column; field: its SQL name in the file, None if the file lacks it."""
    if name in TEXT:
        return f"{_literal(label)}::VARCHAR" if field is None else f"trim(coalesce({field}::VARCHAR, ''))"
    if field is None:
        return "NULL::DOUBLE"
    factor = f" * {scale}" if scale != 1.0 and name.endswith("_mm") else ""
    return f"CASE WHEN NOT isnan({field}::DOUBLE) THEN {field}::DOUBLE{factor} END"


def _open_csv(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> _Opened:
    layout = read_layout(path)
    chosen = choose(layout.header)
    numbers = {text for name, text in chosen.items() if name not in TEXT}
    kinds = {f"c{k}": "DOUBLE" if text in numbers else "VARCHAR" for k, text in enumerate(layout.header)}
    mark = "," if has_decimal_commas(path, layout, numbers) else "."
    connection.execute(
        f"CREATE TEMP VIEW file AS SELECT * FROM read_csv({_literal(escape(str(path)))}, columns={kinds}, "
        f"auto_detect=false, header=true, skip={layout.skipped}, delim={_literal(layout.separator)}, quote='\"', "
        f"escape='\"', nullstr={_EMPTY_FIELDS}, decimal_separator='{mark}', store_rejects=true, "
        f"rejects_limit={_MOST_REJECTED})"
    )
    fields = {name: f"c{layout.header.index(text)}" for name, text in chosen.items()}
    return fields, lambda row: f"line {find_line(path, layout, row)}"


def _open_parquet(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> _Opened:
    from duckdb import InvalidInputException

    source = f"read_parquet({_literal(escape(str(path)))}, binary_as_string=true)"
    try:
        connection.execute(f"CREATE TEMP VIEW file AS SELECT * FROM {source}")
    except InvalidInputException:
        raise InputError("is a truncated or damaged Parquet file") from None
    types = {name: str(kind) for name, kind, *_ in connection.execute("DESCRIBE file").fetchall()}
    chosen = choose(list(types))
    for name, text in chosen.items():
        if name not in TEXT and types[text].startswith(_NOT_NUMERIC):
            raise InputError(f"{name}: must be a column of numbers, not of {types[text]}")
    fields = {name: '"' + text.replace('"', '""') + '"' for name, text in chosen.items()}
    return fields, lambda row: f"row {row}"


def _explain_field(column: str, message: str) -> str:
    found = _FIELD.search(message)
    text = found[1].strip()[:SHOWN] if found else ""
    remedy = ": use a decimal point, not a comma" if "," in text else ""
    return f"{column}: {text!r} is not a number{remedy}"


def _literal(value: str) -> str:
    """Return an SQL literal."""
    return "'" + value.replace("'", "''") + "'"


def _fill(column: NDArray[Any]) -> NDArray[Any]:
    if not isinstance(column, np.ma.MaskedArray):
        return column
    empty: Any = None if column.dtype == object else np.nan
    return np.where(np.ma.getmaskarray(column), empty, column.data)
