"""Bags of ROS messages (MCAP, rosbag2, ROS 1) as a table: a row for each message with the tip's position."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from struct import error as StructError
from typing import Any, NamedTuple

import numpy as np

from flexneedle.errors import InputError, describe_error
from flexneedle.lab.calibration.importing.columns import Table, list_names
from flexneedle.types import Floats

TIME = " time"
"""Name of the column of times; no column of a map has a leading blank and this name."""
_MCAP, _BAG, _SQLITE = b"\x89MCAP", b"#ROSBAG", b"SQLite format 3"
_DAMAGES = StructError, TypeError, ValueError, LookupError, MemoryError, OverflowError, EOFError
"""Errors of the reader for a damaged file."""
_PART = re.compile(r"([^.\[\]]+)(?:\[([^\]]*)\])?")


class _Column(NamedTuple):
    """A column: its topic, and the path to its number in a message: fields, each with a number or a name in [ ]."""

    topic: str
    parts: tuple[tuple[str, str], ...]


def find_bag(path: Path) -> Path | None:
    """Return the path to open for a bag: a file, or the folder of rosbag2; None for another file."""
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise InputError(
                "is a folder without metadata.yaml or run.json: name a bag, a run or the files in the folder"
            )
        return path
    with path.open("rb") as file:
        start = file.read(len(_SQLITE))
    if start.startswith(_SQLITE):
        return path.parent
    return path if start.startswith((_MCAP, _BAG)) else None


def read_bag(path: Path, names: Sequence[str]) -> Table:
    """Return columns TOPIC.FIELD.FIELD, as /tip.pose.position.x, at the times of the messages of the first column.

    Other topics have their newest value at each time. A number in a list is FIELD[1], FIELD[2] …, or FIELD[NAME] with a
    name of the list or the child frame of a transform. Raises InputError.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error
    from rosbags.typesys import Stores, TypesysError, get_typestore

    refused = AnyReaderError, Ros1Error, Ros2Error, TypesysError
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            topics = sorted({connection.topic for connection in reader.connections})
            columns = {name: _split(name, topics) for name in names}
            series = _read_series(reader, columns)
    except (*refused, *_DAMAGES) as error:
        raise InputError(f"is a damaged or unfinished bag: {describe_error(error)}") from None
    clock = series[names[0]][:, 0]
    return {TIME: clock} | {name: _newest(values, clock) for name, values in series.items()}


def _split(name: str, topics: Collection[str]) -> _Column:
    """Return the topic and the path of a column."""
    topic = max((each for each in topics if name.startswith(f"{each}.")), key=len, default="")
    if not topic:
        raise InputError(f"has no topic of the column {name!r}; it has {list_names(topics)}")
    rest = name[len(topic) + 1 :]
    return _Column(topic, tuple((found[1], found[2] or "") for found in _PART.finditer(rest)))


def _read_series(reader: Any, columns: dict[str, _Column]) -> dict[str, Floats]:
    """Return times (s) and values (r, 2) of each column, in the order of time."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in columns}
    topics = {column.topic for column in columns.values()}
    chosen = [connection for connection in reader.connections if connection.topic in topics]
    for connection, stamp, raw in reader.messages(chosen):
        message = reader.deserialize(raw, connection.msgtype)
        for name, column in columns.items():
            if column.topic == connection.topic:
                value = _value(message, column, name)
                if value is not None:
                    found[name].append((1e-9 * stamp, value))
    for name, rows in found.items():
        if not rows:
            raise InputError(f"has no message with {name!r}")
    return {name: np.array(rows) for name, rows in found.items()}


def _value(message: Any, column: _Column, name: str) -> float | None:
    """Return a number of a message; None if it has no such name, as a transform of another frame."""
    value = message
    for field, index in column.parts:
        owner = value
        try:
            value = getattr(value, field)
            if index:
                place = _place(owner, value, index)
                if place is None:
                    return None
                value = value[place]
        except (AttributeError, IndexError):
            raise InputError(f"column {name!r}: no {field!r} in {_describe(owner)}") from None
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"column {name!r} is no number: {_describe(value)}") from None


def _place(owner: Any, values: Any, index: str) -> int | None:
    """Return the place of an element by number from 1, or by a name beside it or in it."""
    if index.isdigit() and index != "0":
        return int(index) - 1
    names = list(getattr(owner, "name", ())) or [getattr(each, "child_frame_id", "") for each in values]
    return names.index(index) if index in names else None


def _describe(value: Any) -> str:
    fields = [name for name in getattr(value, "__dataclass_fields__", ()) if not name.startswith("_")]
    kind = type(value).__name__.rpartition("__")[2]
    return f"{kind} with {list_names(fields)}" if fields else kind


def _newest(series: Floats, clock: Floats) -> Floats:
    """Return the newest values (r,) at times (r,), NaN before the first."""
    place = np.searchsorted(series[:, 0], clock, side="right") - 1
    return np.where(place >= 0, series[place, 1], np.nan)
