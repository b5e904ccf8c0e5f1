"""A table in a CSV or Parquet file as a DuckDB view.

The first bytes of the file, not its name, decide its format. No rows are held in memory: each query reads the file. A
CSV file is read as text, with a surplus column and without padding of short rows, and then converted, since the number
reader of DuckDB accepts a surplus empty field and infinite numbers.
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
from flexneedle.lab.tables.layout import (
    SHOWN,
    find_line,
    find_other_line_end,
    has_decimal_commas,
    read_layout,
)

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
_NO_NULL = r"\N{no value is spelled like this}"  # empty fields are '', and only padded ones NULL
_LINE = re.compile(r"Line: (\d+)")
_MOST_REJECTED = 10_000
_Choose = Callable[[Sequence[str]], dict[str, str]]
_SHORT, _SURPLUS = "fewer fields", "more fields"


@dataclass(frozen=True)
class SampleTable:
    """An open table. Its view `samples` has the requested columns and a row for each row of the file.

    Text is without surrounding blanks, empty in any of the spellings `EMPTY`. Numbers are finite DOUBLE with lengths in
    mm, NULL if empty or if the table lacks the column. `fault` is NULL, or the reason why the row is malformed.
    columns: the requested columns that the table has; find_row: "line 5" and the text of a line, from its row.
    """

    connection: "DuckDBPyConnection"
    columns: frozenset[str]
    find_row: Callable[[int], tuple[str, str]]

    def arrays(self, query: str, **values: Any) -> dict[str, NDArray[Any]]:
        """Return the columns (r,) of the result of a query, with NaN for NULL.

        Raises InputError for a row of the file that is no CSV.
        """
        found = self.connection.execute(query, values or None).fetchnumpy()
        self._refuse_rejected()
        return {name: _fill(column) for name, column in found.items()}

    def refuse(self, rules: Sequence[Rule], chosen: str = "true", **values: Any) -> None:
        """Raise InputError for the first row that is malformed, or meets `chosen` and violates a rule."""
        query = f"""
            SELECT row, rule, fault, raw FROM (
                SELECT row_number() OVER () AS row, {first_violation(rules)} AS rule, {chosen} AS chosen, * FROM samples
            ) WHERE rule IS NOT NULL AND (chosen OR fault IS NOT NULL) ORDER BY row LIMIT 1
        """
        found = self.arrays(query, **values)
        for row, rule, fault, raw in zip(
            *(found[name] for name in ("row", "rule", "fault", "raw")), strict=True
        ):
            place, line = self.find_row(int(row))
            raise InputError(f"{place}: {_explain(fault, raw, line) if rule < 0 else rules[int(rule)][1]}")

    def _refuse_rejected(self) -> None:
        """Raise InputError for the first row that DuckDB rejected."""
        query = "SELECT line, error_type, csv_line FROM reject_errors ORDER BY line LIMIT 1"
        rejected = self.connection.execute(query).fetchone() if self._has_rejects() else None
        if rejected is not None:
            line, kind, text = rejected
            reason = _SURPLUS + " than the header" if kind == "TOO MANY COLUMNS" else kind.lower()
            raise InputError(f"line {line}: {reason}: {text.strip()[:SHOWN]!r}")

    def _has_rejects(self) -> bool:
        query = "SELECT count(*) FROM duckdb_tables() WHERE table_name = 'reject_errors'"
        found = self.connection.execute(query).fetchone()
        return bool(found and found[0])


def first_violation(rules: Sequence[Rule]) -> str:
    """Return the SQL for the index of the first rule that a row violates, −1 if it is malformed, else NULL."""
    cases = " ".join(f"WHEN {condition} THEN {number}" for number, (condition, _) in enumerate(rules))
    return f"CASE WHEN fault IS NOT NULL THEN -1 {cases} END"


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
        raise InputError(f"{path}: cannot be read: {_reason(path, str(error))}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@dataclass(frozen=True)
class _Source:
    """An open file: its view `file`, and the SQL to read it.

    fields: field by column; number, text: value of a field, a number as DOUBLE or NULL; is_wrong: whether a field
    without a finite number is not empty; faults: conditions of malformed rows, with reasons.
    """

    fields: Mapping[str, str]
    number: Callable[[str], str]
    is_wrong: Callable[[str], str]
    text: Callable[[str], str]
    faults: Sequence[tuple[str, str]]
    find_row: Callable[[int], tuple[str, str]]


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
    source = opened(connection, path, lambda header: choose_columns(header, mapping, *requested))
    given = [name for name in labels if name in source.fields]
    if given:
        raise InputError(f"has a column {given[0]}: --{given[0]} is only for a table without it")
    names = tuple(dict.fromkeys((*requested[0], *requested[1], *labels)))
    _create_samples(connection, source, names, labels, scale)
    return SampleTable(connection, frozenset(source.fields), source.find_row)


def _create_samples(
    connection: "DuckDBPyConnection",
    source: _Source,
    names: Sequence[str],
    labels: Mapping[str, str],
    scale: float,
) -> None:
    numbers = {name: field for name, field in source.fields.items() if name not in TEXT}
    values = [f"{source.number(field)} AS number_{name}" for name, field in numbers.items()]
    wrong = {
        name: f"CASE WHEN isfinite(number_{name}) THEN false ELSE {source.is_wrong(field)} END"
        for name, field in numbers.items()
    }
    faults = [(condition, _literal(reason)) for condition, reason in source.faults]
    faults += [(condition, f"'{name}'") for name, condition in wrong.items()]
    raw = [(condition, f"{numbers[name]}::VARCHAR") for name, condition in wrong.items()]
    connection.execute(f"""
        CREATE TEMP VIEW samples AS
        SELECT {", ".join(_columns(names, source, labels, scale))}, {_case(faults)} AS fault, {_case(raw)} AS raw
        FROM (SELECT {", ".join(["*", *values])} FROM file)
    """)


def _case(choices: Iterable[tuple[str, str]]) -> str:
    cases = " ".join(f"WHEN {condition} THEN {value}" for condition, value in choices)
    return f"CASE {cases} END" if cases else "NULL::VARCHAR"


def _columns(names: Iterable[str], source: _Source, labels: Mapping[str, str], scale: float) -> Iterator[str]:
    for name in names:
        field = source.fields.get(name)
        if name in TEXT:
            value = f"{_literal(labels.get(name, ''))}::VARCHAR" if field is None else source.text(field)
        elif field is None:
            value = "NULL::DOUBLE"
        else:
            factor = f" * {scale}" if scale != 1.0 and name.endswith("_mm") else ""
            value = f"CASE WHEN isfinite(number_{name}) THEN number_{name}{factor} END"
        yield f"{value} AS {name}"


def _open_csv(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> _Source:
    layout = read_layout(path)
    chosen = choose(layout.header)
    count = len(layout.header)
    connection.execute(
        f"CREATE TEMP VIEW file AS SELECT * FROM read_csv({_literal(escape(str(path)))}, "
        f"columns={ {f'c{k}': 'VARCHAR' for k in range(count + 1)} }, auto_detect=false, header=true, "
        f"skip={layout.skipped}, delim={_literal(layout.separator)}, quote='\"', escape='\"', "
        f"nullstr={_literal(_NO_NULL)}, null_padding=true, store_rejects=true, rejects_limit={_MOST_REJECTED})"
    )
    commas = has_decimal_commas(path, layout, {text for name, text in chosen.items() if name not in TEXT})

    def number(field: str) -> str:
        text = (
            f"CASE WHEN NOT contains({field}, '.') THEN replace({field}, ',', '.') END" if commas else field
        )
        # A plain cast of a column is done by the reader of the file, which refuses ''.
        return f"TRY_CAST(coalesce({text}, '') AS DOUBLE)"

    def find_row(row: int) -> tuple[str, str]:
        line, text = find_line(path, layout, row)
        return f"line {line}", text

    return _Source(
        {name: f"c{layout.header.index(text)}" for name, text in chosen.items()},
        number=number,
        is_wrong=lambda field: f"NOT {_is_empty(field)}",
        text=lambda field: f"trim(coalesce({field}, ''))",
        faults=[(f"c{count - 1} IS NULL", _SHORT), (f"c{count} IS NOT NULL", _SURPLUS)],
        find_row=find_row,
    )


def _open_parquet(connection: "DuckDBPyConnection", path: Path, choose: _Choose) -> _Source:
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
    return _Source(
        {name: '"' + text.replace('"', '""') + '"' for name, text in chosen.items()},
        number=lambda field: f"{field}::DOUBLE",
        is_wrong=lambda field: f"coalesce(isinf({field}::DOUBLE), false)",
        text=lambda field: f"trim(coalesce({field}::VARCHAR, ''))",
        faults=(),
        find_row=lambda row: (f"row {row}", ""),
    )


def _is_empty(field: str) -> str:
    return f"lower(trim({field})) IN {EMPTY}"


def _explain(fault: str, value: str, line: str) -> str:
    if fault in (_SHORT, _SURPLUS):
        return f"has {fault} than the header: {line!r}"
    remedy = ": use a decimal point, not a comma" if "," in value else ""
    return f"{fault}: {value.strip()[:SHOWN]!r} is not a finite number{remedy}"


def _reason(path: Path, message: str) -> str:
    if "quoted new lines" in message:
        return f"line {_LINE.findall(message)[0]}: a quoted field must not contain a line end"
    if "state machine" in message and (line := find_other_line_end(path)) is not None:
        return f"line {line}: another line end (LF or CRLF) than before: save the file with one kind"
    return message.splitlines()[0]


def _literal(value: str) -> str:
    """Return an SQL literal."""
    return "'" + value.replace("'", "''") + "'"


def _fill(column: NDArray[Any]) -> NDArray[Any]:
    if not isinstance(column, np.ma.MaskedArray):
        return column
    empty: Any = None if column.dtype == object else np.nan
    return np.where(np.ma.getmaskarray(column), empty, column.data)
