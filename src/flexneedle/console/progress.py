"""Progress on stderr: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


_LINES = 5  # of a stage, without a terminal
_PAUSE_S = 60.0  # the longest without a line


class Progress:
    """Shows how far named stages have come. Use it as a context."""

    def __init__(self) -> None:
        self._bars = _bars() if sys.stderr.isatty() else None
        self._tasks: dict[str, TaskID] = {}
        self._told: dict[str, int] = {}
        self._last = monotonic()

    def __enter__(self) -> Self:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trail: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def say(self, line: str) -> None:
        """Say a line that belongs to no stage."""
        if self._bars is None:
            _tell(line)
        else:
            self._bars.console.print(line, markup=False, highlight=False)

    def begin(self, stage: str) -> None:
        """Show a stage of which nothing is done yet."""
        if self._bars is None:
            _tell(f"{stage} …")
        else:
            self._tasks[stage] = self._bars.add_task(stage, total=None, note="")
        self._told[stage] = 0

    def show(self, stage: str, done: float, total: float, note: str) -> None:
        """Show that `done` of `total` is done, with a short note."""
        if stage not in self._told:
            self.begin(stage)
        if self._bars is not None:
            self._bars.update(self._tasks[stage], completed=done, total=total, note=note)
        elif (lines := int(_LINES * done / total + 1e-9)) > self._told[stage] or self._is_long_ago():
            self._told[stage] = lines
            self._last = monotonic()
            _tell(f"{stage} {done / total:.0%}: {note}")

    def _is_long_ago(self) -> bool:
        return monotonic() > self._last + _PAUSE_S

    def finish(self, stage: str) -> None:
        """Show a stage as done, whatever was left of it."""
        if self._bars is not None and stage in self._tasks:
            task = next(task for task in self._bars.tasks if task.id == self._tasks[stage])
            self._bars.update(task.id, total=task.total or 1.0, completed=task.total or 1.0)


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _bars() -> Bars:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    # In a narrow terminal bar and times make room for the rest.
    columns: tuple[Any, ...] = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    return Bars(*columns, console=Console(stderr=True))
