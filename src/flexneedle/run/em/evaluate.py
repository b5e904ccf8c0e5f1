"""`flexneedle em evaluate`: a table of measurements in, errors, indicator and figures out."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.run.study.files import replace_file
from flexneedle.trace.plain import to_text
from flexneedle.tracking.evaluation import published
from flexneedle.tracking.evaluation.accuracy import Accuracy, Registration, accuracy, register
from flexneedle.tracking.evaluation.cells import collect
from flexneedle.tracking.evaluation.columns import column_map
from flexneedle.tracking.evaluation.distance import Distances, distances
from flexneedle.tracking.evaluation.grid import Grid
from flexneedle.tracking.evaluation.indicator import Summary, summary
from flexneedle.tracking.evaluation.orientation import Orientation, orientation
from flexneedle.tracking.evaluation.reading import read_batches
from flexneedle.tracking.evaluation.repeatability import Repeatability, Spacing, repeatability, spacing
from flexneedle.tracking.evaluation.separation import Separation, separation
from flexneedle.tracking.evaluation.units import refuse_metres
from flexneedle.tracking.table import OPTIONAL, REFERENCE, REQUIRED

__all__ = [
    "RESULT_FILE",
    "Evaluation",
    "Options",
    "Result",
    "evaluate",
    "notes",
    "read_grids",
    "write_evaluation",
]

RESULT_FILE = "evaluation.json"
_FORMAT = 1


@dataclass(frozen=True)
class Options:
    """How a table is read and judged.

    columns: pairs "theirs=ours" or paths of TOML files with such; unit: "mm", "m", or None for millimetres that are
    refused where they look like metres; limit_mm: RMSE for the smallest distance (None: the maker's, where the sensor
    is one of the paper's); ideal, noisy: names of the environments that the indicator is to tell apart.
    """

    columns: tuple[str, ...] = ()
    register: bool = False
    unit: str | None = None
    bin_mm: float = 50.0
    limit_mm: float | None = None
    ideal: str = published.IDEAL
    noisy: str = published.NOISY


@dataclass(frozen=True, eq=False)
class Result:
    """One sensor in one environment."""

    grid: Grid
    accuracy: Accuracy
    registration: Registration | None
    summary: Summary | None
    spacing: Spacing
    repeatability: Repeatability
    orientation: Orientation | None
    distances: Distances | None

    @property
    def title(self) -> str:
        """Sensor and environment."""
        return f"{self.grid.sensor}, {self.grid.environment}"

    def values(self) -> dict[str, Any]:
        """Return the result as plain values; lengths in mm, full precision."""
        kind = published.kind(self.grid.sensor) or ""
        return {
            "sensor": self.grid.sensor,
            "environment": self.grid.environment,
            **asdict(self.accuracy),
            "official": published.OFFICIAL.get(kind),
            "paper": published.MEASURED.get((kind, self.grid.environment)),
            "registration": _values(self.registration),
            "relative_distance": asdict(self.spacing),
            "repeatability": asdict(self.repeatability),
            "orientation": _values(self.orientation),
            "distance": _values(self.distances),
            "indicator": _values(self.summary),
        }


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What a table came to. `notes`: how odd data was treated, a line each."""

    data: Path
    options: Options
    rows: int
    results: list[Result]
    separations: list[Separation]
    notes: list[str]

    def values(self) -> dict[str, Any]:
        """Return all of it as plain values, without the figures."""
        return {
            "format": _FORMAT,
            "data": str(self.data),
            "rows": self.rows,
            "registered": self.options.register,
            "unit": self.options.unit or "mm",
            "notes": self.notes,
            "results": [result.values() for result in self.results],
            "indicator": [_separation_values(found, self.options) for found in self.separations],
        }


def evaluate(data: Path, options: Options) -> Evaluation:
    """Return the evaluation of a table, read once. Raises InputError for one that cannot be used."""
    grids, rows = read_grids(data, options)
    with _about(data):
        results = [_result(grid, options) for grid in grids]
    judged = [result.grid for result in results]
    separations = [
        found
        for sensor in dict.fromkeys(grid.sensor for grid in judged)
        if (found := separation(sensor, *_environments(judged, sensor, options))) is not None
    ]
    return Evaluation(data, options, rows, results, separations, notes(judged, options))


def read_grids(data: Path, options: Options) -> tuple[list[Grid], int]:
    """Return the grids of a table, and how many rows it has. Raises InputError for one that cannot be used."""
    theirs = column_map(options.columns)
    with _about(data):
        batches = read_batches(data, theirs, REQUIRED, OPTIONAL)
        grids, rows = collect(batches, options.bin_mm, options.unit or "mm")
        if options.unit is None:
            refuse_metres(grids)
    return grids, rows


def write_evaluation(evaluation: Evaluation, folder: Path, figures: Iterable[Path]) -> dict[str, Any]:
    """Write `evaluation.json` and return its values."""
    values = {**evaluation.values(), "folder": str(folder), "figures": [str(path) for path in figures]}
    replace_file(folder / RESULT_FILE, to_text(values).encode())
    return values


def notes(grids: Sequence[Grid], options: Options) -> list[str]:
    """Return what is odd about the data, and how it was treated, a line each."""
    told = ((grid, "; ".join(_odd(grid))) for grid in grids)
    return [f"{grid.sensor}, {grid.environment}: {odd}" for grid, odd in told if odd] + _lacking(
        grids, options
    )


def _odd(grid: Grid) -> Iterator[str]:
    count, missing = grid.points.position.count, int(grid.points.missing.sum())
    single, unseen, known = int((count == 1).sum()), int((count == 0).sum()), count[count > 0]
    if missing:
        yield f"{missing} of {missing + int(count.sum())} samples have no position (left out)"
    if unseen:
        yield f"{unseen} of {len(count)} grid points have no sample (left out)"
    if single:
        yield f"{single} grid points have one sample (an error each, nothing for the jitter)"
    if len(known) and known.min() != known.max():
        weights = "points weigh alike in the errors, samples in the jitter"
        yield f"{known.min()} to {known.max()} samples a grid point ({weights})"
    if np.bincount(grid.cells.point[grid.cells.position.count > 0]).max(initial=0) > 1:
        yield "points were measured at several distances (pooled in all figures but those by distance)"


def _lacking(grids: Sequence[Grid], options: Options) -> list[str]:
    there = {grid.environment for grid in grids if grid.points.indicator.count.any()}
    lacking = [name for name in (options.ideal, options.noisy) if name not in there]
    if not there or not lacking:
        return []
    return [
        f"no indicator in an environment called {' or '.join(lacking)} (there is {', '.join(sorted(there))}): "
        "--ideal and --noisy name the two that it is to tell apart"
    ]


@contextmanager
def _about(data: Path) -> Iterator[None]:
    """Name the file in errors about it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{data}: {error}") from None


def _result(grid: Grid, options: Options) -> Result:
    grid, registration = register(grid) if options.register else (grid, None)
    official = published.OFFICIAL.get(published.kind(grid.sensor) or "", {})
    limit = options.limit_mm if options.limit_mm is not None else official.get("rmse_mm")
    return Result(
        grid,
        accuracy(grid),
        registration,
        summary(grid),
        spacing(grid),
        repeatability(grid),
        orientation(grid),
        distances(grid, options.bin_mm, limit),
    )


def _environments(grids: Sequence[Grid], sensor: str, options: Options) -> tuple[Grid | None, Grid | None]:
    own = {grid.environment: grid for grid in grids if grid.sensor == sensor}
    return own.get(options.ideal), own.get(options.noisy)


def _values(part: Any) -> dict[str, Any] | None:
    return None if part is None else asdict(part)


def _separation_values(found: Separation, options: Options) -> dict[str, Any]:
    confusion = found.confusion
    return {
        "sensor": found.sensor,
        "ideal_environment": options.ideal,
        "noisy_environment": options.noisy,
        "ideal": _values(found.ideal),
        "noisy": _values(found.noisy),
        "threshold": found.threshold,
        "threshold_interval": found.threshold_interval,
        "samples_threshold": found.samples_threshold,
        "samples_above": dict(zip(("ideal", "noisy"), found.samples_above, strict=True)),
        "confusion": confusion
        and {**asdict(confusion), "false_alarms": confusion.false_alarms, "detected": confusion.detected},
        "auc": found.auc,
        "auc_interval": found.auc_interval,
        "roc": {"false_alarms": found.false_alarms, "detected": found.detected},
        "paper": {"threshold": published.THRESHOLD, **published.FITS, "indicator": published.INDICATOR}
        if published.kind(found.sensor) == REFERENCE
        else None,
    }
