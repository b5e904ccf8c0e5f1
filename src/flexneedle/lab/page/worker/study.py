"""Rows of a study: listed, and computed again into the rows and frames of a recorded insertion."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError, one_line
from flexneedle.lab.page.messages import StudyRow, StudyRows
from flexneedle.lab.page.orders import Work
from flexneedle.lab.page.worker.recording import read, report
from flexneedle.lab.page.worker.saving import save_whole
from flexneedle.lab.page.worker.task import Task
from flexneedle.lab.study.folder import read_folder
from flexneedle.lab.study.grid import GridPoint
from flexneedle.lab.study.recompute import WITHOUT, recompute
from flexneedle.types import Insertion

MOST_ROWS = 200
_LONGEST_REASON = 300


def rows(task: Task) -> None:
    """Report rows of a study. Raises InputError for a folder that has none."""
    work = task.work
    with _named(work):
        recorded = read_folder(Path(work.folder))
        found = recorded.rows
        listed = _worst(found) if work.row is None else sorted(index for index in found if index >= work.row)
        chosen = [(index, recorded.insertion(index).point) for index in listed[:MOST_ROWS]]
    task.say(
        StudyRows(
            name=work.name,
            title=recorded.study.title,
            insertions=len(recorded.study),
            finished=len(found),
            index=work.row,
            rows=[_row_of(index, point, found[index]) for index, point in chosen],
        )
    )


class Rows:
    """Rows of studies that were computed again and are shown as recordings, until others are: they can be saved."""

    def __init__(self) -> None:
        self._shown = dict[str, Insertion]()

    def row(self, task: Task) -> None:
        """Compute a row again, and report it. Raises InputError or RunError for a row that has no insertion."""
        work = task.work
        self._shown.pop(work.of, None)
        name = f"{work.name}, row {work.row}"

        def on_share(share: float) -> None:
            task.signals.check()
            task.tell("running", share, name)

        with _named(work):
            again = recompute(Path(work.folder), work.row or 0, on_share)
        report(task, again.insertion, name, again.note, work.row)
        self._shown[work.of] = again.insertion

    def read(self, task: Task) -> None:
        """Report a recorded run in the place of a row."""
        self._shown.pop(task.work.of, None)
        read(task)

    def save(self, task: Task) -> None:
        """Save the row that is shown as a recording in the folder of the order. Raises InputError without one."""
        insertion = self._shown.get(task.work.of)
        if insertion is None:
            raise InputError("there is no row to save: open a row of a study first")
        save_whole(insertion, task.work.folder)


def _worst(found: Mapping[int, Mapping[str, Any]]) -> list[int]:
    """Indices by error, the largest first; those without one at the end."""

    def error(index: int) -> float:
        known = found[index]["true_error_mm"]
        return -1.0 if known is None else float(known)

    return sorted(found, key=lambda index: (-error(index), index))


def _row_of(index: int, point: GridPoint, row: Mapping[str, Any]) -> StudyRow:
    varied = (
        f"{key} {value}" if "." in key else str(value)
        for key, value in point.varied.items()
        if key != "controller"
    )
    world = [] if point.world is None else [f"world {point.world}"]
    return StudyRow(
        index=index,
        settings=", ".join(filter(None, (point.case, *world, *varied))),
        controller=point.controller,
        target=point.scenario.target.position,
        error_mm=row["true_error_mm"],
        outcome=row["outcome"],
        reason=row["reason"][:_LONGEST_REASON],
        opens=row["outcome"] not in WITHOUT,
    )


@contextmanager
def _named(work: Work) -> Iterator[None]:
    """Name the study, not its path, in errors: all clients get them."""
    try:
        yield
    except InputError as error:
        raise InputError(one_line(error).replace(work.folder, work.name)) from None
