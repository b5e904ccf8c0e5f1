"""Recording a tracker on a grid: each point is synced to disk, and an interrupted recording can be resumed."""

import csv
import fcntl
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import dist, inf
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError, RunError
from flexneedle.interrupts import delay_signals
from flexneedle.lab.tables.columns import COLUMNS
from flexneedle.lab.tracker_evaluation.recording.grid import GridStop, StageGrid
from flexneedle.ports import Clock, Tracker
from flexneedle.types import VISIBLE, Frame, Point, SensorReading

EXTRA = ("time_s", "frame_number", "repeat")
"""Further columns than in a table of measurements. Times continue over interruptions."""
_HEADER = (*COLUMNS, *EXTRA)
_FIRST_LINE = ",".join(_HEADER).encode() + b"\n"
_PAUSE_S = 0.01
_LIMIT_MM, _SHARE = 5.0, 0.2
"""Distances may differ by 5 mm or 20 % of the stage's: twice the worst error of a working tracker."""
_SILENT_S = 1.0  # time without a (good) frame after which it is reported


def _refuse(mismatch: str) -> bool:
    raise RunError(f"{mismatch} (use --force to record the point anyway)")


@dataclass(frozen=True)
class StageOperator:
    """Moves the stage. move: moves it to a stop and returns when it has arrived; report: prints a line.

    retries: a failed point is measured again instead of ending the recording. accepts: called with a message if a
    sensor did not move as the stage did; True keeps the point, False measures it again; may raise RunError.
    """

    move: Callable[[GridStop], None]
    report: Callable[[str], None]
    retries: bool = True
    accepts: Callable[[str], bool] = _refuse


@dataclass(frozen=True)
class StageVisit:
    """A stop and the mean position of each sensor at it (mm, tracker's frame)."""

    stop: GridStop
    means: Mapping[str, Point]


@dataclass
class RecordingSession:
    """An open, locked table and its remaining stops.

    size: number of valid bytes, after which rows are appended; done: number of recorded stops; last_time: last time in
    the table (s); last: its last stop, if any.
    """

    file: BinaryIO
    size: int
    remaining: Sequence[GridStop]
    done: int
    last_time: float
    last: StageVisit | None

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Append the rows of a stop and sync them to disk."""
        data = _format_rows(rows) if self.size else _FIRST_LINE + _format_rows(rows)
        with delay_signals():
            self.file.truncate(self.size)
            self.file.write(data)
            self.file.flush()
            os.fsync(self.file.fileno())
            self.size += len(data)


@contextmanager
def open_session(path: Path, grid: StageGrid) -> Iterator[RecordingSession]:
    """Open a new or partial table with the remaining stops.

    The rows of an incomplete stop are dropped when new rows are appended (at once if no stop remains), and the stop is
    measured again. Until then the file is unchanged. A new file without rows is removed at the end.
    Raises InputError if the table belongs to another grid, is damaged or locked.
    """
    if path.suffix == ".parquet":
        raise InputError(f"{path}: the output is CSV: use a name that ends in .csv")
    try:
        new = not path.exists()
        file = path.open("a+b")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{path}: another process is writing this file") from None
        session = _resume(path, file, grid)
        try:
            yield session
        finally:
            if new and not session.size:
                path.unlink(missing_ok=True)


def record_grid(
    session: RecordingSession, tracker: Tracker, clock: Clock, grid: StageGrid, operator: StageOperator
) -> int:
    """Measure the remaining stops and return their number.

    Raises InputError if the tracker lacks a sensor of the grid; RunError if it sends no frames, or if a point cannot be
    measured and the operator does not retry.
    """
    if session.remaining:
        _check_sensors(tracker, clock, grid, operator.report)
    start, before = session.last_time, session.last
    for stop in session.remaining:
        frames, before = _measure(tracker, clock, grid, operator, stop, before)
        session.add([row for frame in frames for row in _make_rows(grid, stop, frame, start)])
    return len(session.remaining)


def _check_sensors(tracker: Tracker, clock: Clock, grid: StageGrid, report: Callable[[str], None]) -> None:
    """Check, before the stage is moved, that the first frame has the grid's sensors."""
    frames = next(filter(None, _read_frames(tracker, clock, grid.file.rest.timeout_s, report)), ())
    if not frames:
        raise RunError(f"no frames within {grid.file.rest.timeout_s:g} s: {tracker.status}")
    present = frames[-1].readings
    for name in grid.file.sensors:
        if name not in present:
            raise InputError(f"sensors.{name}: the tracker has no such sensor; it has {', '.join(present)}")


