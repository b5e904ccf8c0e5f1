"""Recording a tracker on a grid: point by point onto the disk, continued there after any interruption."""

import csv
import fcntl
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import dist, hypot, inf
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.recording.grid import Grid, Stop
from flexneedle.em.recording.steps import Visit, disagreement
from flexneedle.errors import InputError, RunError
from flexneedle.rig.ports import Clock, Tracker
from flexneedle.rig.tracking.table import COLUMNS
from flexneedle.trace.files import uninterrupted
from flexneedle.types import VISIBLE, Frame, Point, SensorReading

EXTRA = ("time_s", "frame_number", "repeat")
"""Columns beside those of a table of measurements. Times continue over interruptions."""
_HEADER = (*COLUMNS, *EXTRA)
_FIRST_LINE = ",".join(_HEADER).encode() + b"\n"
_PAUSE_S = 0.01
_SILENT_S = 1.0  # without a frame, or a good one, until it is reported


def _refuse(doubt: str) -> bool:
    raise RunError(f"{doubt} (use --force to record it)")


@dataclass(frozen=True)
class Guide:
    """Who moves the stage. ask: moves it to a stop, returns when it is there; report: prints a line.

    insists: whether a point that failed is asked for again, or ends the recording. keeps: of a sensor that did not move
    as the stage did, returns whether the point is kept, or measured again, or raises RunError.
    """

    ask: Callable[[Stop], None]
    report: Callable[[str], None]
    insists: bool = True
    keeps: Callable[[str], bool] = _refuse


@dataclass
class Session:
    """An open table, locked, and the stops that it has no rows of yet. size: of what is kept of it, bytes; it is
    written from there. last_time: the last time in it, s; last: its last stop, if it has any."""

    file: BinaryIO
    size: int
    left: Sequence[Stop]
    done: int
    last_time: float
    last: Visit | None

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add the rows of a stop, and return when they are on the disk."""
        data = _text(rows) if self.size else _FIRST_LINE + _text(rows)
        with uninterrupted():
            self.file.truncate(self.size)
            self.file.write(data)
            self.file.flush()
            os.fsync(self.file.fileno())
            self.size += len(data)


@contextmanager
def open_session(path: Path, grid: Grid) -> Iterator[Session]:
    """Open a table, new or begun, with the stops that are left.

    Rows of a stop that are not all there are dropped with the first that are added (at once if no stop is left): it
    is measured again. Until then the table stays as it was, and a new one without rows is removed in the end.
    Raises InputError if the table is another grid's, is damaged, or is being written.
    """
    if path.suffix == ".parquet":
        raise InputError(f"{path}: a CSV is written: give a name that ends in .csv")
    try:
        new = not path.exists()
        file = path.open("a+b")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{path}: another process is writing it") from None
        session = _resumed(path, file, grid)
        try:
            yield session
        finally:
            if new and not session.size:
                path.unlink(missing_ok=True)


def record(session: Session, tracker: Tracker, clock: Clock, grid: Grid, guide: Guide) -> int:
    """Measure the stops that are left and return their number.

    Raises InputError if the tracker lacks a sensor of the grid, RunError if it reports nothing, or if a point cannot be
    measured and the guide does not insist.
    """
    if session.left:
        _check_sensors(tracker, clock, grid, guide.report)
    start, before = session.last_time, session.last
    for stop in session.left:
        frames, before = _measure(tracker, clock, grid, guide, stop, before)
        session.add([row for frame in frames for row in _rows(grid, stop, frame, start)])
    return len(session.left)


def _check_sensors(tracker: Tracker, clock: Clock, grid: Grid, report: Callable[[str], None]) -> None:
    """Before the stage is moved: check that the first frame has the grid's sensors."""
    frames = next(filter(None, _arriving(tracker, clock, grid.file.rest.timeout_s, report)), ())
    if not frames:
        raise RunError(f"no frames within {grid.file.rest.timeout_s:g} s: {tracker.status}")
    there = frames[-1].readings
    for name in grid.file.sensors:
        if name not in there:
            raise InputError(f"sensors.{name}: the tracker has no such sensor; it has {', '.join(there)}")


