"""Recorded insertions: read, described as rows and frames, and saved."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.page.protocol import (
    InsertionMessage,
    Recording,
    RowsMessage,
    ServerMessage,
    describe_scene,
)
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, ShapeFrame, make_frame
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.lab.page.worker.zones import describe_row, describe_zones
from flexneedle.record.loading import load_insertion
from flexneedle.record.saving import save
from flexneedle.results import Insertion, Period, scenario_of
from flexneedle.simulator.state import Contacts
from flexneedle.simulator.zones import zones_of_record
from flexneedle.types import Floats, Shape


def read_run(task: WorkerTask) -> None:
    """Report a recorded insertion. Raises InputError or RunError for a folder without one."""
    insertion, lacking = load_insertion(Path(task.order.folder))
    report_recording(task, insertion, task.order.name, lacking)


def report_recording(
    task: WorkerTask, insertion: Insertion, name: str, note: str, row: int | None = None
) -> None:
    """Report an insertion as the recording of the order. note: added to its summary; row: of its study."""
    for report in describe_recording(insertion, name, task.order.of, note, row):
        task.control.check()
        task.report(report)


def describe_recording(
    insertion: Insertion, name: str, of: Recording, note: str, row: int | None = None
) -> Iterator[ServerMessage | ShapeFrame]:
    """Yield messages and frames of a recorded insertion. note: added to its summary; row: of its study.

    The summary also names the zones that are lost.
    """
    plan, source, error = insertion.plan, FrameSource[of.upper()], insertion.error_mm
    scenario = scenario_of(insertion)
    zones = zones_of_record(scenario)
    yield InsertionMessage(
        of=of,
        name=name,
        state=str(insertion.outcome),
        summary="; ".join(filter(None, (insertion.summary, note, zones.lost_zones))),
        controller=insertion.controller,
        seed=insertion.seed,
        target=insertion.target,
        periods=len(insertion.periods),
        pace=0.0,
        error_mm=error if error == error else None,
        load=insertion.invasiveness.rows(),
        rig=insertion.rig,
        row=row,
        scene=describe_scene(scenario, 0),
    )
    yield describe_zones(scenario, zones, of)
    yield make_frame(FrameKind.PATH, source, 0, plan.tips[:, :3])
    if insertion.periods:
        yield from frames_of(insertion.periods, source)
    yield RowsMessage(
        of=of, first=0, rows=[describe_row(period, plan, zones) for period in insertion.periods]
    )


def save_complete(insertion: Insertion, folder: str) -> None:
    """Save an insertion in a folder that appears in the list of runs only once all files are written.

    Until then its name begins with a dot and is unique; a worker that is killed leaves it. Raises InputError and
    RecordError as `flexneedle.save`.
    """
    whole = Path(folder)
    part = whole.with_name(f".saving-{uuid4().hex}")
    try:
        save(insertion, part)
    finally:  # a run without a figure is complete
        if part.exists():
            try:
                part.rename(whole)
            except OSError as error:
                raise InputError(f"{whole}: cannot be created: {error.strerror}") from error


def frames_of(periods: Sequence[Period], source: FrameSource) -> list[ShapeFrame]:
    """Return the frames of successive periods: the needle, and the true and the predicted needle where known."""
    first = periods[0].index
    shapes: dict[FrameKind, list[Any]] = {
        FrameKind.NEEDLE: [period.shape[:, :3] for period in periods],
        FrameKind.TRUE: [period.true_shape for period in periods],
        FrameKind.PREDICTED: [
            None if period.predicted is None else _with_deviation(period.predicted) for period in periods
        ],
    }
    found = []
    for kind, paths in shapes.items():
        known = [path for path in paths if path is not None]
        if known:
            without = np.full_like(known[0], np.nan, dtype=np.float32)
            found.append(
                make_frame(kind, source, first, *(without if path is None else path for path in paths))
            )
    return found


def _with_deviation(shape: Shape) -> Floats:
    """Return the points of a predicted needle, and the larger standard deviation across it."""
    return np.column_stack([shape.nodes[:, :3], shape.sd.max(axis=1)])


def channel_of(contacts: Contacts, number: int) -> ShapeFrame | None:
    """Return the frame of the cut channel, with the stretch of the released tissue; None before the skin."""
    if len(contacts.x) == 0:
        return None
    values = np.column_stack([contacts.x, contacts.position, 2.0 - contacts.stretch])
    return make_frame(FrameKind.CHANNEL, FrameSource.LIVE, number, values)
