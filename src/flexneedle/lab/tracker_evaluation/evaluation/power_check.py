"""`flexneedle em check`: does the rig's own power distort the field (paper, section IV-B)?

Compares the indicator with power off and on, from two environments of one table.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation import published
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, read_table
from flexneedle.lab.tracker_evaluation.evaluation.indicator import (
    IndicatorSummary,
    average_indicator,
    summarize_indicator,
)
from flexneedle.lab.tracker_evaluation.evaluation.intervals import Interval, bootstrap
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PowerComparison:
    """Indicator of one sensor with power off and on. difference: mean on minus mean off, with a bootstrap interval.

    paired: both were measured at the same grid points, which are then resampled in pairs. above: the mean with power on
    exceeds the threshold; points_above: number of grid points where it does.
    """

    sensor: str
    threshold: float
    off: IndicatorSummary
    on: IndicatorSummary
    difference: float
    difference_interval: Interval
    paired: bool
    above: bool
    points_above: int


@dataclass(frozen=True, eq=False)
class PowerCheck:
    """Comparison of each sensor with an indicator in both environments; notes: what could not be compared."""

    sensors: list[PowerComparison]
    notes: list[str]

    @property
    def above(self) -> bool:
        """Whether the indicator of any sensor is above the threshold with power on."""
        return any(found.above for found in self.sensors)

    @property
    def paper(self) -> float:
        """The indicator of the paper's rig with power on."""
        return published.POWERED

    def values(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return {
            "above": self.above,
            "paper_powered": self.paper,
            "notes": self.notes,
            "results": [asdict(s) for s in self.sensors],
        }


def check_power(data: Path, off: str, on: str, threshold: float, options: EvaluationOptions) -> PowerCheck:
    """Return the comparison of the environments `off` and `on` of a table.

    Raises InputError for an invalid table, or if no sensor has an indicator in both environments.
    """
    grids, _ = read_table(data, options)
    before, after = (_grids_of(data, grids, name) for name in (off, on))
    both = [name for name in before if name in after]
    if not both:
        raise InputError(
            f"{data}: no sensor has an indicator both with power off ({', '.join(before) or 'none'}) "
            f"and on ({', '.join(after) or 'none'})"
        )
    notes = [
        f"{name}: no indicator with power {'on' if name in before else 'off'}"
        for name in (before | after)
        if name not in both
    ]
    compared = (compare_power(before[name], after[name], threshold) for name in both)
    return PowerCheck([found for found in compared if found is not None], notes)


def compare_power(off: MeasuredGrid, on: MeasuredGrid, threshold: float) -> PowerComparison | None:
    """Return the comparison of two grids of one sensor, None unless both have an indicator."""
    before, after = summarize_indicator(off), summarize_indicator(on)
    if before is None or after is None:
        return None
    low, high = average_indicator(off)[0], average_indicator(on)[0]
    paired = _names(off) == _names(on)
    return PowerComparison(
        sensor=on.sensor,
        threshold=threshold,
        off=before,
        on=after,
        difference=after.mean - before.mean,
        difference_interval=bootstrap(_difference, low, high, paired=paired),
        paired=paired,
        above=after.mean > threshold,
        points_above=int((high > threshold).sum()),
    )


def _grids_of(data: Path, grids: Sequence[MeasuredGrid], environment: str) -> dict[str, MeasuredGrid]:
    present = list(dict.fromkeys(grid.environment for grid in grids))
    if environment not in present:
        raise InputError(
            f"{data}: no environment {environment!r}: choose with --off and --on from {', '.join(present)}"
        )
    return {
        grid.sensor: grid for grid in grids if grid.environment == environment and grid.samples is not None
    }


def _names(grid: MeasuredGrid) -> list[str]:
    return [grid.names[number] for number in np.flatnonzero(grid.points.indicators)]


def _difference(low: Floats, high: Floats, axis: int) -> Floats:
    difference: Floats = high.mean(axis=axis) - low.mean(axis=axis)
    return difference
