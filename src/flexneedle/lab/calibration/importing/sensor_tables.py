"""Tables of sensors along the needle beside the tip's: a reading is a row, or the rows of one time."""

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.calibration.importing.bags import TIME
from flexneedle.lab.calibration.importing.map_file import LENGTHS, RecordingMap, SensorMap, to_name
from flexneedle.lab.calibration.importing.tables import Columns, read_table
from flexneedle.lab.calibration.readings import SensorTable
from flexneedle.types import Floats, Matrix

_CURVATURES = {"1/m": 1e-3, "1/mm": 1.0}


def read_sensors(path: Path, recording_map: RecordingMap) -> tuple[SensorTable, ...]:
    """Return the readings of each sensor for the tip's file, on the axes of the tracker. Raises InputError."""
    return tuple(_read(each.path(path), path, each, recording_map) for each in recording_map.sensor)


def _read(path: Path, tip: Path, given: SensorMap, recording_map: RecordingMap) -> SensorTable:
    own = path == tip
    table = recording_map.table.model_copy(update={"columns": recording_map.table.columns if own else ()})
    columns = read_table(path, Columns(given.numbers, (), given.time or recording_map.time, table))
    if TIME not in columns:
        raise InputError(f"{path}: sensor {given.name} needs the time of each row: set time.columns")
    values = np.stack([_signed(columns[to_name(name)], name) for name in given.values], axis=1)
    factor = LENGTHS[given.unit] if given.position else _CURVATURES[given.curvature_unit]
    width = 3 if given.position else 2 if given.pixels else recording_map.axes
    values = (1.0 if given.pixels else factor) * values
    time = columns[TIME]
    known = np.isfinite(time)
    if not known.any():
        raise InputError(f"{path}: sensor {given.name}: no row has a time")
    rows = _by_time(time[known], values[known].reshape(known.sum(), -1, width), merged=not given.curvature)
    times, readings = zip(*rows, strict=True)
    return SensorTable(given.name, np.array(times), readings, given.within_s)


def _signed(values: Floats, name: str) -> Floats:
    return -values if name.startswith("-") else values


def _by_time(time: Floats, values: Floats, *, merged: bool) -> Iterator[tuple[float, Matrix]]:
    """Yield time and rows of each reading of values (r, points, width); merged: rows of one time are one reading.

    Points without all numbers are left out; a site without a curvature is NaN.
    """
    keys = time.tolist() if merged else [*range(len(time))]
    for _, group in groupby(range(len(time)), key=keys.__getitem__):
        places = [*group]
        rows = np.concatenate(values[places])
        if merged:
            rows = rows[np.isfinite(rows).all(axis=1)]
        yield float(time[places[0]]), tuple(map(tuple, rows.tolist())) if np.isfinite(rows).any() else ()


def in_needle_frame(table: SensorTable, given: SensorMap, frame: Rigid, origin: Floats) -> SensorTable:
    """Return readings with positions in the needle's frame, from an origin (3,) in it; others as they are."""
    if not given.position:
        return table
    moved = [frame.apply(np.array(rows)) - origin if rows else np.zeros((0, 3)) for rows in table.rows]
    return table._replace(rows=tuple(tuple(map(tuple, rows.tolist())) for rows in moved))
