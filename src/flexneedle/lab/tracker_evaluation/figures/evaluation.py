"""The figures of an evaluation."""

from pathlib import Path

from flexneedle.figures.style import format_signed, save
from flexneedle.lab.tracker_evaluation.evaluation.accuracy import compute_error_vectors
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import Evaluation, SensorResult
from flexneedle.lab.tracker_evaluation.evaluation.indicator import IndicatorFits, LineFit, average_indicator
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid
from flexneedle.lab.tracker_evaluation.figures.field import FieldRow, draw_field
from flexneedle.lab.tracker_evaluation.figures.indicator import (
    IndicatorPanel,
    PlottedPoints,
    draw_indicator,
)

MOST_PANELS = 3


def draw_evaluation(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Draw `field`, and `indicator` if there is one, as PNG and SVG."""
    paths = save(draw_field([_field(result) for result in evaluation.results]), folder, "field")
    panels = [_indicator(evaluation, found) for found in evaluation.fits[:MOST_PANELS]]
    if panels:
        paths += save(draw_indicator(panels, len(evaluation.fits) - len(panels)), folder, "indicator")
    return paths


def _field(result: SensorResult) -> FieldRow:
    measured = result.grid.measured
    return FieldRow(result.grid.title, measured.true, compute_error_vectors(measured))


def _indicator(evaluation: Evaluation, found: IndicatorFits) -> IndicatorPanel:
    own = {result.grid.environment: result.grid for result in evaluation.results if _is_of(result, found)}
    ideal, noisy = (own.get(name) for name in evaluation.options.pair)
    constant, line = found.ideal, found.noisy
    return IndicatorPanel(
        found.sensor,
        _points(ideal, f"{constant.mean_mm:.3f} ± {constant.sd_mm:.3f} mm") if ideal and constant else None,
        _points(noisy, _line_text(line)) if noisy and line else None,
        (constant.mean_mm, constant.sd_mm) if constant else None,
        (line.slope_mm, line.intercept_mm) if line else None,
        found.threshold,
    )


def _line_text(line: LineFit) -> str:
    sign = "+" if line.intercept_mm >= 0.0 else "−"
    return f"{format_signed(line.slope_mm, '.3f')} I {sign} {abs(line.intercept_mm):.3f} mm"


def _is_of(result: SensorResult, found: IndicatorFits) -> bool:
    return result.grid.sensor == found.sensor and result.indicator is not None


def _points(grid: MeasuredGrid, fit: str) -> PlottedPoints:
    return PlottedPoints(grid.environment, *average_indicator(grid), fit)