def _read_frames(
    tracker: Tracker, clock: Clock, seconds: float, report: Callable[[str], None]
) -> Iterator[tuple[Frame, ...]]:
    """Yield new frames for a number of seconds; report when they stop and when they resume."""
    began = last = clock.now()
    while (now := clock.now()) - began <= seconds:
        frames = tracker.read()
        if frames and last == inf:
            report("frames resumed")
        if frames:
            last = now
        elif now - last > _SILENT_S:
            report(f"no frames: {tracker.status}")
            last = inf  # reported
        yield frames
        clock.wait(_PAUSE_S)


def _measure(
    tracker: Tracker,
    clock: Clock,
    grid: StageGrid,
    operator: StageOperator,
    stop: GridStop,
    before: StageVisit | None,
) -> tuple[list[Frame], StageVisit]:
    operator.move(stop)
    while True:
        clock.wait(grid.file.settle_s)
        frames, fault = _collect_samples(tracker, clock, grid, operator.report)
        if not fault:
            visit = _make_visit(grid, stop, frames)
            mismatch = "" if before is None else _find_mismatch(before, visit)
            if not mismatch or operator.accepts(mismatch):
                return frames, visit
            continue
        if not operator.retries:
            raise RunError(f"point {stop.point_id}, repeat {stop.repeat}: {fault}")
        operator.report(f"{fault}; retrying")
        operator.move(stop)


def _collect_samples(
    tracker: Tracker, clock: Clock, grid: StageGrid, report: Callable[[str], None]
) -> tuple[list[Frame], str]:
    """Return the new frames of a point at rest, and "" or the fault that prevents them; report the cause of a wait.

    While the stage drifts, new frames replace the oldest ones.
    """
    began, wanted, sensors = clock.now(), grid.file.samples, tuple(grid.file.sensors)
    good: list[Frame] = []
    last_fault, reported, good_at = "no frames", "", began
    for frames in _read_frames(tracker, clock, grid.file.rest.timeout_s, report):
        for frame in frames:
            if frame.time < began:
                continue
            fault = _find_faults(frame, sensors)
            last_fault, good_at = fault or last_fault, good_at if fault else frame.time
            if fault != reported and frame.time - good_at > _SILENT_S:
                report(f"waiting: {fault}")
                reported = fault
            good = good if fault else [*good, frame][-wanted:]
            if not fault and len(good) == wanted:
                last_fault = _find_drift(good, sensors, grid.file.rest.drift_mm)
                if not last_fault:
                    return good, ""
        last_fault = last_fault if tracker.status == VISIBLE else tracker.status
    return [], f"no {wanted} good samples within {grid.file.rest.timeout_s:g} s: {last_fault}"


def _find_faults(frame: Frame, sensors: Sequence[str]) -> str:
    absent = SensorReading(None, status="no such sensor")
    found = {name: frame.readings.get(name, absent) for name in sensors}
    return "; ".join(f"{name}: {reading.fault}" for name, reading in found.items() if reading.fault)


def _find_drift(frames: Sequence[Frame], sensors: Sequence[str], limit: float) -> str:
    """Return a message on the first sensor whose first and last third of samples differ in their means; "" if none."""
    third = max(1, len(frames) // 3)
    for name in sensors:
        positions = _stack_positions(frames, name)
        drift = dist(positions[:third].mean(axis=0), positions[-third:].mean(axis=0))
        if drift > limit:
            return f"{name} drifts by {drift:.2f} mm from the first to the last third of samples, limit {limit:.2f} mm"
    return ""


def _stack_positions(frames: Sequence[Frame], name: str) -> NDArray[np.float64]:
    return np.array([frame.readings[name].position for frame in frames], dtype=float)


def _make_visit(grid: StageGrid, stop: GridStop, frames: Sequence[Frame]) -> StageVisit:
    return StageVisit(
        stop, {sensor: _average(_stack_positions(frames, name)) for name, sensor in grid.file.sensors.items()}
    )


def _find_mismatch(before: StageVisit, after: StageVisit) -> str:
    """Return a message on the first sensor that did not move as far as the stage; "" if all did.

    Only distances are compared, which needs no common frame.
    """
    stage = dist(before.stop.position, after.stop.position)
    limit = max(_LIMIT_MM, _SHARE * stage)
    for name, position in after.means.items():
        moved = dist(before.means[name], position)
        if abs(moved - stage) > limit:
            return (
                f"{name} moved {moved:.1f} mm from point {before.stop.point_id} to point {after.stop.point_id}, "
                f"the stage {stage:.1f} mm: the difference must be at most {limit:.1f} mm"
            )
    return ""


def _average(positions: NDArray[np.float64]) -> Point:
    x, y, z = map(float, positions.mean(axis=0))
    return x, y, z


def _make_rows(grid: StageGrid, stop: GridStop, frame: Frame, start: float) -> list[dict[str, Any]]:
    return [
        _make_row(stop, frame.readings[name], sensor, grid.file.environment)
        | {"time_s": start + frame.time, "frame_number": frame.number, "repeat": stop.repeat}
        for name, sensor in grid.file.sensors.items()
    ]


def _make_row(stop: GridStop, reading: SensorReading, sensor: str, environment: str) -> dict[str, Any]:
    if reading.position is None:
        raise RunError(f"{sensor}: no position")
    quaternion = reading.orientation or (None,) * 4
    return (
        {"point_id": stop.point_id, "sensor": sensor, "environment": environment}
        | dict(zip(("true_x_mm", "true_y_mm", "true_z_mm"), stop.position, strict=True))
        | dict(zip(("x_mm", "y_mm", "z_mm"), reading.position, strict=True))
        | dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True))
        | {"indicator": reading.indicator}
    )


