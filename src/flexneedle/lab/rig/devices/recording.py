"""A tracker's frames as a table, one row per sensor and frame, in CSV or Parquet."""

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
"""Columns of a recording. The last eight are empty where a value is not known. A table of measurements with times and
frame numbers can be read as a recording, too: `status` is optional."""

_REQUIRED = ("time_s", "frame_number", "sensor", "x_mm", "y_mm", "z_mm")
_POSITION, _ORIENTATION = ("x_mm", "y_mm", "z_mm"), ("qw", "qx", "qy", "qz")


def rows_of(frame: Frame) -> list[dict[str, Any]]:
    """Return the rows of a frame, with all digits; None for values that are not known."""
    return [
        {"time_s": frame.time, "frame_number": frame.number, "sensor": name, "status": reading.status}
        | dict(zip(_POSITION, reading.position or (None,) * 3, strict=True))
        | dict(zip(_ORIENTATION, reading.orientation or (None,) * 4, strict=True))
        | {"indicator": reading.indicator}
        for name, reading in frame.readings.items()
    ]


def read_frames(path: Path) -> tuple[Frame, ...]:
    """Return the frames of a recording in the order of their rows. Raises InputError: file, line, rule."""
    rows = _parquet_rows(path) if path.suffix == ".parquet" else _csv_rows(path)
    together = groupby(enumerate(rows, 2), key=lambda row: (row[1].get("time_s"), row[1].get("frame_number")))
    frames = tuple(_frame(path, [*group]) for _, group in together)
    if not frames:
        raise InputError(f"{path}: contains no frames")
    backwards = next((n for n in range(1, len(frames)) if frames[n].time < frames[n - 1].time), None)
    if backwards is not None:
        raise InputError(f"{path}: frame {frames[backwards].number}: time_s must not decrease")
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
    )  # without a repeated path
    return InputError(f"{path}: cannot be read: {reason}")


def _check_columns(path: Path, columns: Iterable[str]) -> None:
    missing = [name for name in _REQUIRED if name not in set(columns)]
    if missing:
        raise InputError(
            f"{path}: no column {', '.join(missing)}; columns of a recording: {', '.join(COLUMNS)}"
        )


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
    """Return the name of a row's sensor. Raises ValueError if it is empty or a duplicate in this frame."""
    name = str(row["sensor"] or "")
    if not name:
        raise ValueError("sensor is empty")
    if name in known:
        raise ValueError(f"duplicate sensor {name} in frame {row['frame_number']}")
    return name


def _known(row: Mapping[str, Any], column: str) -> float:
    number = _number(row, column)
    if number is None:
        raise ValueError(f"{column} is empty")
    return number


def _reading(row: Mapping[str, Any]) -> SensorReading:
    position_cells = [_number(row, name) for name in _POSITION]
    orientation_cells = [_number(row, name) for name in _ORIENTATION]
    indicator = _number(row, "indicator")
    match position_cells:
        case [float(x), float(y), float(z)]:
            status = row.get("status") or VISIBLE
            position = (x, y, z) if status == VISIBLE else None
        case _:
            status = row.get("status")
            status, position = (status if status and status != VISIBLE else "missing"), None
    match orientation_cells:
        case [float(w), float(i), float(j), float(k)]:
            return SensorReading(position, (w, i, j, k), indicator, status)
    return SensorReading(position, None, indicator, status)


def _number(row: Mapping[str, Any], column: str) -> float | None:
    """Return a number, or None for an empty cell or a missing column. Raises ValueError."""
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
