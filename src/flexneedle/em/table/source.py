"""A table of measurements, CSV or Parquet, as a view of DuckDB with our names of its columns.

The first bytes decide which of the two a file is, not its name. No row is kept: each query reads the file again.
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

from flexneedle.em.table.columns import chosen_columns
from flexneedle.errors import InputError
from flexneedle.rig.tracking.table import COLUMNS

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

LABELS = ("point_id", "sensor", "environment")
"""Columns of names; numbers are taken as text, 1 and "1" are the same. All other columns are of numbers."""
MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}

_LENGTHS = tuple(name for name in COLUMNS if name.endswith("_mm"))
_MAGIC = b"PAR1"
_MOST_THREADS = 4  # each holds 32 MB of a CSV
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
_NO_NUMBERS = ("VARCHAR", "BOOLEAN", "BLOB", "DATE", "TIME", "STRUCT", "MAP", "UUID")
_Choose = Callable[[list[str]], dict[str, str]]


@dataclass(frozen=True)
class Table:
    """An open table. Its view `samples` has a row for each row of the file and all of our columns.

    Labels are text without blanks around it, '' where there is none; numbers are DOUBLE, lengths in mm, NULL where
    there is none (NaN, too) or where the table lacks the column. columns: those that the table has.
    """

    connection: "DuckDBPyConnection"
    columns: frozenset[str]
    refuse: Callable[[], None]

    def arrays(self, query: str, **values: Any) -> dict[str, NDArray[Any]]:
        """Return the columns (r,) of a query's rows; a number that is NULL is NaN.

        Raises InputError for a row of the file that cannot be read.
        """
        found = self.connection.execute(query, values or None).fetchnumpy()
        self.refuse()
        return {name: _filled(column) for name, column in found.items()}


@contextmanager
def open_table(
    path: Path,
    theirs: Mapping[str, str],
    required: Iterable[str],
    optional: Iterable[str],
    names: Mapping[str, str] | None = None,
    unit: str = "mm",
) -> Iterator[Table]:
    """Open a table; `theirs`: see `column_map`; names: a label of all rows by column, for a table without such.

    Raises InputError, which begins with the path, if the file cannot be read, lacks a column, or has a label that
    `names` gives; and for any other InputError inside the block.
    """
    try:
        from duckdb import DataError, InvalidInputException, OperationalError, connect
    except ImportError:
        raise InputError("tables of measurements need duckdb: pip install 'flexneedle[em]'") from None
    try:
        with connect(config=_settings()) as connection:
            yield _table(connection, path, theirs, tuple(required), tuple(optional), names or {}, unit)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (DataError, InvalidInputException, OperationalError) as error:
        raise InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _settings() -> dict[str, str | bool | int | float | list[str]]:
    threads = min(os.cpu_count() or 1, _MOST_THREADS)
    return {"threads": str(threads), "temp_directory": tempfile.gettempdir()}


def _table(
    connection: "DuckDBPyConnection",
    path: Path,
    theirs: Mapping[str, str],
    required: tuple[str, ...],
    optional: tuple[str, ...],
    names: Mapping[str, str],
    unit: str,
) -> Table:
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise InputError("is empty")
    opened = _parquet if start == _MAGIC else _csv
    chosen, columns, refuse = opened(
        connection, path, lambda h: chosen_columns(h, theirs, required, optional)
    )
    twice = [name for name in names if name in chosen]
    if twice:
        raise InputError(f"has a column {twice[0]}: --{twice[0]} is for a table without")
    scale = MILLIMETRES_IN[unit]
    constants = {name: f"{_text(value)}::VARCHAR" for name, value in names.items()}
    made = ", ".join(
        f"{constants.get(our) or _expression(our, columns.get(our), scale)} AS {our}" for our in COLUMNS
    )
    connection.execute(f"CREATE TEMP VIEW samples AS SELECT {made} FROM file")
    return Table(connection, frozenset(chosen), refuse)


def _expression(our: str, column: str | None, scale: float) -> str:
    if our in LABELS:
        return "''" if column is None else f"trim(coalesce({column}::VARCHAR, ''))"
    if column is None:
        return "NULL::DOUBLE"
    factor = scale if our in _LENGTHS else 1.0
    number = f"{column}::DOUBLE" if factor == 1.0 else f"({column}::DOUBLE * {factor})"
    return f"CASE WHEN isnan({column}::DOUBLE) THEN NULL ELSE {number} END"


def _csv(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> Any:
    """Make the view `file` and return chosen names, columns in SQL by our name, and the check for rejected rows."""
    from flexneedle.em.table.text import read_layout, refuse_rejected

    layout = read_layout(path)
    chosen = choose(layout.header)
    columns = {our: f"c{layout.header.index(their)}" for our, their in chosen.items()}
    numbers = {column for our, column in columns.items() if our not in LABELS}
    kinds = {f"c{k}": "DOUBLE" if f"c{k}" in numbers else "VARCHAR" for k in range(len(layout.header))}
    connection.execute(
        f"CREATE TEMP VIEW file AS SELECT * FROM read_csv({_text(escape(str(path)))}, columns={kinds}, "
        f"auto_detect=false, header=true, delim={_text(layout.delimiter)}, quote='\"', escape='\"', "
        f"nullstr={_NULLS}, store_rejects=true, rejects_limit={_MOST_REJECTED})"
    )
    return chosen, columns, lambda: refuse_rejected(connection, layout, chosen)


def _parquet(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> Any:
    """As `_csv`."""
    from duckdb import InvalidInputException

    source = f"read_parquet({_text(escape(str(path)))}, binary_as_string=true)"
    try:
        connection.execute(f"CREATE TEMP VIEW file AS SELECT * FROM {source}")
    except InvalidInputException:
        raise InputError("a Parquet file that was cut off, or is damaged") from None
    kinds = {name: str(kind) for name, kind, *_ in connection.execute("DESCRIBE file").fetchall()}
    chosen = choose(list(kinds))
    for our, their in chosen.items():
        if our not in LABELS and kinds[their].startswith(_NO_NUMBERS):
            raise InputError(f"{our}: must be a column of numbers, not of {kinds[their]}")
    columns = {our: '"' + their.replace('"', '""') + '"' for our, their in chosen.items()}
    return chosen, columns, lambda: None


def _text(value: str) -> str:
    """Return a literal of SQL."""
    return "'" + value.replace("'", "''") + "'"


def _filled(column: NDArray[Any]) -> NDArray[Any]:
    return np.ma.filled(column.astype(float), np.nan) if np.ma.isMaskedArray(column) else column
