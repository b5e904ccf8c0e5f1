"""Tables of measurements, CSV or Parquet, batch by batch: no more than a few megabytes are in memory at once.

What a file is, its first bytes tell, not its name. Errors are one line each; a file that was cut in the middle is
refused, since nobody knows what is missing.
"""

import re
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as parquet
from numpy.typing import NDArray

from flexneedle.em.evaluation.columns import chosen_columns
from flexneedle.em.evaluation.text import Layout, read_layout
from flexneedle.errors import InputError
from flexneedle.rig.tracking.table import COLUMNS

LABELS = ("point_id", "sensor", "environment")
"""Columns of names; numbers are taken as text, 1 and "1" are the same. All other columns are of numbers."""

_BLOCK = 4 << 20  # bytes of CSV in a batch
_ROWS = 1 << 17  # rows of Parquet in a batch
_MAGIC = b"PAR1"
_NULLS = [*csv.ConvertOptions().null_values, " ", "None", "none", "MISSING", "missing"]

Floats = NDArray[np.float64]
_NO_NUMBER = re.compile(
    r"In CSV column #(\d+): CSV conversion error to double: invalid value '(.*)'", re.DOTALL
)
_OTHER_LENGTH = "CSV parse error: Expected"
_Choose = Callable[[list[str]], dict[str, str]]


@dataclass(frozen=True, eq=False)
class Batch:
    """Some rows: labels as Arrow dictionary arrays (r,), numbers as float64 (r,), NaN where a field is empty."""

    rows: int
    labels: Mapping[str, Any]
    numbers: Mapping[str, Floats]


def read_batches(
    path: Path, theirs: Mapping[str, str], required: Iterable[str], optional: Iterable[str]
) -> Generator[Batch, None, None]:
    """Yield the rows of a table with their columns under our names; `theirs`: see `column_map`.

    Close it: another thread reads ahead for it, and one that is left to the garbage collector is ended wherever that
    comes to it, also within the start of another thread, which then waits for itself.
    Raises InputError, which does not name the file, if it cannot be read, lacks a column, or was cut off.
    """
    try:
        yield from _read(path, theirs, tuple(required), tuple(optional))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}") from None
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {' '.join(str(error).split())}") from None


def labelled(batches: Iterable[Batch], names: Mapping[str, str]) -> Iterator[Batch]:
    """Yield the batches with a label that is the same in all rows for each of `names`, by column.

    Raises InputError if the table has such a column itself.
    """
    for batch in batches:
        twice = [name for name in names if name in batch.labels]
        if twice:
            raise InputError(f"has a column {twice[0]}: --{twice[0]} is for a table without")
        zeros = np.zeros(batch.rows, dtype=np.int32)
        added = {name: pa.DictionaryArray.from_arrays(zeros, [value]) for name, value in names.items()}
        yield replace(batch, labels={**batch.labels, **added}) if added else batch


def _read(
    path: Path, theirs: Mapping[str, str], required: tuple[str, ...], optional: tuple[str, ...]
) -> Iterator[Batch]:
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise InputError("is empty")
    opened = _parquet if start == _MAGIC else _csv
    chosen, batches = opened(path, lambda header: chosen_columns(header, theirs, required, optional))
    yield from _ahead(_batch(batch, chosen) for batch in batches)


def _ahead(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Yield the batches; while one is in use, the next is being read (Arrow does that without the interpreter)."""
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, batches, None)
        while (batch := coming.result()) is not None:
            coming = reader.submit(next, batches, None)
            yield batch


def _parquet(path: Path, choose: _Choose) -> tuple[dict[str, str], Iterator[Any]]:
    try:
        schema = parquet.read_schema(path)
    except pa.ArrowInvalid:
        raise InputError("a Parquet file that was cut off, or is damaged: it has no footer") from None
    chosen = choose(list(schema.names))
    texts = [their for our, their in chosen.items() if our in LABELS and _is_text(schema.field(their).type)]
    file = parquet.ParquetFile(path, read_dictionary=texts)
    return chosen, _row_groups(file, list(chosen.values()))


def _row_groups(file: Any, columns: list[str]) -> Iterator[Any]:
    """Yield batches of one row group after the other: read in one go, Arrow keeps what it read of the whole file."""
    for number in range(file.num_row_groups):
        yield from file.iter_batches(_ROWS, row_groups=[number], columns=columns)


def _is_text(kind: Any) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _csv(path: Path, choose: _Choose) -> tuple[dict[str, str], Iterator[Any]]:
    layout = read_layout(path)
    chosen = choose(layout.header)
    layout.refuse_cut(path, [their for our, their in chosen.items() if our in LABELS], chosen.values())
    return chosen, _csv_batches(path, layout, chosen)


def _csv_batches(path: Path, layout: Layout, chosen: Mapping[str, str]) -> Iterator[Any]:
    names = pa.dictionary(pa.int32(), pa.string())
    types = {their: names if our in LABELS else pa.float64() for our, their in chosen.items()}
    try:
        yield from csv.open_csv(
            path,
            csv.ReadOptions(block_size=_BLOCK, column_names=list(layout.unique_names()), skip_rows=1),
            csv.ParseOptions(delimiter=layout.delimiter),
            csv.ConvertOptions(column_types=types, include_columns=list(chosen.values()), null_values=_NULLS),
        )
    except pa.ArrowInvalid as error:
        # Arrow knows neither the row nor the name of the column.
        if found := _NO_NUMBER.search(str(error)):
            raise InputError(layout.no_number(path, int(found[1]), found[2], chosen)) from None
        if _OTHER_LENGTH in str(error) and (told := layout.other_length(path)):
            raise InputError(told) from None
        raise


def _batch(batch: Any, chosen: Mapping[str, str]) -> Batch:
    columns = {our: batch.column(batch.schema.get_field_index(their)) for our, their in chosen.items()}
    labels = {our: _labels(columns[our]) for our in columns if our in LABELS}
    numbers = {our: _numbers(our, columns[our]) for our in COLUMNS if our in columns and our not in LABELS}
    return Batch(batch.num_rows, labels, numbers)


def _labels(column: Any) -> Any:
    if pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type):
        column = column.cast(pa.string())  # how some writers mark their text
    return column if pa.types.is_dictionary(column.type) else column.dictionary_encode()


def _numbers(name: str, column: Any) -> Floats:
    if pa.types.is_boolean(column.type):  # Arrow would make 0 and 1 of it
        raise InputError(f"{name}: must be a column of numbers, not of {column.type}")
    try:
        numbers: Floats = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        raise InputError(f"{name}: must be a column of numbers, not of {column.type}") from None
    return numbers
