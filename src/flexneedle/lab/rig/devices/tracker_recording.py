"""A tracker's frames as a table, one row per sensor and frame."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from math import isnan
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.tables.row_rules import INDICATORS, ORIENTATIONS, POSITIONS, require_numbers, require_text
from flexneedle.lab.tables.sample_table import NO_STATUS, SampleTable, open_table
from flexneedle.types import VISIBLE, Frame, SensorReading

COLUMNS = (
    *("time_s", "frame_number", "sensor", "status", "x_mm", "y_mm", "z_mm"),
    *("qw", "qx", "qy", "qz", "indicator"),
)
"""Columns of a recording. The last eight are empty where a value is not known. A table of measurements with times and
frame numbers can be read as a recording, too: `status` is optional."""

_REQUIRED = ("time_s", "frame_number", "sensor", "x_mm", "y_mm", "z_mm")
_POSITION, _ORIENTATION = ("x_mm", "y_mm", "z_mm"), ("qw", "qx", "qy", "qz")
_RULES = (
    *require_numbers("time_s", "frame_number"),
    *require_text("sensor"),
    *POSITIONS,
    *ORIENTATIONS,
    *INDICATORS,
)

_Row = dict[str, Any]


def rows_of(frame: Frame) -> list[_Row]:
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
    optional = [name for name in COLUMNS if name not in _REQUIRED]
    with open_table(path, _REQUIRED, optional) as table:
        table.refuse(_RULES)
        columns = table.arrays(f"SELECT {', '.join(COLUMNS)} FROM samples")
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return _frames(table, [dict(zip(columns, row, strict=True)) for row in rows])


def _frames(table: SampleTable, rows: Sequence[_Row]) -> tuple[Frame, ...]:
    frames: list[Frame] = []
    numbered = enumerate(rows, 1)
    for (time, number), group in groupby(
        numbered, key=lambda row: (row[1]["time_s"], row[1]["frame_number"])
    ):
        readings: dict[str, SensorReading] = {}
        for position, row in group:
            if row["sensor"] in readings:
                raise InputError(
                    f"{table.find_row(position)}: duplicate sensor {row['sensor']} in frame {number:g}"
                )
            readings[row["sensor"]] = _reading(row)
        if frames and time < frames[-1].time:
            raise InputError(f"frame {number:g}: time_s must not decrease")
        frames.append(Frame(time, int(number), readings))
    if not frames:
        raise InputError("contains no frames")
    return tuple(frames)


def _reading(row: _Row) -> SensorReading:
    position, orientation = _none_if_empty(row, _POSITION), _none_if_empty(row, _ORIENTATION)
    indicator = None if isnan(row["indicator"]) else row["indicator"]
    status = VISIBLE if row["status"].lower() in (VISIBLE, *NO_STATUS) else row["status"]
    if position is None and status == VISIBLE:
        status = "missing"
    return SensorReading(position, orientation, indicator, status)


def _none_if_empty(row: _Row, names: Iterable[str]) -> Any:
    """Return the numbers, None if they are empty."""
    numbers = tuple(row[name] for name in names)
    return None if isnan(numbers[0]) else numbers
