"""`flexneedle em evaluate`: errors, jitter and indicator of a tracker from a table of measurements."""

from __future__ import annotations

import argparse
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.console.common import print_json
from flexneedle.em.commands.tables import number, print_notes, print_rows, span

if TYPE_CHECKING:
    from collections.abc import Iterator

    from flexneedle.em.evaluation.evaluate import Evaluation, Options, Result
    from flexneedle.em.evaluation.separation import Separation


_SIDE_BY_SIDE = 4
_ERRORS = ("rmse_mm", "p95_mm", "max_mm", "jitter_mm")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = commands.add_parser(
        "evaluate",
        help="measure a tracker's errors and its indicator of distortion",
        description="Measure a tracker's errors, jitter and indicator of distortion from a table of repeated "
        "measurements on a grid, one row a sample (docs/tracking/evaluate.md).",
    )
    parser.add_argument("data", metavar="DATA", type=Path, help="table, CSV or Parquet")
    parser.add_argument(
        "--register",
        action="store_true",
        help="first fit the tracker's frame to the stage's (rigid, least squares), by sensor and environment",
    )
    add_table_arguments(parser)
    parser.add_argument("--ideal", metavar="NAME", help="environment that sets the threshold (ideal)")
    parser.add_argument("--noisy", metavar="NAME", help="environment to tell it from (noisy)")
    parser.add_argument(
        "--bin-mm", type=positive, default=50.0, metavar="MM", help="width of the bins of distance_mm (50)"
    )
    parser.add_argument(
        "--limit-mm",
        type=positive,
        metavar="MM",
        help="find the smallest distance with at most this RMSE (the maker's RMSE, for tip and reference)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results (runs/<date>-em-<name>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.set_defaults(handler=_evaluate)


def add_table_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what all commands have that read a table."""
    parser.add_argument(
        "--columns",
        action="append",
        default=[],
        metavar="THEIRS=OURS",
        help='a column of another name, such as --columns X=x_mm, or a TOML file of lines such as X = "x_mm"; '
        "may be given several times",
    )
    parser.add_argument(
        "--unit", choices=("mm", "m"), help="of all lengths (mm, refused where they look like metres)"
    )
    for name in ("sensor", "environment"):
        parser.add_argument(
            f"--{name}", type=_name, metavar="NAME", help=f"of all rows, for a table without a column {name}"
        )


def positive(text: str) -> float:
    """Return a positive number; argparse says what is wrong with another."""
    value = float(text)
    if not (isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0")
    return value


def _name(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("must be a name")
    return text.strip()


def table_options(args: argparse.Namespace) -> Options:
    """Return how the table is to be read."""
    from flexneedle.em.evaluation.evaluate import Options

    return Options(
        columns=tuple(args.columns), unit=args.unit, sensor=args.sensor, environment=args.environment
    )


def _evaluate(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from flexneedle.em.evaluation.evaluate import RESULT_FILES, evaluate, write_evaluation
    from flexneedle.em.evaluation.figures import draw_evaluation
    from flexneedle.em.place import claim

    told = ("register", "bin_mm", "limit_mm", "ideal", "noisy")
    options = replace(table_options(args), **{name: getattr(args, name) for name in told})
    evaluation = evaluate(args.data, options)
    folder = claim(args.out, args.data.stem, RESULT_FILES)
    values = write_evaluation(evaluation, folder, draw_evaluation(evaluation, folder))
    if args.json:
        print_json(values)
        return 0
    _print(evaluation)
    print_notes(evaluation.notes)
    print(f"Record and figures: {folder}")
    return 0


def _print(evaluation: Evaluation) -> None:
    frame = ", after a rigid fit of each sensor and environment" if evaluation.options.register else ""
    heads = ("", "rmse", "95 %", "max", "jitter", "points", "samples")
    results = evaluation.results
    print_rows(f"Errors (mm){frame}", heads, [row for result in results for row in _error_rows(result)])
    shown = [row for result in results for row in _indicator_rows(result)]
    if shown:
        print_rows(
            "Indicator, means at grid points", ("", "mean", "sd", "max", "min", "95 %", "points"), shown
        )
    pair = evaluation.options.pair
    fits = [row for found in evaluation.separations for row in _separation_rows(found, *pair)]
    if fits:
        print_rows("Indicator and error", ("", "", "95 % interval", "paper"), fits)
    for start in range(0, len(results), _SIDE_BY_SIDE):
        some = results[start : start + _SIDE_BY_SIDE]
        print_rows("Further (mm)", ("", *(result.title for result in some)), _further(some))


def _error_rows(result: Result) -> Iterator[tuple[str, ...]]:
    found, values = result.accuracy, result.values()
    counts = f"{found.n_points}", f"{found.n_samples}"
    yield (result.title, *(number(values[key]) for key in _ERRORS), *counts)
    if any(found.intervals.values()):
        ends = (span(found.intervals.get(key)) for key in _ERRORS)
        yield (" 95 % interval", *ends, "", "")
    for name, key in (("paper", "paper"), ("maker", "official")):
        if values[key]:
            yield (f" {name}", *(number(values[key].get(k), ".2f") for k in _ERRORS), "", "")


def _indicator_rows(result: Result) -> Iterator[tuple[str, ...]]:
    from flexneedle.em.evaluation import published
    from flexneedle.rig.tracking.table import REFERENCE

    found = result.summary
    if found is None:
        return
    row = (found.mean, found.sd, found.max, found.min, found.p95)
    yield (result.title, *(number(value, ".4f") for value in row), f"{found.n_points}")
    one = found.samples
    single = (one.mean, None, one.max, one.min, one.p95)
    yield (" single samples", *(number(value, ".4f") for value in single), f"{one.n_samples}")
    paper = published.INDICATOR.get(result.grid.environment)
    if paper and published.kind(result.grid.sensor) == REFERENCE:
        yield (" paper", *(number(paper.get(key), ".4f") for key in ("mean", "sd", "max", "min", "p95")), "")


def _separation_rows(found: Separation, ideal: str, noisy: str) -> Iterator[tuple[str, ...]]:
    """The rows, with the paper's values for its own sensor in its own environments."""
    from flexneedle.em.evaluation import published
    from flexneedle.rig.tracking.table import REFERENCE

    of_paper = published.kind(found.sensor) == REFERENCE
    of_paper &= (ideal, noisy) == (published.IDEAL, published.NOISY)
    fits = published.FITS
    papers = {
        f"{ideal}: error (mm)": f"{fits['mean_mm']} ± {fits['sd_mm']}",
        f"{noisy}: slope (mm)": str(fits["slope_mm"]),
        f"{noisy}: intercept (mm)": str(fits["intercept_mm"]),
        "threshold": str(published.THRESHOLD),
    }
    for row in _found_rows(found, ideal, noisy):
        told = row[0].removeprefix(found.sensor).lstrip(", :")
        yield (*row, papers.get(told, "") if of_paper else "")


def _found_rows(found: Separation, ideal: str, noisy: str) -> Iterator[tuple[str, str, str]]:
    name = found.sensor
    if found.ideal:
        flat, ends = found.ideal, found.ideal.intervals
        yield (
            f"{name}, {ideal}: error (mm)",
            f"{number(flat.mean_mm)} ± {number(flat.sd_mm)}",
            span(ends["mean_mm"]),
        )
    if found.noisy:
        line, ends = found.noisy, found.noisy.intervals
        yield f"{name}, {noisy}: slope (mm)", number(line.slope_mm), span(ends["slope_mm"])
        yield f"{name}, {noisy}: intercept (mm)", number(line.intercept_mm), span(ends["intercept_mm"])
        yield f"{name}, {noisy}: scatter about the line (mm)", number(line.scatter_mm), ""
    if found.threshold is not None:
        yield f"{name}: threshold", number(found.threshold, ".4f"), span(found.threshold_interval, ".4f")
        yield f"{name}: threshold of single samples", number(found.samples_threshold, ".4f"), ""
    if found.confusion and found.auc is not None:
        c = found.confusion
        yield f"{name}, {ideal}: points below, above", f"{c.ideal_below}, {c.ideal_above}", ""
        yield f"{name}, {noisy}: points below, above", f"{c.noisy_below}, {c.noisy_above}", ""
        yield f"{name}: area under the ROC", number(found.auc, ".4f"), span(found.auc_interval, ".4f")


def _further(results: list[Result]) -> Iterator[tuple[str, ...]]:
    def row(name: str, told: list[str]) -> tuple[str, ...]:
        return (name, *told)

    yield row(
        "mean error ± sd", [f"{number(r.accuracy.mean_mm)} ± {number(r.accuracy.sd_mm)}" for r in results]
    )
    yield row("distance error, rms", [number(r.spacing.rms_mm) for r in results])
    yield row(" 95 %, max", [f"{number(r.spacing.p95_mm)}, {number(r.spacing.max_mm)}" for r in results])
    yield row(" rms, closest neighbours", [number(r.spacing.neighbours_rms_mm) for r in results])
    yield row("repeatability, sd", [number(r.repeatability.sd_mm) for r in results])
    yield row(" of the worst point", [number(r.repeatability.worst_mm) for r in results])
    if any(r.orientation for r in results):
        turns = [r.orientation for r in results]
        yield row("orientation jitter (°)", [number(t.jitter_deg if t else None) for t in turns])
        yield row(" of the sensor's axis (°)", [number(t.axis_jitter_deg if t else None) for t in turns])
    if any(r.distances for r in results):
        yield row("limit on the rmse at a distance", [_limit(r) for r in results])
        yield row(" is kept", [r.distances.told if r.distances else "–" for r in results])
    fits = [r.registration for r in results]
    if any(fits):
        yield row("rigid fit, residual", [number(fit.residual_mm if fit else None) for fit in fits])
        yield row(" turn (°)", [number(fit.angle_deg if fit else None) for fit in fits])
        for k, axis in enumerate("xyz"):
            yield row(f" shift {axis}", [number(fit.translation_mm[k] if fit else None) for fit in fits])


def _limit(result: Result) -> str:
    found = result.distances
    return number(found.limit_mm if found else None, "g")
