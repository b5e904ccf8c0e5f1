"""Import of recordings: tables, read with a map, as steps in the needle's frame."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.lab.calibration.importing.map_file import ANGLES, LENGTHS, TIMES, RecordingMap, StageMap
from flexneedle.lab.calibration.importing.steps import mean_of, still_phases
from flexneedle.lab.calibration.importing.tables import Table, read_table
from flexneedle.lab.calibration.session import Recording, Session
from flexneedle.types import Floats

LEAST_STEPS = 4
"""Steps that an insertion has at least; shorter ones are left out."""
_STEEPEST = np.pi / 4  # between sensor and path
_UNIT_LENGTH = 0.02  # of a quaternion or an axis
_SUFFIX = re.compile(r"[_\s\[(](mm|cm|m|um|inch|rad|deg|mrad)[\])]?$")
_DEPTHS_MM = (5.0, 400.0)  # usual depths of a recording


@dataclass(frozen=True, eq=False)
class Imported:
    """A session, what was understood, and what is suspicious, line by line."""

    session: Session
    understood: tuple[str, ...]
    suspected: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of an insertion in the tracker's units and axes: time s, position mm, axis, guide mm, base mm, roll rad."""

    source: str
    session: str
    name: str
    time: Floats
    position: Floats
    axis: Floats
    guide: Floats
    base: Floats
    roll: Floats

    def choose(self, part: Any) -> "_Rows":
        """Return some of the rows."""
        arrays = (self.time, self.position, self.axis, self.guide, self.base, self.roll)
        return _Rows(self.source, self.session, self.name, *(each[part] for each in arrays))


def import_recordings(files: Sequence[Path], recording_map: RecordingMap) -> Imported:
    """Return the session of files. Raises InputError, in one line, for files that contradict themselves or the map."""
    axes = 2 if recording_map.guide is None or recording_map.guide.z else 1
    recordings, notes, seen, missing = [], list[str](), dict[tuple[str, str], Path](), []
    for path in files:
        for rows in _insertions(path, recording_map):
            key = rows.session, rows.name
            if key in seen:
                raise InputError(
                    f"{path}: insertion {rows.name} of session {rows.session} is in {seen[key]}, too"
                )
            seen[key] = path
            missing.append(np.isnan(rows.position).any(axis=1).mean())
            found = _recording(rows, recording_map, axes)
            if found is None:
                notes.append(f"{rows.source}: fewer than {LEAST_STEPS} steps: left out")
            else:
                recordings.append(found)
    if not recordings:
        raise InputError(f"{files[0] if files else 'files'}: no insertion with {LEAST_STEPS} steps or more")
    origin = {
        "files": [str(path) for path in files],
        "frame": recording_map.frame.model_dump(mode="json", exclude_none=True),
    }
    session = Session(tuple(recordings), recording_map.steps.guide, origin)
    return Imported(
        session,
        tuple(_describe(session, float(np.mean(missing)))),
        (*notes, *_suspicions(session, recording_map)),
    )


def _insertions(path: Path, recording_map: RecordingMap) -> Iterator[_Rows]:
    """Yield the rows of each insertion of a file."""
    table = recording_map.table
    text = (*table.session, *table.insertion)
    columns = read_table(path, sorted(recording_map.columns()), text, table.topics)
    count = len(next(iter(columns.values())))

    def key(names: Sequence[str], default: str) -> list[str]:
        if not names:
            return [default] * count
        return [
            "/".join(map(str, parts))
            for parts in zip(*(columns[name].tolist() for name in names), strict=True)
        ]

    keys = list(
        zip(key(table.session, path.parent.name or "session"), key(table.insertion, path.stem), strict=True)
    )
    whole = _whole(columns, recording_map, count)
    begun = set[tuple[str, str]]()
    for (session, name), group in groupby(range(count), key=keys.__getitem__):
        source = f"{path}: {name}" if table.insertion else str(path)
        if (session, name) in begun:
            raise InputError(f"{source}: its rows are not together")
        begun.add((session, name))
        yield _Rows(source, session, name, *_pick(whole, np.array([*group])))


def _pick(arrays: Sequence[Floats], rows: Any) -> list[Floats]:
    return [each[rows] for each in arrays]