def _arriving(
    tracker: Tracker, clock: Clock, seconds: float, report: Callable[[str], None]
) -> Iterator[tuple[Frame, ...]]:
    """Yield new frames for a number of seconds; report when none arrive, and when they do again."""
    began = last = clock.now()
    while (now := clock.now()) - began <= seconds:
        frames = tracker.read()
        if frames and last == inf:
            report("frames arrive again")
        if frames:
            last = now
        elif now - last > _SILENT_S:
            report(f"no frames: {tracker.status}")
            last = inf  # reported
        yield frames
        clock.wait(_PAUSE_S)


def _measure(
    tracker: Tracker, clock: Clock, grid: Grid, guide: Guide, stop: Stop, before: Visit | None
) -> tuple[list[Frame], Visit]:
    guide.ask(stop)
    while True:
        clock.wait(grid.file.settle_s)
        frames, complaint = _samples(tracker, clock, grid, guide.report)
        if not complaint:
            visit = _visit(grid, stop, frames)
            doubt = "" if before is None else disagreement(before, visit)
            if not doubt or guide.keeps(doubt):
                return frames, visit
            continue
        if not guide.insists:
            raise RunError(f"point {stop.point_id}, repeat {stop.repeat}: {complaint}")
        guide.report(f"{complaint}; measured again")
        guide.ask(stop)


def _samples(
    tracker: Tracker, clock: Clock, grid: Grid, report: Callable[[str], None]
) -> tuple[list[Frame], str]:
    """Return the frames of a point at rest, taken from now on, or what is wrong; report what is waited for.

    While the stage drifts the oldest frames are dropped for new ones.
    """
    began, wanted, sensors = clock.now(), grid.file.samples, tuple(grid.file.sensors)
    good: list[Frame] = []
    complaint, reported, good_at = "no frames", "", began
    for frames in _arriving(tracker, clock, grid.file.rest.timeout_s, report):
        for frame in frames:
            if frame.time < began:
                continue
            fault = _faults(frame, sensors)
            complaint, good_at = fault or complaint, good_at if fault else frame.time
            if fault != reported and frame.time - good_at > _SILENT_S:
                report(f"waiting: {fault}")
                reported = fault
            good = good if fault else [*good, frame][-wanted:]
            if not fault and len(good) == wanted:
                complaint = _drifting(good, sensors, grid.file.rest.drift_mm)
                if not complaint:
                    return good, ""
        complaint = complaint if tracker.status == VISIBLE else tracker.status
    return [], f"no {wanted} good samples within {grid.file.rest.timeout_s:g} s: {complaint}"


def _faults(frame: Frame, sensors: Sequence[str]) -> str:
    absent = SensorReading(None, status="no such sensor")
    found = {name: frame.readings.get(name, absent) for name in sensors}
    return "; ".join(
        f"{name}: {reading.status}" for name, reading in found.items() if reading.position is None
    )


