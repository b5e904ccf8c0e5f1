"""Notes on unusual data in a table of measurements, and on how it was treated."""

from collections.abc import Iterator, Sequence

import numpy as np

from flexneedle.em.evaluation.accuracy import errors, register, root_mean_square
from flexneedle.em.table.grid import Grid
from flexneedle.em.table.rules import SAME_MM
from flexneedle.errors import InputError
from flexneedle.rig.tracking.registration import misfit

_OWN_FRAME = 5.0
"""A rigid fit that leaves less than a fifth of the RMSE: the tracker has most likely a frame of its own."""
_FEW = 6  # grid points; of fewer a rigid fit, with its six numbers, leaves little in any case


def notes(grids: Sequence[Grid], pair: tuple[str, str], hinted: bool) -> list[str]:
    """Return a line for each unusual property of the grids.

    pair: the environments that the indicator is to separate; hinted: add a note where a rigid fit is missing.
    """
    return [
        *(f"{grid.title}: {odd}" for grid in grids if (odd := "; ".join(_odd(grid)))),
        *lacking_sensors(grids),
        *differing_points(grids),
        *misfits(grids),
        *(_own_frame(grids) if hinted else ()),
        *_lacking(grids, pair),
    ]


def lacking_sensors(grids: Sequence[Grid], absent: str = "not in") -> Iterator[str]:
    """Yield a line for each sensor that is not in all environments, described by `absent`."""
    everywhere = list(dict.fromkeys(grid.environment for grid in grids))
    for sensor in dict.fromkeys(grid.sensor for grid in grids):
        own = [grid.environment for grid in grids if grid.sensor == sensor]
        lacking = [name for name in everywhere if name not in own]
        if lacking:
            yield f"{sensor}: {absent} {', '.join(lacking)}, only in {', '.join(own)}"


def differing_points(grids: Sequence[Grid]) -> Iterator[str]:
    """Yield a line for each sensor that was not measured at the same grid points in all environments."""
    for sensor in dict.fromkeys(grid.sensor for grid in grids):
        own = {grid.environment: _measured_names(grid) for grid in grids if grid.sensor == sensor}
        shared = set.intersection(*own.values())
        if any(names != shared for names in own.values()):
            counts = ", ".join(f"{len(names)} in {name}" for name, names in own.items())
            yield f"{sensor}: grid points: {counts}, {len(shared)} of them in all: different places are compared"


def _measured_names(grid: Grid) -> set[str]:
    return {name for name, known in zip(grid.names, grid.known.tolist(), strict=True) if known}


def _points(count: int) -> str:
    return f"{count} grid point{'s' if count != 1 else ''}"


def _odd(grid: Grid) -> Iterator[str]:
    count, missing = grid.points.count, int(grid.points.missing.sum())
    single, lacking, known = int((count == 1).sum()), int((count == 0).sum()), count[count > 0]
    places = np.unique(np.round(grid.points.true / SAME_MM), axis=0)
    if len(places) < len(count):
        yield f"{len(count) - len(places)} of {_points(len(count))} under a second point_id (counted as points)"
    if missing:
        yield f"{missing} of {missing + int(count.sum())} samples have no position (left out)"
    if lacking:
        yield f"no sample at {lacking} of {_points(len(count))} (left out)"
    if len(known) and single == len(known):
        yield "one sample at each grid point (jitter and repeatability are not known)"
    elif single:
        yield f"one sample at {_points(single)} (an error each, nothing for the jitter)"
    if len(known) and known.min() != known.max():
        weights = "points weigh alike in the errors, samples in the jitter"
        yield f"{known.min()} to {known.max()} samples a grid point ({weights})"
    if (grid.cells.count > 0).sum() > len(known):
        yield "points were measured at several distances (pooled in all figures but those by distance)"


def misfits(grids: Sequence[Grid]) -> Iterator[str]:
    """Yield a line for each grid that was registered although no rotation takes it to the stage's."""
    for grid in grids:
        measured = grid.measured()
        if grid.rigid is not None and (wrong := misfit(measured.position, measured.true)) is not None:
            yield f"{grid.title}: {wrong}"


def _own_frame(grids: Sequence[Grid]) -> Iterator[str]:
    fits = [(grid, *fit) for grid in grids if (fit := _fit(grid)) is not None]
    if fits:
        grid, as_it_is, left = max(fits, key=lambda fit: fit[1])
        others = f", and {len(fits) - 1} more" if len(fits) > 1 else ""
        yield (
            f"the RMSE of {as_it_is:.3g} mm would be {left:.2g} mm after a rigid fit ({grid.title}{others}): "
            "if the tracker has a frame of its own, add --register"
        )


def _fit(grid: Grid) -> tuple[float, float] | None:
    """Return the RMSE as it is and after a rigid fit (mm), if that leaves a small part of it."""
    measured = grid.measured()
    if len(measured) < _FEW:
        return None
    try:
        left = register(grid)[1].residual_mm
    except InputError:  # points on a line: no fit to compare with
        return None
    as_it_is = root_mean_square(errors(measured))
    return (as_it_is, left) if as_it_is > _OWN_FRAME * left else None


def _lacking(grids: Sequence[Grid], pair: tuple[str, str]) -> Iterator[str]:
    there = list(dict.fromkeys(grid.environment for grid in grids if grid.points.indicators.any()))
    lacking = [name for name in pair if name not in there]
    if len(there) > 1 and lacking:
        yield (
            f"no indicator in an environment called {' or '.join(lacking)} (there is {', '.join(there)}): "
            "--ideal and --noisy name the two that it is to separate"
        )
