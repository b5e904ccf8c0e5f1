"""Rows of a study: listed, and computed again as recorded insertions."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError, one_line
from flexneedle.lab.page.job_orders import WorkOrder
from flexneedle.lab.page.protocol import StudyRow, StudyRowsMessage
from flexneedle.lab.page.worker.recordings import read_run, report_recording, save_complete
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.lab.study.folder import read_folder
from flexneedle.lab.study.grid import StudyPoint
from flexneedle.lab.study.recompute import WITHOUT, recompute
from flexneedle.results import Insertion

MOST_ROWS = 200
_LONGEST_REASON = 300


def list_rows(task: WorkerTask) -> None:
    """Report rows of a study. Raises InputError for a folder without one."""
    order = task.order
    with _hide_path(order):
        recorded = read_folder(Path(order.folder))
        found = recorded.rows
        listed = (
            _worst(found) if order.row is None else sorted(index for index in found if index >= order.row)
        )
        chosen = [(index, recorded.insertion(index).point) for index in listed[:MOST_ROWS]]
    task.report(
        StudyRowsMessage(
            name=order.name,
            title=recorded.study.title,
            insertions=len(recorded.study),
            finished=len(found),
            index=order.row,
            rows=[_row_of(index, point, found[index]) for index, point in chosen],
        )
    )


class ShownRows:
    """Rows of studies that were computed again and are shown as recordings, and can be saved."""

    def __init__(self) -> None:
        self._shown = dict[str, Insertion]()

    def recompute(self, task: WorkerTask) -> None:
        """Compute a row again, and report it. Raises InputError or RunError for a row that has no insertion."""
        order = task.order
        self._shown.pop(order.of, None)
        name = f"{order.name}, row {order.row}"

        def on_share(share: float) -> None:
            task.control.check()
            task.report_job("running", share, name)

        with _hide_path(order):
            again = recompute(Path(order.folder), order.row or 0, on_share)
        report_recording(task, again.insertion, name, again.note, order.row)
        self._shown[order.of] = again.insertion

    def read(self, task: WorkerTask) -> None:
        """Report a recorded run in place of a row."""
        self._shown.pop(task.order.of, None)
        read_run(task)

    def save(self, task: WorkerTask) -> None:
        """Save the row in the folder of the order. Raises InputError if none is shown."""
        insertion = self._shown.get(task.order.of)
        if insertion is None:
            raise InputError("there is no row to save: open a row of a study first")
        save_complete(insertion, task.order.folder)


def _worst(found: Mapping[int, Mapping[str, Any]]) -> list[int]:
    """Return indices by error, the largest first, unknown errors last."""

    def error(index: int) -> float:
        known = found[index]["true_error_mm"]
        return -1.0 if known is None else float(known)

    return sorted(found, key=lambda index: (-error(index), index))


def _row_of(index: int, point: StudyPoint, row: Mapping[str, Any]) -> StudyRow:
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
def _hide_path(order: WorkOrder) -> Iterator[None]:
    """Replace the path of the study by its name in errors, which all clients receive."""
    try:
        yield
    except InputError as error:
        raise InputError(one_line(error).replace(order.folder, order.name)) from None
