"""A table in a CSV or Parquet file as a DuckDB view.

The first bytes of the file, not its name, decide its format. No rows are held in memory: each query reads the file.
"""

import os
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
from flexneedle.lab.tables.columns import STATUS, check_units, choose_columns
from flexneedle.lab.tables.layout import CsvLayout, has_decimal_commas, read_layout
from flexneedle.lab.tables.plain_copy import EMPTY, is_regular, write_copy
from flexneedle.types import BAD_FLOAT, BAD_FLOAT_TOLERANCE, VISIBLE

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

TEXT = ("point_id", "sensor", "environment", "status")
"""Columns of text; numbers in them are converted, so that 1 and "1" are the same. All other columns hold numbers."""
MILLIMETRES_IN = {"mm": 1.0, "m": 1000.0}
NO_STATUS = tuple(text for text in EMPTY if text != "missing")
"""Spellings of an empty status, in lower case."""
Rule = tuple[str, str]
"""An SQL condition that invalid rows of `samples` meet, and the message."""

_MAGIC = b"PAR1"
_THREADS = 4  # at most; each buffers 32 MB of a CSV file
_POSE = ("x_mm", "y_mm", "z_mm"), ("qw", "qx", "qy", "qz")
_NOT_NUMERIC = ("VARCHAR", "BOOLEAN", "BLOB", "DATE", "TIME", "STRUCT", "MAP", "UUID")
_EMPTY_FIELDS = [
    "",
    "NA",
    "N/A",
    "#N/A",
    "null",
    "NULL",
    "None",
    "missing",
    "MISSING",
]  # and nan; others are slower
_Choose = Callable[[Sequence[str]], dict[str, str]]


@dataclass(frozen=True)
class SampleTable:
    """An open table. Its view `samples` has the requested columns and a row for each row of the file.

    Text is without surrounding blanks, empty in any of the spellings `EMPTY`. Numbers are DOUBLE with lengths in mm,
    NULL if empty, if a known code for a missing number or sample, or if the table lacks the column; a row with a status
    other than ok has no position. fields: the requested columns and the status that the table has, with their SQL names
    in the file.
    """

    connection: "DuckDBPyConnection"
    fields: Mapping[str, str]
    source: "_Source"

    def find_row(self, row: int) -> str:
        """Return the place of a row, such as "line 5"; rows count from 1."""
        return self.source.find_row(row)

    def arrays(self, query: str, **values: Any) -> dict[str, NDArray[Any]]:
        """Return the columns (r,) of the result of a query, with NaN for NULL.

        Raises InputError for the first malformed line of the file.
        """
        from duckdb import ConversionException, InvalidInputException

        try:
            found = self.connection.execute(query, values or None).fetchnumpy()
        except (ConversionException, InvalidInputException):
            if not self.source.reopen(self.connection):
                raise
            found = self.connection.execute(query, values or None).fetchnumpy()
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
        check_units(mapping or {}, unit)
        with connect(config=settings) as connection, tempfile.TemporaryDirectory() as folder:
            yield _open(connection, path, Path(folder), requested, mapping, labels or {}, scale)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Error as error:
        raise InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _open(
    connection: "DuckDBPyConnection",
    path: Path,
    folder: Path,
    requested: tuple[tuple[str, ...], tuple[str, ...]],
    mapping: Mapping[str, str] | None,
    labels: Mapping[str, str],
    scale: float,
) -> SampleTable:
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise InputError("is empty")
    source: _Source = _Parquet(path) if start == _MAGIC else _Csv(path, folder / "copy.csv")
    required, optional = requested
    optional = tuple(dict.fromkeys((*optional, STATUS)))
    fields = source.open(connection, lambda header: choose_columns(header, mapping, required, optional))
    given = [name for name in labels if name in fields]
    if given:
        raise InputError(f"has a column {given[0]}: --{given[0]} is only for a table without it")
    names = dict.fromkeys((*required, *optional, *labels))
    values = (f"{_value(name, fields.get(name), labels.get(name, ''), scale)} AS {name}" for name in names)
    query = f"SELECT {', '.join(values)} FROM file"
    if "status" in fields and "x_mm" in fields:
        measured = f"lower(status) IN {(VISIBLE, *NO_STATUS)}"
        position = (f"CASE WHEN {measured} THEN {name} END AS {name}" for name in _POSE[0] if name in fields)
        query = f"SELECT * REPLACE ({', '.join(position)}) FROM ({query})"
    if fields.keys() >= {*_POSE[0], *_POSE[1]}:
        query = f"SELECT * REPLACE ({_drop_zeros()}) FROM ({query})"
    connection.execute(f"CREATE TEMP VIEW samples AS {query}")
    return SampleTable(connection, fields, source)


def _drop_zeros() -> str:
    """Return the SQL for poses without some devices' missing samples: all numbers 0, also of an empty position."""
    columns = [name for part in _POSE for name in part]
    position, orientation = (" AND ".join(f"{name} = 0" for name in part) for part in _POSE)
    zero = f"coalesce({orientation}, false) AND coalesce({position}, x_mm IS NULL)"
    return ", ".join(f"CASE WHEN NOT ({zero}) THEN {name} END AS {name}" for name in columns)


