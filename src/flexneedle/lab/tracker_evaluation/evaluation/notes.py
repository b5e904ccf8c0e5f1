"""Notes on unusual data in a table of measurements and its treatment."""

from collections.abc import Iterator, Sequence

from flexneedle.geometry.rigid import misfit
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid


def find_notes(grids: Sequence[MeasuredGrid]) -> list[str]:
    """Return a line for each unusual property of the grids."""
    return [f"{grid.title}: {note}" for grid in grids for note in _find(grid)]


def _find(grid: MeasuredGrid) -> Iterator[str]:
    count, missing = grid.points.count, int(grid.points.missing.sum())
    if missing:
        yield (
            f"{missing} of {missing + int(count.sum())} samples have no position (left out), "
            f"all samples at {int((count == 0).sum())} of {len(count)} grid points"
        )
    measured = grid.measured
    if grid.rigid is not None and (wrong := misfit(measured.position, measured.true)) is not None:
        yield wrong
