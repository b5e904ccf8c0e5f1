"""Recorded runs: read into the rows and frames of a running insertion."""

from pathlib import Path

from flexneedle.page.frames import Kind, Source, frame_of
from flexneedle.page.messages import Insertion, Rows
from flexneedle.page.worker.rows import frames_of, row_of
from flexneedle.page.worker.scene import scene_of
from flexneedle.page.worker.task import Task
from flexneedle.runs.reading import load_insertion
from flexneedle.types import scenario_of

_SOURCES = {"first": Source.FIRST, "second": Source.SECOND}


def read(task: Task) -> None:
    """Report a recorded insertion, all at once. Raises InputError or RunError for a folder that has none."""
    work = task.work
    insertion, lacking = load_insertion(Path(work.folder))
    plan, source, error = insertion.plan, _SOURCES[work.of], insertion.error_mm
    task.say(
        Insertion(
            of=work.of,
            name=work.name,
            state=str(insertion.outcome),
            summary="; ".join(filter(None, (insertion.summary, lacking))),
            controller=insertion.controller,
            seed=insertion.seed,
            target=insertion.target,
            periods=len(insertion.periods),
            pace=0.0,
            error_mm=error if error == error else None,
            rig=insertion.rig,
            scene=scene_of(scenario_of(insertion), 0),
        )
    )
    task.show(frame_of(Kind.PATH, source, 0, plan.tips[:, :3]))
    task.signals.check()
    if insertion.periods:
        for frame in frames_of(insertion.periods, source):
            task.show(frame)
    task.say(Rows(of=work.of, first=0, rows=[row_of(period, plan) for period in insertion.periods]))