def _value(name: str, field: str | None, label: str, scale: float) -> str:
    """Return the SQL for the value of a column; field: its SQL name in the file, None if the file lacks it."""
    if name in TEXT:
        return f"{_literal(label)}::VARCHAR" if field is None else f"trim(coalesce({field}::VARCHAR, ''))"
    if field is None:
        return "NULL::DOUBLE"
    factor = f" * {scale}" if scale != 1.0 and name.endswith("_mm") else ""
    missing = f"isnan({field}::DOUBLE) OR abs({field}::DOUBLE - {BAD_FLOAT!r}) < {-BAD_FLOAT_TOLERANCE * BAD_FLOAT!r}"
    return f"CASE WHEN NOT ({missing}) THEN {field}::DOUBLE{factor} END"


class _Csv:
    """A CSV file, or its plain copy if DuckDB cannot read the file."""

    def __init__(self, path: Path, copy: Path) -> None:
        self._path, self._copy, self._layout = path, copy, read_layout(path)
        self._chosen: dict[int, str] = {}  # types in SQL by column number
        self._empty = _EMPTY_FIELDS
        self._lines: Sequence[int] = ()

    def open(self, connection: "DuckDBPyConnection", choose: _Choose) -> dict[str, str]:
        """Create the view `file` and return the SQL names of the requested columns."""
        layout = self._layout
        columns = {name: layout.header.index(text) for name, text in choose(layout.header).items()}
        self._chosen = {k: "VARCHAR" if name in TEXT else "DOUBLE" for name, k in columns.items()}
        self._empty = [text for text in _EMPTY_FIELDS if "status" not in columns or text.lower() != "missing"]
        if is_regular(self._path, layout):
            kinds = {f"c{k}": self._chosen.get(k, "VARCHAR") for k in range(len(layout.header))}
            numbers = {layout.header[k] for k, kind in self._chosen.items() if kind == "DOUBLE"}
            mark = "," if has_decimal_commas(self._path, layout, numbers) else "."
            self._create_view(connection, self._path, kinds, layout, mark)
        else:
            self.reopen(connection)
        return {name: f"c{k}" for name, k in columns.items()}

    def reopen(self, connection: "DuckDBPyConnection") -> bool:
        """Replace the view by one of a plain copy; False if it is one. Raises InputError for a malformed line."""
        if self._lines:
            return False
        chosen = sorted(self._chosen)
        numbers = [k for k in chosen if self._chosen[k] == "DOUBLE"]
        self._lines = write_copy(self._path, self._layout, chosen, numbers, self._copy)
        if not self._lines:
            raise InputError("has no rows, only the header")
        kinds = {f"c{k}": self._chosen[k] for k in chosen}
        self._create_view(connection, self._copy, kinds, CsvLayout((), ",", 0), ".")
        return True

    def find_row(self, row: int) -> str:
        """Return "line 5" of a row."""
        return f"line {self._lines[row - 1] if self._lines else self._layout.skipped + 1 + row}"

    def _create_view(
        self,
        connection: "DuckDBPyConnection",
        path: Path,
        kinds: Mapping[str, str],
        layout: CsvLayout,
        mark: str,
    ) -> None:
        connection.execute(
            f"CREATE OR REPLACE TEMP VIEW file AS SELECT * FROM read_csv({_literal(escape(str(path)))}, "
            f"columns={dict(kinds)}, auto_detect=false, header=true, skip={layout.skipped}, "
            f"delim={_literal(layout.separator)}, quote='\"', escape='\"', nullstr={self._empty}, "
            f"decimal_separator='{mark}')"
        )


class _Parquet:
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self, connection: "DuckDBPyConnection", choose: _Choose) -> dict[str, str]:
        """Create the view `file` and return the SQL names of the requested columns."""
        from duckdb import InvalidInputException

        path = _literal(escape(str(self._path)))
        try:
            connection.execute(
                f"CREATE TEMP VIEW file AS SELECT * FROM read_parquet({path}, binary_as_string=true)"
            )
        except InvalidInputException:
            raise InputError("is a truncated or damaged Parquet file") from None
        types = {name: str(kind) for name, kind, *_ in connection.execute("DESCRIBE file").fetchall()}
        written = connection.execute(f"SELECT name FROM parquet_schema({path})").fetchall()
        doubles = {each.rpartition("_")[0].lower() for each in types.keys() - {name for (name,) in written}}
        chosen = choose(list(types))
        for name, text in chosen.items():
            if text.lower() in doubles:
                raise InputError(f"two columns have the name {text!r}: names must differ in more than case")
            if name not in TEXT and (types[text].startswith(_NOT_NUMERIC) or types[text].endswith("]")):
                remedy = "convert it, such as with pandas.to_numeric"
                raise InputError(f"{name}: must be a column of numbers, not of {types[text]}: {remedy}")
        return {name: '"' + text.replace('"', '""') + '"' for name, text in chosen.items()}

    def reopen(self, _connection: "DuckDBPyConnection") -> bool:
        """Return False: there is no other way to read the file."""
        return False

    def find_row(self, row: int) -> str:
        """Return "row 5" of a row."""
        return f"row {row}"


_Source = _Csv | _Parquet


def _literal(value: str) -> str:
    """Return an SQL literal."""
    return "'" + value.replace("'", "''") + "'"


def _fill(column: NDArray[Any]) -> NDArray[Any]:
    if not isinstance(column, np.ma.MaskedArray):
        return column
    empty: Any = None if column.dtype == object else np.nan
    return np.where(np.ma.getmaskarray(column), empty, column.data)
