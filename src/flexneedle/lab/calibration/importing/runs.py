"""Run folders of the package as recordings: the tip as the tracker measured it, with guide, base and roll as moved."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flexneedle.errors import InputError, RunError
from flexneedle.lab.calibration.importing.recordings import LEAST_STEPS, Found
from flexneedle.lab.calibration.readings import SensorTable, StepReading
from flexneedle.lab.calibration.session import GuideOrder, Recording
from flexneedle.record.folder import RUN_FILE, TRACE_FILE
from flexneedle.record.loading import load_insertion
from flexneedle.results import Insertion
from flexneedle.types import DB_PSI, DB_THETA, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN, Floats

GUIDE_ORDER: GuideOrder = "with"
"""Guide and base move during the advance of a control period."""
_TILT_RAD = 1e-3


def find_run(path: Path) -> Path | None:
    """Return the folder of a run that a path names, also by one of its files; None for another path."""
    folder = path.parent if path.name in (RUN_FILE, TRACE_FILE) else path
    return folder if (folder / RUN_FILE).is_file() else None


def read_runs(folders: Sequence[tuple[Path, str]]) -> Found:
    """Return the recordings of run folders with the names of their sessions. Raises InputError."""
    found = [_read_run(folder, session) for folder, session in folders]
    kept = tuple(one for one, _ in found if len(one.depth) >= LEAST_STEPS)
    short = [f"{one.name}: fewer than {LEAST_STEPS} steps: left out" for one, _ in found if one not in kept]
    return Found(kept, (*(note for _, notes in found for note in notes), *short))


def _read_run(folder: Path, session: str) -> tuple[Recording, tuple[str, ...]]:
    """Return the steps of an insertion, one for each accepted reading of the tip, and notes."""
    try:
        done, note = load_insertion(folder)
    except RunError as error:
        raise InputError(str(error)) from None
    scenario = done.scenario or done.plan.scenario
    axes = 1 if scenario is None else scenario.setup.axes
    readings = _readings(done, axes)
    if not len(readings):
        raise InputError(f"{folder}: no reading of the tip was accepted: leave the run out")
    time, depth, across, slope = np.split(readings, [1, 2, 4], axis=1)
    moved = np.stack([np.interp(time[:, 0], _times(done), each) for each in _stages(done).T], axis=1)
    lateral = [(values - values[0])[:, :axes] for values in (across, moved[:, :2], moved[:, 2:4])]
    recording = Recording(
        session,
        folder.resolve().name,
        time[:, 0],
        depth[:, 0],
        lateral[0],
        np.tan(slope[:, :axes]),
        lateral[1],
        lateral[2],
        moved[:, 4],
        tuple(_sensor_readings(done, time[:, 0])),
    )
    return recording, tuple(f"{folder}: {each}" for each in _notes(done, note))


def _readings(done: Insertion, axes: int) -> Floats:
    """Return time, x, y, z, θ, ψ (k, 6) of each reading that was accepted, once."""
    found = dict[float, tuple[float, ...]]()
    for period in done.periods:
        value = period.measurement
        if (
            period.verdict.ok
            and value.x is not None
            and value.y is not None
            and (axes == 1 or value.z is not None)
        ):
            found[value.time] = (
                value.time,
                value.x,
                value.y,
                value.z or 0.0,
                *(value.direction or (np.nan, np.nan)),
            )
    return np.array(sorted(found.values())).reshape(-1, 6)


def _sensor_readings(done: Insertion, times: Floats) -> Iterator[StepReading]:
    """Yield readings of sensors along the needle that corrected the model, at the nearest of the steps' times (k,)."""
    within = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for state in (state for period in done.periods for state in period.sensors):
        at = np.array([one.time for one in state.good])
        table = SensorTable(state.name, at, tuple(one.rows for one in state.good), within)
        yield from table.at_steps(times)


def _times(done: Insertion) -> Floats:
    """Return the times (p + 1,) of the states: the start, and the end of each period."""
    ends = [period.time for period in done.periods]
    return np.array([min(0.0, ends[0]), *ends])


def _stages(done: Insertion) -> Floats:
    """Return guide y, z, base y, z and roll (p + 1, 5) at the start and after each period, as applied.

    The base of a period is an estimate, which readings correct.
    """
    steps = np.array([period.applied for period in done.periods])
    moved = np.column_stack([steps[:, [DG_Y, DG_Z, DB_Y, DB_Z]], steps[:, ROLL] + steps[:, SPIN]])
    start = np.array([0.0, 0.0, 0.0, 0.0, done.plan.roll])
    stages: Floats = start + np.vstack([np.zeros(5), np.cumsum(moved, axis=0)])
    return stages


def _notes(done: Insertion, note: str) -> Iterator[str]:
    """Yield what the recording does not contain, and what its readings are not."""
    if note:
        yield note
    if done.dry_run:
        yield "a dry run: its readings are simulated"
    if done.disturbed:
        yield f"disturbed by a person: {done.disturbed}"
    turns = np.cumsum([period.applied for period in done.periods], axis=0)[:, [DB_THETA, DB_PSI]]
    if np.abs(turns).max() > _TILT_RAD:
        yield f"the base turns by {1e3 * np.abs(turns).max():.3g} mrad, which a session does not contain"
