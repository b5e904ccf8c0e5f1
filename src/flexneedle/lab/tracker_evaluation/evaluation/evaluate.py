"""`flexneedle em evaluate`: errors and indicator of a table of measurements, and the files of results."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.geometry.pair_checks import check_size, find_better_fit, mirrored_frame, misfit, unknown_side
from flexneedle.lab.tables.columns import OPTIONAL, REFERENCE, REQUIRED, map_columns
from flexneedle.lab.tables.row_rules import note_codes
from flexneedle.lab.tables.sample_table import open_table
from flexneedle.lab.tracker_evaluation.evaluation import published
from flexneedle.lab.tracker_evaluation.evaluation.accuracy import (
    Accuracy,
    RigidFit,
    compute_accuracy,
    compute_errors,
    register_grid,
    root_mean_square,
)
from flexneedle.lab.tracker_evaluation.evaluation.indicator import (
    IndicatorFits,
    IndicatorSummary,
    fit_indicator,
    summarize_indicator,
)
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid, read_grids
from flexneedle.lab.tracker_evaluation.evaluation.points import POINTS_FILE, format_points
from flexneedle.lab.tracker_evaluation.evaluation.repeatability import (
    Orientation,
    RelativeDistance,
    Repeatability,
    compute_orientation,
    compute_relative_distance,
    compute_repeatability,
)
from flexneedle.record.plain import to_text

_RESULT_FILE = "evaluation.json"
RESULT_FILES = (_RESULT_FILE, POINTS_FILE)
_FORMAT = 1
_UNREGISTERED = 5.0
"""If a rigid fit lowers the RMSE by more than this factor, tracker and stage most likely have different frames."""
_FEWEST_POINTS = 6  # a rigid fit with its six parameters always fits fewer points well


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of reading and evaluating a table.

    columns: pairs "NAME=COLUMN"; unit: "mm" or "m", of all lengths; ideal, noisy: names of the environments of the fits
    to the indicator (None: the paper's); sensor, environment: of all rows, for a table without such a column.
    """

    columns: tuple[str, ...] = ()
    register: bool = False
    unit: str = "mm"
    ideal: str | None = None
    noisy: str | None = None
    sensor: str | None = None
    environment: str | None = None

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the environments of the fits to the indicator."""
        return self.ideal or published.IDEAL, self.noisy or published.NOISY


@dataclass(frozen=True, eq=False)
class SensorResult:
    """Results of one sensor in one environment."""

    grid: MeasuredGrid
    accuracy: Accuracy
    registration: RigidFit | None
    indicator: IndicatorSummary | None
    relative_distance: RelativeDistance
    repeatability: Repeatability
    orientation: Orientation | None

    def values(self) -> dict[str, Any]:
        """Return the result as plain values; lengths in mm, full precision."""
        sensor = published.find_paper_sensor(self.grid.sensor) or ""
        return {
            "sensor": self.grid.sensor,
            "environment": self.grid.environment,
            **asdict(self.accuracy),
            "official": published.OFFICIAL.get(sensor),
            "paper": published.MEASURED.get((sensor, self.grid.environment)),
            "registration": _values(self.registration),
            "relative_distance": asdict(self.relative_distance),
            "repeatability": asdict(self.repeatability),
            "orientation": _values(self.orientation),
            "indicator": _values(self.indicator),
        }


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The evaluation of a table. notes: one line on each unusual property of the data."""

    data: Path
    options: EvaluationOptions
    rows: int
    results: list[SensorResult]
    fits: list[IndicatorFits]
    notes: list[str]

    def values(self) -> dict[str, Any]:
        """Return the evaluation as plain values, without the figures."""
        return {
            "format": _FORMAT,
            "data": str(self.data),
            "rows": self.rows,
            "registered": self.options.register,
            "unit": self.options.unit,
            "notes": self.notes,
            "results": [result.values() for result in self.results],
            "indicator": [_fit_values(found, self.options) for found in self.fits],
        }


def evaluate_table(data: Path, options: EvaluationOptions) -> Evaluation:
    """Return the evaluation of a table. Raises InputError for an invalid table."""
    grids, rows = read_table(data, options)
    try:
        _check_names(grids, options)
        results = [_result(grid, options) for grid in grids]
    except InputError as error:
        raise InputError(f"{data}: {error}") from None
    registered = [result.grid for result in results]
    sensors = dict.fromkeys(grid.sensor for grid in registered)
    fits = [fit_indicator(sensor, *_environments(registered, sensor, options)) for sensor in sensors]
    notes = [f"{grid.title}: {note}" for grid in registered for note in _find_notes(grid)]
    if not options.register:
        notes += _note_frames(registered)
    return Evaluation(data, options, rows, results, [fit for fit in fits if fit is not None], notes)


