"""A table of measurements, CSV or Parquet, as a DuckDB view with the column names of flexneedle.

The first bytes of the file, not its name, decide its format. No rows are held in memory: each query reads the file.
"""

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.table.columns import chosen_columns
from flexneedle.phantom.tracking.table import COLUMNS

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

LABELS = ("point_id", "sensor", "environment")
"""Columns of text; numbers in them are converted, so that 1 and "1" are the same. All other columns hold numbers."""
MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}

_LENGTHS = tuple(name for name in COLUMNS if name.endswith("_mm"))
_MAGIC = b"PAR1"
_MOST_THREADS = 4  # each buffers 32 MB of a CSV file
_NULLS = [
    "",
    " ",
    "nan",
    "NaN",
    "-nan",
    "-NaN",
    "NA",
    "N/A",
    "n/a",
    "#N/A",
    "null",
    "NULL",
    "None",
    "MISSING",
]
_MOST_REJECTED = 10_000
_NOT_NUMERIC = ("VARCHAR", "BOOLEAN", "BLOB", "DATE", "TIME", "STRUCT", "MAP", "UUID")
_Choose = Callable[[list[str]], dict[str, str]]


@dataclass(frozen=True)
class Table:
    """An open table. Its view `samples` has all columns of flexneedle and a row for each row of the file.

    Labels are text without surrounding blanks, '' if empty. Numbers are DOUBLE with lengths in mm; they are NULL if
    empty or NaN, or if the table lacks the column. columns: the columns that the table has.
    """

    connection: "DuckDBPyConnection"
    columns: frozenset[str]
    refuse: Callable[[], None]

    def arrays(self, query: str, **values: Any) -> dict[str, NDArray[Any]]:
        """Return the columns (r,) of the result of a query, with NaN for NULL.

        Raises InputError for an unreadable row of the file.
        """
        found = self.connection.execute(query, values or None).fetchnumpy()
        self.refuse()
        return {name: _filled(column) for name, column in found.items()}


@contextmanager
def open_table(
    path: Path,
    mapping: Mapping[str, str],
    required: Iterable[str],
    optional: Iterable[str],
    labels: Mapping[str, str] | None = None,
    unit: str = "mm",
) -> Iterator[Table]:
    """Open a table. mapping: see `column_map`; labels: value for all rows by column, for columns that the table lacks.

    Raises InputError if the file cannot be read, lacks a column, or has a column given in `labels`. The message of
    every InputError raised inside the context is prefixed with the path.
    """
    try:
        from duckdb import DataError, InvalidInputException, OperationalError, connect
    except ImportError:
        raise InputError("tables of measurements need duckdb: pip install 'flexneedle[em]'") from None
    try:
        with connect(config=_settings()) as connection:
            yield _table(connection, path, mapping, tuple(required), tuple(optional), labels or {}, unit)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (DataError, InvalidInputException, OperationalError) as error:
        raise InputError(f"{path}: cannot be read: {_reason(str(error))}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _reason(message: str) -> str:
    if "state machine reached an invalid state" in message:
        return "mixed line ends (LF and CRLF): save the file with one kind"
    return message.splitlines()[0]


def _settings() -> dict[str, str | bool | int | float | list[str]]:
    threads = min(os.cpu_count() or 1, _MOST_THREADS)
    return {"threads": str(threads), "temp_directory": tempfile.gettempdir()}


def _table(
    connection: "DuckDBPyConnection",
    path: Path,
    mapping: Mapping[str, str],
    required: tuple[str, ...],
    optional: tuple[str, ...],
    labels: Mapping[str, str],
    unit: str,
) -> Table:
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise InputError("is empty")
    opened = _parquet if start == _MAGIC else _csv
    chosen, columns, refuse = opened(
        connection, path, lambda header: chosen_columns(header, mapping, required, optional)
    )
    given = [name for name in labels if name in chosen]
    if given:
        raise InputError(f"has a column {given[0]}: --{given[0]} is only for a table without it")
    scale = MILLIMETRES_IN[unit]
    constants = {name: f"{_text(value)}::VARCHAR" for name, value in labels.items()}
    expressions = ", ".join(
        f"{constants.get(name) or _expression(name, columns.get(name), scale)} AS {name}" for name in COLUMNS
    )
    connection.execute(f"CREATE TEMP VIEW samples AS SELECT {expressions} FROM file")
    return Table(connection, frozenset(chosen), refuse)


def _expression(name: str, column: str | None, scale: float) -> str:
    if name in LABELS:
        return "''" if column is None else f"trim(coalesce({column}::VARCHAR, ''))"
    if column is None:
        return "NULL::DOUBLE"
    factor = scale if name in _LENGTHS else 1.0
    number = f"{column}::DOUBLE" if factor == 1.0 else f"({column}::DOUBLE * {factor})"
    return f"CASE WHEN isnan({column}::DOUBLE) THEN NULL ELSE {number} END"


def _csv(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> Any:
    """Create the view `file`; return the chosen columns, their SQL, and a function that raises for rejected rows."""
    from flexneedle.lab.tracker_evaluation.table.text import read_layout, refuse_rejected

    layout = read_layout(path)
    chosen = choose(layout.header)
    columns = {name: f"c{layout.header.index(header)}" for name, header in chosen.items()}
    numbers = {column for name, column in columns.items() if name not in LABELS}
    types = {f"c{k}": "DOUBLE" if f"c{k}" in numbers else "VARCHAR" for k in range(len(layout.header))}
    connection.execute(
        f"CREATE TEMP VIEW file AS SELECT * FROM read_csv({_text(escape(str(path)))}, columns={types}, "
        f"auto_detect=false, header=true, delim={_text(layout.delimiter)}, quote='\"', escape='\"', "
        f"nullstr={_NULLS}, store_rejects=true, rejects_limit={_MOST_REJECTED})"
    )
    return chosen, columns, lambda: refuse_rejected(connection, layout, chosen)


def _parquet(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> Any:
    """Like `_csv`."""
    from duckdb import InvalidInputException

    source = f"read_parquet({_text(escape(str(path)))}, binary_as_string=true)"
    try:
        connection.execute(f"CREATE TEMP VIEW file AS SELECT * FROM {source}")
    except InvalidInputException:
        raise InputError("is a truncated or damaged Parquet file") from None
    types = {name: str(kind) for name, kind, *_ in connection.execute("DESCRIBE file").fetchall()}
    chosen = choose(list(types))
    for name, header in chosen.items():
        if name not in LABELS and types[header].startswith(_NOT_NUMERIC):
            raise InputError(f"{name}: must be a column of numbers, not of {types[header]}")
    columns = {name: '"' + header.replace('"', '""') + '"' for name, header in chosen.items()}
    return chosen, columns, lambda: None


def _text(value: str) -> str:
    """Return an SQL literal."""
    return "'" + value.replace("'", "''") + "'"


def _filled(column: NDArray[Any]) -> NDArray[Any]:
    return np.ma.filled(column.astype(float), np.nan) if np.ma.isMaskedArray(column) else column
