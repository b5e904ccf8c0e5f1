"""Lines and progress on stderr: a bar in a terminal, occasional lines otherwise."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


_LINES = 5  # per stage, without a terminal
_MAX_SILENCE_S = 60.0  # between two lines, without a terminal


def print_line(line: str) -> None:
    """Print a line on stderr."""
    print(line, file=sys.stderr, flush=True)


def print_note(line: str) -> None:
    """Print a line on stderr that begins with the name of the program."""
    print_line(f"flexneedle: {line}")


class Progress:
    """Progress of named stages. Use as a context manager."""

    def __init__(self) -> None:
        self._bars = _bars() if sys.stderr.isatty() else None
        self._tasks: dict[str, TaskID] = {}
        self._printed: dict[str, int] = {}
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

    def print_line(self, line: str) -> None:
        """Print a line that belongs to no stage."""
        if self._bars is None:
            print_line(line)
        else:
            self._bars.console.print(line, markup=False, highlight=False)

    @contextmanager
    def pause_display(self) -> Iterator[None]:
        """Leave the terminal to a question."""
        if self._bars is not None:
            self._bars.stop()
        try:
            yield
        finally:
            if self._bars is not None:
                self._bars.start()

    def begin(self, stage: str) -> None:
        """Show a stage at its start."""
        if self._bars is None:
            print_line(f"{stage} …")
        else:
            self._tasks[stage] = self._bars.add_task(stage, total=None, note="")
        self._printed[stage] = 0

    def show(self, stage: str, done: float, total: float, note: str) -> None:
        """Show that `done` of `total` is complete, with a short note."""
        if stage not in self._printed:
            self.begin(stage)
        if self._bars is not None:
            self._bars.update(self._tasks[stage], completed=done, total=total, note=note)
        elif (lines := int(_LINES * done / total + 1e-9)) > self._printed[stage] or self._is_overdue():
            self._printed[stage] = lines
            self._last = monotonic()
            print_line(f"{stage} {done / total:.0%}: {note}")

    def _is_overdue(self) -> bool:
        return monotonic() > self._last + _MAX_SILENCE_S

    def finish(self, stage: str) -> None:
        """Show a stage as complete."""
        if self._bars is not None and stage in self._tasks:
            task = next(task for task in self._bars.tasks if task.id == self._tasks[stage])
            self._bars.update(task.id, total=task.total or 1.0, completed=task.total or 1.0)


def _bars() -> Bars:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    # In a narrow terminal, bar and times are shortened first.
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
