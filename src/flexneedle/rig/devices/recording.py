"""A tracker's frames as a table: a row for each sensor in each frame, in CSV or Parquet."""

import csv
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from math import isfinite
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.types import VISIBLE, Frame, SensorReading

COLUMNS = (
    *("time_s", "frame_number", "sensor", "status", "x_mm", "y_mm", "z_mm"),
    *("qw", "qx", "qy", "qz", "indicator"),
)
"""Columns of a recording. The last nine are empty where nothing was known. A table of measurements can be read as a
recording, too, if it has times and frame numbers: `status` may be left out."""

_REQUIRED = ("time_s", "frame_number", "sensor", "x_mm", "y_mm", "z_mm")
_PLACE, _TURN = ("x_mm", "y_mm", "z_mm"), ("qw", "qx", "qy", "qz")


def rows_of(frame: Frame) -> list[dict[str, Any]]:
    """Return the rows of a frame, with all digits; None where nothing is known."""
    return [
        {"time_s": frame.time, "frame_number": frame.number, "sensor": name, "status": reading.status}
        | dict(zip(_PLACE, reading.position or (None,) * 3, strict=True))
        | dict(zip(_TURN, reading.orientation or (None,) * 4, strict=True))
        | {"indicator": reading.indicator}
        for name, reading in frame.readings.items()
    ]


def read_frames(path: Path) -> tuple[Frame, ...]:
    """Return the frames of a recording in the order of their rows. Raises InputError: file, line, rule."""
    rows = _parquet_rows(path) if path.suffix == ".parquet" else _csv_rows(path)
    together = groupby(enumerate(rows, 2), key=lambda row: (row[1].get("time_s"), row[1].get("frame_number")))
    frames = tuple(_frame(path, [*group]) for _, group in together)
    if not frames:
        raise InputError(f"{path}: holds no frames")
    back = next((n for n in range(1, len(frames)) if frames[n].time < frames[n - 1].time), None)
    if back is not None:
        raise InputError(f"{path}: frame {frames[back].number}: time_s goes back")
    return frames


def _csv_rows(path: Path) -> Iterator[Mapping[str, Any]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            _check_columns(path, reader.fieldnames or ())
            yield from reader
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _unreadable(path, error) from None


def _parquet_rows(path: Path) -> Iterator[Mapping[str, Any]]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None
    _check_columns(path, table.column_names)
    yield from table.to_pylist()


def _unreadable(path: Path, error: Exception) -> InputError:
    reason = (
        error.strerror if isinstance(error, OSError) and error.strerror else error
    )  # not the path once more
    return InputError(f"{path}: cannot be read: {reason}")


def _check_columns(path: Path, columns: Iterable[str]) -> None:
    missing = [name for name in _REQUIRED if name not in set(columns)]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}; a recording has {', '.join(COLUMNS)}")


def _frame(path: Path, rows: list[tuple[int, Mapping[str, Any]]]) -> Frame:
    readings: dict[str, SensorReading] = {}
    stamps = []
    for line, row in rows:
        try:
            stamps.append((_known(row, "time_s"), _known(row, "frame_number")))
            readings[_new_sensor(row, readings)] = _reading(row)
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: line {line}: {error}") from None
    time, number = stamps[0]
    return Frame(time, int(number), readings)


def _new_sensor(row: Mapping[str, Any], known: Iterable[str]) -> str:
    """Return the name of a row's sensor. Raises ValueError if there is none, or it is known in this frame."""
    name = str(row["sensor"] or "")
    if not name:
        raise ValueError("a sensor has no name")
    if name in known:
        raise ValueError(f"frame {row['frame_number']} has the sensor {name} already: each once in a frame")
    return name


def _known(row: Mapping[str, Any], column: str) -> float:
    number = _number(row, column)
    if number is None:
        raise ValueError(f"{column} is empty")
    return number


def _reading(row: Mapping[str, Any]) -> SensorReading:
    place = [_number(row, name) for name in _PLACE]
    turn = [_number(row, name) for name in _TURN]
    indicator = _number(row, "indicator")
    match place:
        case [float(x), float(y), float(z)]:
            status = row.get("status") or VISIBLE
            position = (x, y, z) if status == VISIBLE else None
        case _:
            told = row.get("status")
            status, position = (told if told and told != VISIBLE else "missing"), None
    match turn:
        case [float(w), float(i), float(j), float(k)]:
            return SensorReading(position, (w, i, j, k), indicator, status)
    return SensorReading(position, None, indicator, status)


def _number(row: Mapping[str, Any], column: str) -> float | None:
    """Return a number, or None for an empty cell or a column that is not there. Raises ValueError."""
    value = row.get(column)
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except ValueError:
        raise ValueError(f"{column} = {value}: must be a number, with a decimal point") from None
    if not isfinite(number):
        raise ValueError(f"{column} = {value}: must be finite")
    return number