def _whole(columns: Table, recording_map: RecordingMap, count: int) -> list[Floats]:
    """Return time, position, axis, guide, base and roll of all rows."""

    def signed(name: str) -> Floats:
        values: Floats = columns[name.lstrip("+-")]
        return -values if name.startswith("-") else values

    def stage(given: StageMap | None) -> Floats:
        if given is None:
            return np.zeros((count, 2))
        sides = [signed(given.y), signed(given.z) if given.z else np.zeros(count)]
        return LENGTHS[given.unit] * np.stack(sides, axis=1)

    times, tip = recording_map.time, recording_map.tip
    time = np.full(count, np.nan)
    if len(times.columns) == 1:
        time = TIMES[times.unit] * signed(times.columns[0])
    elif times.columns:
        time = signed(times.columns[0]) + 1e-9 * signed(times.columns[1])
    position = LENGTHS[tip.unit] * np.stack([signed(name) for name in tip.position], axis=1)
    axis = np.full((count, 3), np.nan)
    if tip.axis is not None:
        axis = np.stack([signed(name) for name in tip.axis], axis=1)
    elif tip.quaternion is not None:
        axis = _axis_of(
            np.stack([signed(name) for name in tip.quaternion], axis=1), tip.order, tip.sensor_axis
        )
    roll = np.zeros(count)
    if recording_map.roll is not None:
        roll = ANGLES[recording_map.roll.unit] * signed(recording_map.roll.column)
    return [time, position, axis, stage(recording_map.guide), stage(recording_map.base), roll]


def _axis_of(quaternions: Floats, order: str, sensor_axis: str) -> Floats:
    """Return the direction (r, 3) of an axis of the sensor. Raises InputError unless the quaternions are units."""
    size = np.linalg.norm(quaternions, axis=1)
    if (np.abs(size - 1.0) > _UNIT_LENGTH).any():
        row = int(np.flatnonzero(np.abs(size - 1.0) > _UNIT_LENGTH)[0])
        raise InputError(f"row {row + 1}: the quaternion has the length {size[row]:.3g}, not 1")
    first = quaternions if order == "wxyz" else np.roll(quaternions, 1, axis=1)
    column = "xyz".index(sensor_axis[-1])
    turned: Floats = np.array(
        [to_matrix(each)[:, column] if np.isfinite(each).all() else np.full(3, np.nan) for each in first]
    )
    return -turned if sensor_axis.startswith("-") else turned


def _recording(rows: _Rows, recording_map: RecordingMap, axes: int) -> Recording | None:
    """Return the steps of an insertion in the needle's frame; None with too few steps."""
    frame, steps = recording_map.frame, recording_map.steps
    known = np.isfinite(rows.position).all(axis=1) & np.isfinite(rows.guide).all(axis=1)
    if (np.diff(rows.time[np.isfinite(rows.time)]) < 0.0).any():
        raise InputError(f"{rows.source}: time runs backwards")
    rows = rows.choose(known)
    if len(rows.position) < LEAST_STEPS:
        return None
    jumps = np.linalg.norm(np.diff(rows.position, axis=0), axis=1)
    if jumps.max() > steps.gap_mm:
        raise InputError(
            f"{rows.source}: the tip jumps by {jumps.max():.4g} mm between two rows (steps.gap_mm = {steps.gap_mm:g}): check unit and columns"
        )
    if steps.rows == "stream":
        if not np.isfinite(rows.time).all():
            raise InputError(f"{rows.source}: a stream needs times: set time.columns")
        phases = still_phases(rows.time, rows.position, rows.guide, steps.least_still_s)
        if len(phases) < LEAST_STEPS:
            return None
        parts = (rows.time, rows.position, rows.axis, rows.guide, rows.base, rows.roll)
        rows = _Rows(rows.source, rows.session, rows.name, *(mean_of(phases, each) for each in parts))
    rotation = frame.rotation
    if frame.registration is not None:
        turn = to_matrix(np.array(frame.registration.rotation))
        position = (rows.position @ turn.T + np.array(frame.registration.translation_mm)) @ rotation.T
        rotation = rotation @ turn
    else:
        position = rows.position @ rotation.T
    depth = position[:, 0] - (
        position[0, 0] - frame.first_depth_mm if frame.skin_mm is None else frame.skin_mm
    )
    if depth.max() - depth[0] < 0.5 * np.ptp(position, axis=0).max():
        raise InputError(
            f"{rows.source}: the tip advances {depth.max() - depth[0]:.3g} mm along x = {frame.x}, and more along another axis: check frame.x"
        )
    across = position[:, 1 : 1 + axes]
    return Recording(
        rows.session, rows.name, rows.time, depth, across - across[0], _slopes(rows, rotation, position)[:, :axes],
        (rows.guide - rows.guide[0])[:, :axes], (rows.base - rows.base[0])[:, :axes], rows.roll,
    )  # fmt: skip


