"""Notes on unusual data in a table of measurements and its treatment."""

from collections.abc import Iterator, Sequence

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import misfit
from flexneedle.lab.tracker_evaluation.evaluation.accuracy import (
    compute_errors,
    register_grid,
    root_mean_square,
)
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid

_UNREGISTERED = 5.0
"""If a rigid fit lowers the RMSE by more than this factor, tracker and stage most likely have different frames."""
_FEWEST_POINTS = 6  # a rigid fit with its six parameters always fits fewer points well


def find_notes(grids: Sequence[MeasuredGrid], suggest_registration: bool) -> list[str]:
    """Return a line for each unusual property of the grids.

    suggest_registration: add a note if --register seems needed.
    """
    return [
        *(note for grid in grids for note in _count_missing(grid)),
        *_misfits(grids),
        *(_note_frames(grids) if suggest_registration else ()),
    ]


def _count_missing(grid: MeasuredGrid) -> Iterator[str]:
    count, missing = grid.points.count, int(grid.points.missing.sum())
    if missing:
        empty = int((count == 0).sum())
        yield (
            f"{grid.title}: {missing} of {missing + int(count.sum())} samples have no position (left out), "
            f"all samples at {empty} of {len(count)} grid points"
        )


def _misfits(grids: Sequence[MeasuredGrid]) -> Iterator[str]:
    """Yield a line for each registered grid that no rigid transform maps to the stage's."""
    for grid in grids:
        measured = grid.measured
        if grid.rigid is not None and (wrong := misfit(measured.position, measured.true)) is not None:
            yield f"{grid.title}: {wrong}"


def _note_frames(grids: Sequence[MeasuredGrid]) -> Iterator[str]:
    fits = [(grid, *fit) for grid in grids if (fit := _fit(grid)) is not None]
    if fits:
        grid, raw, residual = max(fits, key=lambda fit: fit[1])
        others = f", and {len(fits) - 1} more" if len(fits) > 1 else ""
        yield (
            f"a rigid fit would reduce the RMSE from {raw:.3g} mm to {residual:.2g} mm ({grid.title}{others}): "
            "if tracker and stage have different frames, add --register"
        )


def _fit(grid: MeasuredGrid) -> tuple[float, float] | None:
    """Return the RMSE before and after a rigid fit (mm), None if the fit does not reduce it much."""
    measured = grid.measured
    if len(measured) < _FEWEST_POINTS:
        return None
    try:
        residual = register_grid(grid)[1].residual_mm
    except InputError:  # collinear points: no fit to compare with
        return None
    raw = root_mean_square(compute_errors(measured))
    return (raw, residual) if raw > _UNREGISTERED * residual else None
