"""Tables of recordings, whatever their format: columns of numbers by name, with text only where a map asks for it."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError, one_line
from flexneedle.lab.tables.layout import BLANKS, COMMENT, read_layout
from flexneedle.types import Floats

Table = Mapping[str, Any]
"""Columns (r,) by name."""
_PARQUET, _MCAP = b"PAR1", b"\x89MCAP"
_MAT = (b"MATLAB 5.0 MAT-file", b"\x89HDF")


def read_table(path: Path, numbers: Collection[str], text: Collection[str], topics: Collection[str]) -> Table:
    """Return columns of a table: CSV, TSV, Parquet, MATLAB, MCAP or a rosbag2 folder; its content decides, not its name.

    Raises InputError, which begins with the path, for a file that cannot be read, a missing column, or text where a
    number should be.
    """
    try:
        found = dict(_read(path, [*numbers, *text], topics))
        missing = [name for name in (*text, *numbers) if name not in found]
        if missing:
            raise InputError(f"has no column {missing[0]!r}; it has {_list(found)}")
        return {
            name: found[name] if name in text else _numbers(name, found[name]) for name in (*text, *numbers)
        }
    except (OSError, InputError) as error:
        raise InputError(f"{path}: {one_line(error)}") from None


def _read(path: Path, names: Collection[str], topics: Collection[str]) -> Iterator[tuple[str, Any]]:
    if path.is_dir():
        return _bag(path, topics)
    with path.open("rb") as file:
        start = file.read(32)
    if start.startswith(_MCAP):
        return _bag(path, topics)
    if start.startswith(_PARQUET):
        return _parquet(path, names)
    if start.startswith(_MAT):
        return _matlab(path)
    return _csv(path, names)


def _csv(path: Path, names: Collection[str]) -> Iterator[tuple[str, Any]]:
    require_extra("study", "pyarrow")
    from pyarrow import ArrowInvalid, csv

    layout = read_layout(path)
    if layout.separator == BLANKS:
        raise InputError("has columns with blanks between them: write commas or tabs")
    if repeated := {name for name in layout.header if layout.header.count(name) > 1} & {*names}:
        raise InputError(f"has two columns {min(repeated)!r}")
    try:
        rows = csv.read_csv(
            path,
            csv.ReadOptions(skip_rows=layout.skipped + 1, column_names=list(layout.header)),
            csv.ParseOptions(delimiter=layout.separator, invalid_row_handler=_skip_comment),
            csv.ConvertOptions(include_columns=[name for name in layout.header if name in names]),
        )
    except ArrowInvalid as error:
        raise InputError(one_line(error)) from None
    for name in layout.header:
        yield name, rows[name].to_numpy() if name in rows.column_names else None


def _skip_comment(row: Any) -> str:
    return "skip" if str(row.text).startswith(COMMENT) else "error"


def _parquet(path: Path, names: Collection[str]) -> Iterator[tuple[str, Any]]:
    require_extra("study", "pyarrow")
    from pyarrow import ArrowInvalid
    from pyarrow.parquet import ParquetFile

    try:
        with ParquetFile(path) as file:
            kept = [name for name in file.schema_arrow.names if name in names]
            rows = file.read(columns=kept)
            for name in file.schema_arrow.names:
                yield name, rows[name].to_numpy() if name in kept else None
    except ArrowInvalid as error:
        raise InputError(one_line(error)) from None


def _matlab(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield vectors by variable or STRUCT.FIELD, and the columns of matrices as NAME[1], NAME[2] …"""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(path, squeeze_me=True, simplify_cells=True)
    except (MatReadError, NotImplementedError, ValueError) as error:
        hint = " (version 7.3: save it with -v7)" if isinstance(error, NotImplementedError) else ""
        raise InputError(f"cannot be read{hint}: {error}") from None
    for name, value in _flatten({key: value for key, value in variables.items() if not key.startswith("__")}):
        array = np.asarray(value)
        if array.ndim == 1:
            yield name, array
        elif array.ndim == 2:
            for k, column in enumerate(array.T, 1):
                yield f"{name}[{k}]", column


def _flatten(values: Mapping[str, Any], opening: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{opening}{key}.")
        else:
            yield opening + key, value


def _bag(path: Path, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
    """Yield the columns of pose topics: time_s of the first, and TOPIC.x … TOPIC.qw, the newest at each time."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    if not topics:
        raise InputError("is a bag: name its pose topics as table.topics")
    series: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            known = {connection.topic for connection in reader.connections}
            if absent := [topic for topic in topics if topic not in known]:
                raise InputError(f"has no topic {absent[0]}; it has {_list(sorted(known))}")
            chosen = [each for each in reader.connections if each.topic in series]
            for connection, stamp, raw in reader.messages(chosen):
                message = reader.deserialize(raw, connection.msgtype)
                series[connection.topic].append((*_time_and_pose(message, stamp),))
    except AnyReaderError as error:
        raise InputError(f"cannot be read: {error}") from None
    first = np.array(series[next(iter(topics))]).reshape(-1, 8)
    yield "time_s", first[:, 0]
    for topic, rows in series.items():
        values = np.array(rows).reshape(-1, 8)
        if not len(values):
            raise InputError(f"has no message on {topic}")
        newest = np.searchsorted(values[:, 0], first[:, 0], side="right") - 1
        for name, column in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values[:, 1:].T, strict=True):
            yield f"{topic}.{name}", np.where(newest >= 0, column[newest], np.nan)


def _time_and_pose(message: Any, stamp: int) -> Iterator[float]:
    """Yield time (s), position and orientation of a message with a pose, a transform, a point or joint positions."""
    header = getattr(message, "header", None)
    seconds = 1e-9 * stamp if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec
    body = next(
        (getattr(message, name) for name in ("pose", "transform", "point") if hasattr(message, name)), message
    )
    body = getattr(body, "pose", body)
    place = next((getattr(body, name) for name in ("position", "translation") if hasattr(body, name)), body)
    turn = next((getattr(body, name) for name in ("orientation", "rotation") if hasattr(body, name)), None)
    yield float(seconds)
    try:
        yield from (float(place.x), float(place.y), float(place.z))
    except AttributeError:
        raise InputError(f"has messages without a pose: {type(message).__name__}") from None
    yield from (np.nan,) * 4 if turn is None else (float(turn.x), float(turn.y), float(turn.z), float(turn.w))


def _numbers(name: str, values: Any) -> Floats:
    """Return a column of numbers, NaN where it is empty. Raises InputError for text."""
    array = np.asarray(values)
    if array.dtype.kind in "fiub":
        return array.astype(float)
    found = np.full(len(array), np.nan)
    for row, value in enumerate(array.tolist()):
        if value not in (None, ""):
            try:
                found[row] = float(value)
            except (TypeError, ValueError):
                raise InputError(f"column {name!r}, row {row + 1}: {value!r} is not a number") from None
    return found


def _list(names: Collection[str], most: int = 12) -> str:
    shown = [repr(name) for name in names][:most]
    return ", ".join(shown) + (f" and {len(names) - most} more" if len(names) > most else "")