def _slopes(rows: _Rows, rotation: Floats, position: Floats) -> Floats:
    """Return dy/dx, dz/dx (k, 2) of the sensor's axis. Raises InputError if it is not along the path."""
    axis = rows.axis @ rotation.T
    size = np.linalg.norm(axis, axis=1)
    if (np.abs(size[np.isfinite(size)] - 1.0) > _UNIT_LENGTH).any():
        raise InputError(f"{rows.source}: the needle's axis must be a unit vector")
    path = position[-1] - position[0]
    mean = np.nanmean(axis, axis=0) if np.isfinite(axis).any() else path
    angle = np.arccos(np.clip(mean @ path / (np.linalg.norm(mean) * np.linalg.norm(path)), -1.0, 1.0))
    if angle > _STEEPEST:
        raise InputError(
            f"{rows.source}: the sensor's axis is {np.degrees(angle):.0f}° off the path: check tip.axis, or tip.order and tip.sensor_axis"
        )
    slopes: Floats = axis[:, 1:] / axis[:, :1]
    return slopes


def _describe(session: Session, missing: float) -> Iterator[str]:
    """Yield what was understood."""
    steps = [len(one.depth) for one in session.recordings]
    yield (
        f"{len(session.recordings)} insertions in {len(session.names)} sessions, {min(steps)} to {max(steps)} steps each, "
        f"{100.0 * missing:.3g} % of the rows without a position"
    )
    depth = np.concatenate([one.depth for one in session.recordings])
    across = np.concatenate([one.position for one in session.recordings])
    guide = np.array([one.guide_moves for one in session.recordings])
    slope = np.concatenate([one.slope for one in session.recordings])
    yield f"depth {depth.min():.4g} to {depth.max():.4g} mm, lateral offset {across.min():.3g} to {across.max():.3g} mm"
    if np.isfinite(slope).any():
        yield f"slope of the sensor {1e3 * np.nanmin(slope):.3g} to {1e3 * np.nanmax(slope):.3g} mrad"
    else:
        yield "no slope of the sensor"
    moved = int((guide > 0.05).sum())
    yield f"the guide moves in {moved} of {len(guide)} insertions, by up to {guide.max():.3g} mm"


def _suspicions(session: Session, recording_map: RecordingMap) -> Iterator[str]:
    """Yield what may be an error of units or signs."""
    reached = np.array([np.ptp(one.depth) for one in session.recordings])
    if not _DEPTHS_MM[0] <= np.median(reached) <= _DEPTHS_MM[1]:
        yield f"the insertions are {np.median(reached):.3g} mm deep (median): check tip.unit = {recording_map.tip.unit!r}"
    for key, unit, names in _given_units(recording_map):
        for name in names:
            found = _SUFFIX.search(name)
            if found and found[1] != unit:
                yield f"column {name!r} seems to be in {found[1]}, but {key} = {unit!r}"
    moved = np.array([one.guide_moves for one in session.recordings])
    if recording_map.guide is not None and moved.max() < 0.05:
        yield "the guide never moves: check the columns of [guide]"
    if moved.max() > 100.0:
        yield f"the guide moves by {moved.max():.3g} mm: check guide.unit"
    yield from _wrong_sides(session)


def _given_units(recording_map: RecordingMap) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    yield "tip.unit", recording_map.tip.unit, recording_map.tip.position
    for name in ("guide", "base"):
        stage = getattr(recording_map, name)
        if stage is not None:
            yield f"{name}.unit", stage.unit, tuple(filter(None, (stage.y, stage.z)))
    if recording_map.roll is not None:
        yield "roll.unit", recording_map.roll.unit, (recording_map.roll.column,)


def _wrong_sides(session: Session) -> Iterator[str]:
    """Yield axes on which the sensor's slope and the path turn to opposite sides."""
    for axis, name in enumerate("yz"[: session.axes]):
        pairs = [
            (np.diff(one.slope[:, axis]), np.diff(np.diff(one.position[:, axis]) / np.diff(one.depth)))
            for one in session.recordings
            if np.isfinite(one.slope[:, axis]).all() and (np.diff(one.depth) > 0.1).all()
        ]
        if pairs:
            turns, bends = np.concatenate([a[:-1] for a, _ in pairs]), np.concatenate([b for _, b in pairs])
            if len(turns) > 20 and np.corrcoef(turns, bends)[0, 1] < -0.3:
                yield f"slope and path turn to opposite sides along {name}: check its sign"