def _find_notes(grid: MeasuredGrid) -> Iterator[str]:
    """Yield each unusual property of the data and its treatment."""
    count, missing = grid.points.count, int(grid.points.missing.sum())
    if missing:
        yield (
            f"{missing} of {missing + int(count.sum())} samples have no position (left out); grid points without "
            f"any position: {int((count == 0).sum())} of {len(count)}"
        )
    coded = grid.points.coded
    if (codes := note_codes(int(coded.sum()), int(count.sum()), grid.points.code[coded > 0])) is not None:
        yield codes
    try:
        yield from (note for note in _check_frames(grid) if note is not None)
    except InputError:  # too few points, or collinear ones: no fit to compare with
        return


def _check_frames(grid: MeasuredGrid) -> Iterator[str | None]:
    measured = grid.measured
    pairs = (measured.position, measured.true)
    if grid.rigid is None:
        yield mirrored_frame(*pairs)
        return
    names = tuple(grid.name_of(k) for k in range(len(measured)))
    if (problem := misfit(*pairs, names)) is not None:
        yield problem
        return
    yield find_better_fit(*pairs, names)
    yield unknown_side(*pairs, measured.true)


def _note_frames(grids: Sequence[MeasuredGrid]) -> Iterator[str]:
    """Yield a line if --register seems needed."""
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


def read_table(data: Path, options: EvaluationOptions) -> tuple[list[MeasuredGrid], int]:
    """Return the grids of a table and its number of rows. Raises InputError for an invalid table."""
    mapping = map_columns(options.columns)
    labels = {"sensor": options.sensor, "environment": options.environment}
    names = {column: name for column, name in labels.items() if name is not None}
    optional = (*OPTIONAL, "indicator", *names)
    required = [column for column in REQUIRED if column not in optional]
    with open_table(data, required, optional, mapping=mapping, labels=names, unit=options.unit) as table:
        grids, rows = read_grids(table)
        for grid in grids:
            if np.ptp(grid.points.true, axis=0).any():  # not a single point
                check_size(grid.points.true, f"the grid points of {grid.title}")
        return grids, rows


def write_evaluation(evaluation: Evaluation, folder: Path, figures: Iterable[Path]) -> dict[str, Any]:
    """Write `points.csv` and `evaluation.json` and return the values of the latter."""
    points = folder / POINTS_FILE
    replace_file(points, format_points([result.grid for result in evaluation.results]).encode())
    files = {"folder": str(folder), "points": str(points), "figures": [str(path) for path in figures]}
    values = {**evaluation.values(), **files}
    replace_file(folder / _RESULT_FILE, to_text(values).encode())
    return values


def _check_names(grids: Sequence[MeasuredGrid], options: EvaluationOptions) -> None:
    present = list(dict.fromkeys(grid.environment for grid in grids))
    for option in ("ideal", "noisy"):
        name = getattr(options, option)
        if name is not None and name not in present:
            raise InputError(f"--{option}: no environment {name!r}: choose from {', '.join(present)}")


def _result(grid: MeasuredGrid, options: EvaluationOptions) -> SensorResult:
    grid, registration = register_grid(grid) if options.register else (grid, None)
    return SensorResult(
        grid,
        compute_accuracy(grid),
        registration,
        summarize_indicator(grid),
        compute_relative_distance(grid),
        compute_repeatability(grid),
        compute_orientation(grid),
    )


def _environments(
    grids: Sequence[MeasuredGrid], sensor: str, options: EvaluationOptions
) -> tuple[MeasuredGrid | None, MeasuredGrid | None]:
    own = {grid.environment: grid for grid in grids if grid.sensor == sensor}
    ideal, noisy = options.pair
    return own.get(ideal), own.get(noisy)


def _values(part: Any) -> dict[str, Any] | None:
    return None if part is None else asdict(part)


def _fit_values(found: IndicatorFits, options: EvaluationOptions) -> dict[str, Any]:
    ideal, noisy = options.pair
    return {
        **asdict(found),
        "ideal_environment": ideal,
        "noisy_environment": noisy,
        "paper": {"threshold": published.THRESHOLD, **published.FITS, "indicator": published.INDICATOR}
        if published.find_paper_sensor(found.sensor) == REFERENCE
        else None,
    }
