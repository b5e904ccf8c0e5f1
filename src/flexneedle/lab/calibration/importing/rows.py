"""Rows of recorded insertions, in the axes of the tracker."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.bags import TIME
from flexneedle.lab.calibration.importing.columns import Table
from flexneedle.lab.calibration.importing.map_file import ANGLES, LENGTHS, RecordingMap, StageMap, to_name
from flexneedle.lab.calibration.importing.sensor_tables import read_sensors
from flexneedle.lab.calibration.importing.tables import Columns, read_table
from flexneedle.lab.calibration.readings import SensorTable
from flexneedle.types import Floats

UNIT_LENGTH = 0.02
"""Tolerance on the length of a quaternion or an axis."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of an insertion; missing numbers are NaN.

    Attributes:
        source: File, and insertion in it, for messages.
        session: Name of the session.
        name: Name of the insertion.
        time: Times (r,) in s.
        position: Position (r, 3) of the tip, mm.
        axis: Needle's axis (r, 3), a unit vector.
        angle: Angles (r, 2) of the needle towards y and z of its frame, rad; NaN if the axis gives them.
        guide: Position (r, 3) of the guide, mm, in the axes of the tracker or the needle's frame, as mapped.
        base: Position (r, 3) of the base.
        roll: Angle (r,) of the needle, rad.
        sensors: Readings of sensors along the needle in the file.
    """

    source: str
    session: str
    name: str
    time: Floats
    position: Floats
    axis: Floats
    angle: Floats
    guide: Floats
    base: Floats
    roll: Floats
    sensors: tuple[SensorTable, ...] = ()

    @property
    def table(self) -> Floats:
        """All numbers (r, c), by columns."""
        return np.column_stack([getattr(self, name) for name in _ARRAYS])

    def with_table(self, table: Floats) -> "Rows":
        """Return the rows of a table (k, c)."""
        parts = np.split(table, np.cumsum([*_ARRAYS.values()])[:-1], axis=1)
        arrays: Any = {
            name: part if size > 1 else part[:, 0]
            for (name, size), part in zip(_ARRAYS.items(), parts, strict=True)
        }
        return replace(self, **arrays)

    def choose(self, part: Any) -> "Rows":
        """Return some of the rows."""
        return replace(self, **{name: getattr(self, name)[part] for name in _ARRAYS})


_ARRAYS = {"time": 1, "position": 3, "axis": 3, "angle": 2, "guide": 3, "base": 3, "roll": 1}
"""Columns of each array."""


def read_rows(path: Path, session: str, recording_map: RecordingMap) -> Iterator[Rows]:
    """Yield the rows of each insertion of a file; session: name of the session unless columns name it.

    Raises InputError.
    """
    table, tip = recording_map.table, recording_map.tip
    columns = read_table(path, Columns(recording_map.numbers, recording_map.text, recording_map.time, table))
    try:
        whole = _whole(columns, recording_map)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    kept = np.ones(len(columns[to_name(tip.position[0])]), dtype=bool)
    for name, value in table.where.items():
        kept &= columns[name] == value
    if not kept.any():
        raise InputError(f"{path}: no row has {' and '.join(f'{k} = {v!r}' for k, v in table.where.items())}")
    labels = [_labels(columns, names, kept) for names in (table.session, table.insertion)]
    sensors = read_sensors(path, recording_map)
    rows = replace(whole.choose(kept), session=session, name=path.stem, source=str(path), sensors=sensors)
    yield from _divide(rows, *labels)


def _labels(columns: Table, names: Sequence[str], kept: Any) -> Any:
    """Return the text (r,) of columns joined by slashes; None without columns."""
    if not names:
        return None
    first, *others = (columns[name][kept] for name in names)
    for other in others:
        first = np.char.add(np.char.add(first, "/"), other)
    return first


def _divide(rows: Rows, sessions: Any, insertions: Any) -> Iterator[Rows]:
    """Yield the rows of each insertion. Raises InputError unless its rows are together."""
    if sessions is None and insertions is None:
        yield rows
        return
    size = len(rows.time)
    sessions = np.full(size, rows.session) if sessions is None else sessions
    insertions = np.full(size, rows.name) if insertions is None else insertions
    changes = np.flatnonzero((sessions[1:] != sessions[:-1]) | (insertions[1:] != insertions[:-1])) + 1
    begun = set[tuple[str, str]]()
    for begin, end in zip((0, *changes.tolist()), (*changes.tolist(), size), strict=True):
        key = str(sessions[begin]), str(insertions[begin])
        source = f"{rows.source}: insertion {key[1]}"
        if not all(key):
            raise InputError(f"{rows.source}: row {begin + 1}: names no insertion")
        if key in begun:
            raise InputError(f"{source}: its rows are not together: sort the file, or check table.insertion")
        begun.add(key)
        yield replace(rows.choose(slice(begin, end)), source=source, session=key[0], name=key[1])


def _whole(columns: Table, recording_map: RecordingMap) -> Rows:
    tip, roll = recording_map.tip, recording_map.roll
    count = len(columns[to_name(tip.position[0])])
    position = LENGTHS[tip.unit] * _vectors(columns, tip.position)
    for code in recording_map.table.missing:
        position[np.all([columns[to_name(name)] == code for name in tip.position], axis=0)] = np.nan
    if tip.status:
        measured = np.isin(np.char.lower(columns[tip.status]), [each.lower() for each in tip.ok])
        position[~measured] = np.nan
    axis, angle = np.full((count, 3), np.nan), np.full((count, 2), np.nan)
    if tip.axis is not None:
        axis = _vectors(columns, tip.axis)
        _check_length(axis, "the needle's axis")
    if tip.quaternion is not None:
        quaternions = np.stack([signed(columns, name) for name in tip.quaternion], axis=1)
        position[(quaternions == 0.0).all(axis=1)] = np.nan
        axis = axis_of(quaternions, tip.order, tip.sensor_axis)
    if tip.angle is not None:
        given = ANGLES[tip.angle_unit] * np.stack([signed(columns, name) for name in tip.angle], axis=1)
        angle[:, : len(tip.angle)] = given
    turned = np.zeros(count) if roll is None else ANGLES[roll.unit] * _hold(signed(columns, roll.column))
    time = columns.get(TIME, np.full(count, np.nan))
    guide, base = (_stage(columns, each, count) for each in (recording_map.guide, recording_map.base))
    return Rows("", "", "", time, position, axis, angle, guide, base, turned)


def signed(columns: Table, name: str) -> Floats:
    """Return a column with the sign before its name."""
    values: Floats = columns[to_name(name)]
    return -values if name.startswith("-") else values


def _vectors(columns: Table, names: Sequence[str]) -> Floats:
    """Return vectors (r, 3); a third number that is not given is 0."""
    found = [signed(columns, name) for name in names]
    return np.stack([*found, *[np.zeros(len(found[0]))] * (3 - len(found))], axis=1)


def _stage(columns: Table, given: StageMap | None, count: int) -> Floats:
    """Return positions (r, 3) of a stage, 0 along axes that are not given; an empty cell repeats the value before."""
    if given is None:
        return np.zeros((count, 3))
    if given.position is not None:
        return LENGTHS[given.unit] * _hold(_vectors(columns, given.position))
    sides = [np.zeros(count) if name is None else signed(columns, name) for name in (None, given.y, given.z)]
    return LENGTHS[given.unit] * _hold(np.stack(sides, axis=1))


def _hold(values: Floats) -> Floats:
    """Return values (r, …) with the last known one where one is missing; NaN before the first."""
    known = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
    held: Floats = values[last]
    return held


def axis_of(quaternions: Floats, order: str, sensor_axis: str) -> Floats:
    """Return the direction (r, 3) of an axis of the sensor for unit quaternions (r, 4); 0 is missing.

    Raises InputError for another length.
    """
    w, x, y, z = (quaternions if order == "wxyz" else np.roll(quaternions, 1, axis=1)).T
    _check_length(
        np.where((quaternions == 0.0).all(axis=1, keepdims=True), np.nan, quaternions), "the quaternion"
    )
    columns = {
        "x": (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        "y": (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        "z": (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    }
    turned = np.stack(columns[sensor_axis[-1]], axis=1)
    return -turned if sensor_axis.startswith("-") else turned


def _check_length(vectors: Floats, what: str) -> None:
    """Raise InputError for the first vector or quaternion whose length is not 1."""
    length = np.linalg.norm(vectors, axis=1)
    wrong = np.abs(length - 1.0) > UNIT_LENGTH
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(
            f"row {row + 1}: {what} must have the length 1, not {length[row]:.3g}: check its columns"
        )
