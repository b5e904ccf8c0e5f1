"""Recorded runs: read into the rows and frames of a running insertion."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from flexneedle.lab.page import messages
from flexneedle.lab.page.frames import Kind, ShapeFrame, Source, frame_of
from flexneedle.lab.page.messages import News, Rows
from flexneedle.lab.page.scene import scene_of
from flexneedle.lab.page.worker.rows import frames_of, row_of
from flexneedle.lab.page.worker.task import Task
from flexneedle.record.loading import load_insertion
from flexneedle.types import Insertion, scenario_of

Of = Literal["first", "second"]
_SOURCES = {"first": Source.FIRST, "second": Source.SECOND}


def read(task: Task) -> None:
    """Report a recorded insertion, all at once. Raises InputError or RunError for a folder that has none."""
    insertion, lacking = load_insertion(Path(task.work.folder))
    report(task, insertion, task.work.name, lacking)


def report(task: Task, insertion: Insertion, name: str, note: str, row: int | None = None) -> None:
    """Report an insertion as the recording of the order. note: what is to be known of it, or ""; row: of its study."""
    for one in recorded(insertion, name, task.work.of, note, row):
        task.signals.check()
        if isinstance(one, ShapeFrame):
            task.show(one)
        else:
            task.say(one)


def recorded(
    insertion: Insertion, name: str, of: Of, lacking: str, row: int | None = None
) -> Iterator[News | ShapeFrame]:
    """News and frames of a recorded insertion. lacking: what its record lacks, or ""; row: of the study it is of."""
    plan, source, error = insertion.plan, _SOURCES[of], insertion.error_mm
    yield messages.Insertion(
        of=of,
        name=name,
        state=str(insertion.outcome),
        summary="; ".join(filter(None, (insertion.summary, lacking))),
        controller=insertion.controller,
        seed=insertion.seed,
        target=insertion.target,
        periods=len(insertion.periods),
        pace=0.0,
        error_mm=error if error == error else None,
        rig=insertion.rig,
        row=row,
        scene=scene_of(scenario_of(insertion), 0),
    )
    yield frame_of(Kind.PATH, source, 0, plan.tips[:, :3])
    if insertion.periods:
        yield from frames_of(insertion.periods, source)
    yield Rows(of=of, first=0, rows=[row_of(period, plan) for period in insertion.periods])
