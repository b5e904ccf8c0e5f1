"""Tables of an evaluation, and of a check of the power, for the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from flexneedle.cli.common import print_table
from flexneedle.lab.tables.columns import REFERENCE
from flexneedle.lab.tracker_evaluation.evaluation import published
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import Evaluation, SensorResult
from flexneedle.lab.tracker_evaluation.evaluation.indicator import IndicatorFits, IndicatorSummary
from flexneedle.lab.tracker_evaluation.evaluation.moments import IndicatorSamples
from flexneedle.lab.tracker_evaluation.evaluation.power_check import PowerCheck, PowerComparison

_ERRORS = ("rmse_mm", "p95_mm", "max_mm", "jitter_mm")
_INDICATOR = ("mean", "sd", "max", "min", "p95")


def print_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Print the tables, the notes and the output folder."""
    _print_tables(evaluation)
    sys.stdout.flush()
    for note in evaluation.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"Results and figures: {folder}")


def _print_tables(evaluation: Evaluation) -> None:
    frame = " after rigid registration of each sensor and environment" if evaluation.options.register else ""
    heads = ("", "rmse", "95 %", "max", "jitter", "points", "samples")
    results = evaluation.results
    print_table(f"Errors (mm){frame}", heads, [row for result in results for row in _error_rows(result)])
    shown = [row for result in results for row in _indicator_rows(result)]
    if shown:
        print_table(
            "Indicator (means at grid points)", ("", "mean", "sd", "max", "min", "95 %", "points"), shown
        )
    pair = evaluation.options.pair
    fits = [row for found in evaluation.fits for row in _fit_rows(found, *pair)]
    if fits:
        print_table("Error by indicator", ("", "", "95 % interval", "paper"), fits)


def _error_rows(result: SensorResult) -> Iterator[tuple[str, ...]]:
    found, values = result.accuracy, result.values()
    counts = f"{found.n_points}", f"{found.n_samples}"
    yield (result.grid.title, *(_format_number(values[key]) for key in _ERRORS), *counts)
    if any(found.intervals.values()):
        intervals = (_format_interval(found.intervals.get(key)) for key in _ERRORS)
        yield (" 95 % interval", *intervals, "", "")
    for name, key in (("paper", "paper"), ("manufacturer", "official")):
        if values[key]:
            yield (f" {name}", *(_format_number(values[key].get(k), ".2f") for k in _ERRORS), "", "")


def _indicator_rows(result: SensorResult) -> Iterator[tuple[str, ...]]:
    found = result.indicator
    if found is None:
        return
    yield (result.grid.title, *_levels(found), f"{found.n_points}")
    yield (" single samples", *_levels(found.samples), f"{found.samples.n_samples}")
    paper = published.INDICATOR.get(result.grid.environment)
    if paper and published.find_paper_sensor(result.grid.sensor) == REFERENCE:
        yield (" paper", *(_format_number(paper.get(key), ".4f") for key in _INDICATOR), "")


def _levels(found: IndicatorSummary | IndicatorSamples) -> list[str]:
    return [_format_number(getattr(found, key, None), ".4f") for key in _INDICATOR]


def _fit_rows(found: IndicatorFits, ideal: str, noisy: str) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the fits, with the paper's values for its sensor and environments."""
    as_in_paper = published.find_paper_sensor(found.sensor) == REFERENCE
    as_in_paper &= (ideal, noisy) == (published.IDEAL, published.NOISY)
    fits = published.FITS
    papers = {
        f"{ideal}: error (mm)": f"{fits['mean_mm']} ± {fits['sd_mm']}",
        f"{noisy}: slope (mm)": str(fits["slope_mm"]),
        f"{noisy}: intercept (mm)": str(fits["intercept_mm"]),
        "threshold": str(published.THRESHOLD),
    }
    for row in _found_rows(found, ideal, noisy):
        quantity = row[0].removeprefix(found.sensor).lstrip(", :")
        yield (*row, papers.get(quantity, "") if as_in_paper else "")


def _found_rows(found: IndicatorFits, ideal: str, noisy: str) -> Iterator[tuple[str, str, str]]:
    name = found.sensor
    if found.ideal:
        constant, intervals = found.ideal, found.ideal.intervals
        yield (
            f"{name}, {ideal}: error (mm)",
            f"{_format_number(constant.mean_mm)} ± {_format_number(constant.sd_mm)}",
            _format_interval(intervals["mean_mm"]),
        )
    if found.noisy:
        line, intervals = found.noisy, found.noisy.intervals
        for part in ("slope", "intercept"):
            value, interval = getattr(line, f"{part}_mm"), intervals[f"{part}_mm"]
            yield f"{name}, {noisy}: {part} (mm)", _format_number(value), _format_interval(interval)
        yield f"{name}, {noisy}: residual sd of the line (mm)", _format_number(line.scatter_mm), ""
    if found.threshold is not None:
        yield (
            f"{name}: threshold",
            _format_number(found.threshold, ".4f"),
            _format_interval(found.threshold_interval, ".4f"),
        )


def _format_number(value: float | None, form: str = ".3f") -> str:
    """Return a number as text, – if it is unknown."""
    return "–" if value is None or not isfinite(value) else f"{value:{form}}".replace("-", "−")


def _format_interval(interval: tuple[float, float] | None, form: str = ".3f") -> str:
    """Return an interval as text, empty if there is none."""
    if interval is None:
        return ""
    low, high = interval
    return (
        f"{_format_number(low, form)}–{_format_number(high, form)}"
        if isfinite(high)
        else f"from {_format_number(low, form)}"
    )


def print_power(found: PowerCheck) -> None:
    """Print the comparison of power off and on."""
    rows = [row for sensor in found.sensors for row in _power_rows(sensor)]
    rows.append((" paper, power on", _format_number(found.paper, ".4f"), *[""] * 3))
    heads = ("indicator", "mean", "95 %", "max", "points")
    print_table("Indicator with power off and on (means at grid points)", heads, rows)
    for sensor in found.sensors:
        print(_verdict(sensor))
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)


def _power_rows(sensor: PowerComparison) -> list[tuple[str, ...]]:
    return [
        (
            f"{sensor.sensor}, power {name}",
            *(_format_number(value, ".4f") for value in (level.mean, level.p95, level.max)),
            f"{level.n_points}",
        )
        for name, level in (("off", sensor.off), ("on", sensor.on))
    ]


def _verdict(sensor: PowerComparison) -> str:
    interval, on = sensor.difference_interval, sensor.on
    certainty = (
        f"95 % interval {_format_interval(interval, '.4f')}"
        if interval
        else "too few grid points for an interval"
    )
    side = "above" if sensor.above else "not above"
    return (
        f"{sensor.sensor}: power adds {_format_number(sensor.difference, '.4f')} ({certainty}); mean {on.mean:.4f} "
        f"with power on, {side} the threshold of {sensor.threshold:g} "
        f"({sensor.points_above} of {on.n_points} grid points above)"
    )
