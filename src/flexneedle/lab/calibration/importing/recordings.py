"""Recordings of tables: the steps of their insertions in the needle's frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.calibration.importing.frames import (
    frame_with_fitted_x,
    given_frame,
    with_fitted_y,
)
from flexneedle.lab.calibration.importing.map_file import FIT, RecordingMap, StageMap
from flexneedle.lab.calibration.importing.rows import Rows, read_rows
from flexneedle.lab.calibration.importing.sensor_tables import in_needle_frame
from flexneedle.lab.calibration.importing.steps import before_retreat, find_steps, in_order
from flexneedle.lab.calibration.readings import StepReading
from flexneedle.lab.calibration.session import Recording
from flexneedle.types import Floats

LEAST_STEPS = 4
"""Steps of an insertion; insertions with fewer are left out."""
_STEEPEST = np.pi / 4  # between sensor and path


@dataclass(frozen=True, eq=False)
class Found:
    """Recordings of files, notes on them, the share of rows without a position, and fitted frames by session."""

    recordings: tuple[Recording, ...]
    notes: tuple[str, ...]
    missing: float = 0.0
    frames: dict[str, Rigid] = field(default_factory=dict)


def read_recordings(files: Sequence[tuple[Path, str]], recording_map: RecordingMap) -> Found:
    """Return the recordings of files with the names of their sessions. Raises InputError."""
    steps, notes, missing, seen = (
        dict[str, list[Rows]](),
        list[str](),
        list[float](),
        dict[tuple[str, str], str](),
    )
    for path, session in files:
        for rows in read_rows(path, session, recording_map):
            key = rows.session, rows.name
            if key in seen:
                raise InputError(
                    f"{rows.source}: insertion {key[1]} of session {key[0]} is in {seen[key]}, too"
                )
            seen[key] = str(path)
            missing.append(float(np.isnan(rows.position).any(axis=1).mean()))
            kept, note = _known(rows)
            notes += [note] if note else []
            found = find_steps(kept, recording_map.steps)
            if len(found.time) < LEAST_STEPS:
                notes.append(f"{rows.source}: {len(found.time)} steps, fewer than {LEAST_STEPS}: left out")
            else:
                steps.setdefault(rows.session, []).append(found)
    recordings, frames = list[Recording](), dict[str, Rigid]()
    for name, found_steps in steps.items():
        frames[name], made, more = _in_frame(in_order(found_steps), recording_map)
        recordings += made
        notes += more
    fitted = FIT in (recording_map.frame.x, recording_map.frame.y)
    return Found(tuple(recordings), tuple(notes), float(np.mean(missing)), frames if fitted else {})


def _known(rows: Rows) -> tuple[Rows, str]:
    """Return the rows with a position of the tip and all stages, and a note on those without one of a stage."""
    tip = np.isfinite(rows.position).all(axis=1)
    stages = np.isfinite(np.column_stack([rows.guide, rows.base, rows.roll])).all(axis=1)
    lost = int((tip & ~stages).sum())
    note = (
        f"{rows.source}: {lost} rows before the first position of guide, base or roll left out"
        if lost
        else ""
    )
    return rows.choose(tip & stages), note


def _in_frame(
    session: Sequence[Rows], recording_map: RecordingMap
) -> tuple[Rigid, list[Recording], list[str]]:
    """Return the frame of a session, its recordings, and notes."""
    given = recording_map.frame
    frame = frame_with_fitted_x(given, session) if given.x == FIT else given_frame(given)
    made = [_recording(rows, frame, recording_map) for rows in session]
    if given.y == FIT:
        frame = with_fitted_y(frame, [one for one, _ in made], session[0].source)
        made = [_recording(rows, frame, recording_map) for rows in session]
    short = [
        f"{one.session}/{one.name}: fewer than {LEAST_STEPS} steps: left out"
        for one, _ in made
        if _is_short(one)
    ]
    notes = [note for _, own in made for note in own]
    return frame, [one for one, _ in made if not _is_short(one)], [*notes, *short]


def _is_short(one: Recording) -> bool:
    return len(one.depth) < LEAST_STEPS


def _recording(rows: Rows, frame: Rigid, recording_map: RecordingMap) -> tuple[Recording, list[str]]:
    """Return the steps of an insertion in a frame up to its deepest one, and notes on later ones and on sensors."""
    given, axes = recording_map.frame, recording_map.axes
    position = frame.apply(rows.position)
    skin = position[0, 0] - given.first_depth_mm if given.skin_mm is None else given.skin_mm
    reached = position[:, 0].max() - position[0, 0]
    if reached < 0.5 * np.ptp(position, axis=0).max():
        raise InputError(
            f"{rows.source}: the tip advances {reached:.3g} mm along x = {given.x}, and more along another axis: "
            "check frame.x"
        )
    rows, depth, note = before_retreat(rows, position[:, 0] - skin, recording_map.steps.retreat_mm)
    position = position[: len(depth)]
    lateral = [
        (values - values[0])[:, :axes]
        for values in (
            position[:, 1:],
            _stage(rows.guide, recording_map.guide, frame),
            _stage(rows.base, recording_map.base, frame),
        )
    ]
    slope = _slopes(rows, frame, position)[:, :axes]
    origin = np.array([skin, *position[0, 1:]])
    readings, unread = _read_steps(rows, frame, origin, recording_map)
    head = rows.session, rows.name, rows.time, depth
    made = Recording(*head, lateral[0], slope, lateral[1], lateral[2], rows.roll, readings)
    return made, [*([note] if note else []), *unread]


def _read_steps(
    rows: Rows, frame: Rigid, origin: Floats, recording_map: RecordingMap
) -> tuple[tuple[StepReading, ...], list[str]]:
    """Return the readings of sensors along the needle at the steps, and a note on sensors without one."""
    if rows.sensors and not np.isfinite(rows.time).all():
        raise InputError(f"{rows.source}: readings of a sensor need the time of each step: set time.columns")
    found, notes = list[StepReading](), list[str]()
    for table, given in zip(rows.sensors, recording_map.sensor, strict=True):
        own = [*in_needle_frame(table, given, frame, origin).at_steps(rows.time)]
        found += own
        if not own:
            near = f"no reading of {given.name} within {given.within_s:g} s of a step"
            notes.append(f"{rows.source}: {near}: check its time, or set within_s")
    return tuple(found), notes


def _stage(moved: Floats, given: StageMap | None, frame: Rigid) -> Floats:
    """Return y, z (k, 2) of a stage whose position is in the axes of the tracker, or in the needle's frame."""
    in_tracker = given is not None and given.position is not None
    return (frame.apply(moved) if in_tracker else moved)[:, 1:]


def _slopes(rows: Rows, frame: Rigid, position: Floats) -> Floats:
    """Return dy/dx, dz/dx (k, 2) of the needle at the tip. Raises InputError if its axis is not along the path."""
    if np.isfinite(rows.angle).any():
        tangents: Floats = np.tan(rows.angle)
        return tangents
    axis = rows.axis @ frame.rotation.T
    if np.isfinite(axis).any():
        path, mean = position[-1] - position[0], np.nanmean(axis, axis=0)
        cosine = mean @ path / max(1e-9, float(np.linalg.norm(mean) * np.linalg.norm(path)))
        if cosine < np.cos(_STEEPEST):
            raise InputError(
                f"{rows.source}: the sensor's axis is {np.degrees(np.arccos(max(-1.0, cosine))):.0f}° off the path: "
                "check tip.axis, or tip.order and tip.sensor_axis"
            )
    slopes: Floats = axis[:, 1:] / axis[:, :1]
    return slopes
