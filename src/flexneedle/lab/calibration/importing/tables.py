"""Tables of recordings, whatever their format: columns of numbers, times and text by name."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError, one_line
from flexneedle.lab.calibration.importing.bags import TIME, find_bag, read_bag
from flexneedle.lab.calibration.importing.columns import Table, locate, to_numbers, to_seconds
from flexneedle.lab.calibration.importing.map_file import TIMES, TableMap, TimeMap, to_name
from flexneedle.lab.calibration.importing.text_tables import read_text

_PARQUET, _MAT, _HDF = b"PAR1", b"MATLAB 5.0 MAT-file", b"\x89HDF"


class Columns(NamedTuple):
    """Names of columns of numbers and of text, columns of the time, and layout of the file."""

    numbers: tuple[str, ...]
    text: tuple[str, ...]
    time: TimeMap
    table: TableMap


def read_table(path: Path, wanted: Columns) -> Table:
    """Return columns: numbers, text, and `TIME` in s if the file has times.

    CSV and other text, Parquet, MATLAB, MCAP or rosbag2; the content of the file decides, not its name. Raises
    InputError, which begins with the path, for a file that cannot be read, and for missing or malformed columns.
    """
    try:
        return dict(_convert(_read(path, wanted), wanted))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{path}: {one_line(error)}") from None


def _read(path: Path, wanted: Columns) -> Table:
    times = tuple(map(to_name, wanted.time.columns))
    names = dict.fromkeys((*wanted.numbers, *times, *wanted.text))
    if (bag := find_bag(path)) is not None:
        return read_bag(bag, list(names))
    with path.open("rb") as file:
        start = file.read(len(_MAT))
    if not start:
        raise InputError("is empty")
    if start.startswith(_HDF):
        raise InputError("is a MATLAB file of version 7.3: save it with the option -v7")
    if start.startswith(_PARQUET):
        return _read_parquet(path, list(names))
    if start.startswith(_MAT):
        return _read_matlab(path, list(names))
    return read_text(path, wanted.numbers, times, wanted.text, wanted.table)


def _convert(columns: Table, wanted: Columns) -> Iterator[tuple[str, Any]]:
    time = wanted.time
    for name in wanted.text:
        yield name, np.array(["" if each is None else str(each).strip() for each in columns[name].tolist()])
    for name in wanted.numbers:
        yield name, to_numbers(name, columns[name])
    units = zip(time.columns, (time.unit, time.second_unit), strict=False)
    found = [to_seconds(to_name(name), columns[to_name(name)], TIMES[unit]) for name, unit in units]
    if found:
        yield TIME, sum(found)
    elif TIME in columns:
        yield TIME, columns[TIME]


def _read_parquet(path: Path, names: Sequence[str]) -> Table:
    require_extra("study", "pyarrow")
    from pyarrow import ArrowInvalid
    from pyarrow.parquet import ParquetFile

    try:
        with ParquetFile(path) as file:
            places = locate(names, file.schema_arrow.names)
            rows = file.read()
    except (ArrowInvalid, OSError):
        raise InputError("is a truncated or damaged Parquet file") from None
    return {name: rows.column(place).to_numpy() for name, place in places.items()}


def _read_matlab(path: Path, names: Sequence[str]) -> Table:
    """Return vectors by variable or STRUCT.FIELD, and columns of matrices as NAME[1] and so on."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(path, squeeze_me=True, simplify_cells=True)
    except (MatReadError, NotImplementedError, ValueError, TypeError, LookupError, EOFError) as error:
        raise InputError(f"is a damaged MATLAB file: {error}") from None
    if "__function_workspace__" in variables:
        raise InputError(
            "has MATLAB objects such as tables: save struct arrays, as by table2struct(T, 'ToScalar', true)"
        )
    found = dict(_vectors({key: value for key, value in variables.items() if not key.startswith("__")}))
    places = locate(names, list(found))
    columns = {name: list(found.values())[place] for name, place in places.items()}
    sizes = {name: len(column) for name, column in columns.items()}
    for name, size in sizes.items():
        if size != sizes[names[0]]:
            raise InputError(f"column {name!r} has {size} rows, and {names[0]!r} has {sizes[names[0]]}")
    return columns


def _vectors(values: Mapping[str, Any], opening: str = "") -> Iterator[tuple[str, Any]]:
    """Yield columns by name. A struct array yields the rows of its elements, and their numbers from 1 as its name."""
    for key, value in values.items():
        name = opening + key
        if isinstance(value, Mapping):
            yield from _vectors(value, f"{name}.")
        elif isinstance(value, list | np.ndarray) and len(np.shape(value)) and _are_structs(value):
            yield from _stack(name, [dict(_vectors(each)) for each in value])
        else:
            array = np.asarray(value)
            if array.ndim == 1:
                yield name, array
            elif array.ndim == 2:
                yield from ((f"{name}[{k}]", column) for k, column in enumerate(array.T, 1))


def _are_structs(values: Any) -> bool:
    return len(values) > 0 and all(isinstance(each, Mapping) for each in values)


def _stack(name: str, elements: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, Any]]:
    longest = [max(map(len, each.values()), default=0) for each in elements]
    yield name, np.repeat(np.arange(1, len(elements) + 1), longest)
    for key in elements[0]:
        if all(key in each for each in elements):
            yield f"{name}.{key}", np.concatenate([each[key] for each in elements])