def _format_rows(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    csv.DictWriter(text, _HEADER, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


# Continuing a table


def _resume(path: Path, file: BinaryIO, grid: StageGrid) -> RecordingSession:
    file.seek(0)
    data = file.read()
    stops = list(grid.stops())
    if not data.startswith(_FIRST_LINE):
        if not _FIRST_LINE.startswith(data):
            raise InputError(f"{path}: is not a table of `em record`: choose another file with --out")
        return RecordingSession(file, 0, stops, 0, 0.0, None)  # new, or truncated in its first line
    lines = data[len(_FIRST_LINE) :].splitlines(keepends=True)
    complete = (
        lines if not lines or lines[-1].endswith(b"\n") else lines[:-1]
    )  # the last one may be truncated
    size = grid.file.samples * len(grid.file.sensors)
    done = len(complete) // size
    _check_rows(path, complete, stops, grid)
    kept = len(_FIRST_LINE) + sum(map(len, complete[: done * size]))
    if done == len(stops):
        file.truncate(kept)  # nothing will be appended
    if not done:
        return RecordingSession(file, kept, stops, 0, 0.0, None)
    rows = [_parse_line(line) for line in complete[(done - 1) * size : done * size]]
    return RecordingSession(
        file, kept, stops[done:], done, float(rows[-1]["time_s"]), _restore_visit(stops[done - 1], rows)
    )


def _restore_visit(stop: GridStop, rows: Sequence[Mapping[str, str]]) -> StageVisit:
    names = {row["sensor"] for row in rows}
    return StageVisit(
        stop, {n: _average(np.array([_parse_position(r) for r in rows if r["sensor"] == n])) for n in names}
    )


def _parse_position(row: Mapping[str, str]) -> Point:
    return float(row["x_mm"]), float(row["y_mm"]), float(row["z_mm"])


def _check_rows(path: Path, lines: Sequence[bytes], stops: Sequence[GridStop], grid: StageGrid) -> None:
    size = grid.file.samples * len(grid.file.sensors)
    for number, line in enumerate(lines):
        stop = stops[number // size] if number // size < len(stops) else None
        if not _matches(line, stop, grid):
            raise InputError(
                f"{path}: line {number + 2}: does not match the grid: choose another file with --out"
            )


def _matches(line: bytes, stop: GridStop | None, grid: StageGrid) -> bool:
    fields = _parse_line(line)
    if stop is None or len(fields) != len(_HEADER):
        return False
    try:
        position = tuple(float(fields[f"true_{axis}_mm"]) for axis in "xyz")
        same = (int(fields["repeat"]), int(fields["point_id"]), position) == (
            stop.repeat,
            stop.point_id,
            stop.position,
        )
        float(fields["time_s"])
        _parse_position(fields)
    except ValueError:
        return False
    return (
        same
        and fields["environment"] == grid.file.environment
        and fields["sensor"] in grid.file.sensors.values()
    )


def _parse_line(line: bytes) -> dict[str, str]:
    values = next(csv.reader([line.decode("utf-8", "replace")]), [])
    return dict(zip(_HEADER, values, strict=False))