def _drifting(frames: Sequence[Frame], sensors: Sequence[str], limit: float) -> str:
    """Return which sensor moves, by the means of the first and the last third of its samples; "" if none does."""
    third = max(1, len(frames) // 3)
    for name in sensors:
        places = _places(frames, name)
        drift = dist(places[:third].mean(axis=0), places[-third:].mean(axis=0))
        if drift > limit:
            return f"{name} moves: {drift:.2f} mm from the first to the last third, limit {limit:g} mm"
    return ""


def _places(frames: Sequence[Frame], name: str) -> NDArray[np.float64]:
    return np.array([frame.readings[name].position for frame in frames], dtype=float)


def _visit(grid: Grid, stop: Stop, frames: Sequence[Frame]) -> Visit:
    return Visit(stop, {sensor: _mean(_places(frames, name)) for name, sensor in grid.file.sensors.items()})


def _mean(places: NDArray[np.float64]) -> Point:
    x, y, z = map(float, places.mean(axis=0))
    return x, y, z


def _rows(grid: Grid, stop: Stop, frame: Frame, start: float) -> list[dict[str, Any]]:
    return [
        _row(stop, frame.readings[name], sensor, grid.file.environment)
        | {"time_s": start + frame.time, "frame_number": frame.number, "repeat": stop.repeat}
        for name, sensor in grid.file.sensors.items()
    ]


def _row(stop: Stop, reading: SensorReading, sensor: str, environment: str) -> dict[str, Any]:
    if reading.position is None:
        raise RunError(f"{sensor}: no position")
    quaternion = reading.orientation or (None,) * 4
    return (
        {"point_id": stop.point_id, "sensor": sensor, "environment": environment}
        | dict(zip(("true_x_mm", "true_y_mm", "true_z_mm"), stop.place, strict=True))
        | dict(zip(("x_mm", "y_mm", "z_mm"), reading.position, strict=True))
        | dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True))
        # The field generator is at the origin of an Aurora's frame.
        | {"indicator": reading.indicator, "distance_mm": hypot(*reading.position)}
    )


def _text(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    csv.DictWriter(text, _HEADER, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


# Continuing a table


def _resumed(path: Path, file: BinaryIO, grid: Grid) -> Session:
    file.seek(0)
    data = file.read()
    stops = list(grid.stops())
    if not data.startswith(_FIRST_LINE):
        if not _FIRST_LINE.startswith(data):
            raise InputError(f"{path}: is no table of `em record`: name another file with --out")
        return Session(file, 0, stops, 0, 0.0, None)  # new, or cut in its first line
    lines = data[len(_FIRST_LINE) :].splitlines(keepends=True)
    whole = lines if not lines or lines[-1].endswith(b"\n") else lines[:-1]  # the last one may be cut
    size = grid.file.samples * len(grid.file.sensors)
    done = len(whole) // size
    _check_rows(path, whole, stops, grid)
    kept = len(_FIRST_LINE) + sum(map(len, whole[: done * size]))
    if done == len(stops):
        file.truncate(kept)  # nothing will be added
    if not done:
        return Session(file, kept, stops, 0, 0.0, None)
    rows = [_cells(line) for line in whole[(done - 1) * size : done * size]]
    return Session(file, kept, stops[done:], done, float(rows[-1]["time_s"]), _visited(stops[done - 1], rows))


def _visited(stop: Stop, rows: Sequence[Mapping[str, str]]) -> Visit:
    names = {row["sensor"] for row in rows}
    return Visit(stop, {n: _mean(np.array([_place(r) for r in rows if r["sensor"] == n])) for n in names})


def _place(row: Mapping[str, str]) -> Point:
    return float(row["x_mm"]), float(row["y_mm"]), float(row["z_mm"])


def _check_rows(path: Path, lines: Sequence[bytes], stops: Sequence[Stop], grid: Grid) -> None:
    size = grid.file.samples * len(grid.file.sensors)
    for number, line in enumerate(lines):
        stop = stops[number // size] if number // size < len(stops) else None
        if not _belongs(line, stop, grid):
            raise InputError(f"{path}: line {number + 2}: is not of this grid: name another file with --out")


def _belongs(line: bytes, stop: Stop | None, grid: Grid) -> bool:
    cells = _cells(line)
    if stop is None or len(cells) != len(_HEADER):
        return False
    try:
        place = tuple(float(cells[f"true_{axis}_mm"]) for axis in "xyz")
        same = (int(cells["repeat"]), int(cells["point_id"]), place) == (
            stop.repeat,
            stop.point_id,
            stop.place,
        )
        float(cells["time_s"])
        _place(cells)
    except ValueError:
        return False
    return (
        same
        and cells["environment"] == grid.file.environment
        and cells["sensor"] in grid.file.sensors.values()
    )


def _cells(line: bytes) -> dict[str, str]:
    cells = next(csv.reader([line.decode("utf-8", "replace")]), [])
    return dict(zip(_HEADER, cells, strict=False))
