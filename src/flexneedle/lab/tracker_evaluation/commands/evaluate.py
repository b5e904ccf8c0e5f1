"""`flexneedle em evaluate`: errors, jitter and distortion indicator of a tracker, from a table of measurements."""

from __future__ import annotations

import argparse
from pathlib import Path

from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json
from flexneedle.cli.values import positive
from flexneedle.lab.tracker_evaluation.commands.arguments import add_columns, add_labels


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "evaluate",
        "compute a tracker's errors and distortion indicator from measurements",
        _evaluate,
        "flexneedle em evaluate measurements.csv",
        'flexneedle em evaluate table.parquet --register --columns "X [mm]=x_mm" --json',
        about="Compute a tracker's errors, jitter and distortion indicator from repeated measurements on a grid, one "
        "row per sample (docs/tracking/evaluate.md).",
    )
    parser.add_argument("data", metavar="DATA", type=Path, help="table of measurements (CSV or Parquet)")
    parser.add_argument(
        "--register",
        action="store_true",
        help="first register the tracker's frame to the stage's (rigid, least squares) for each sensor and environment",
    )
    add_columns(parser)
    add_labels(parser)
    parser.add_argument(
        "--ideal", metavar="NAME", help="environment that defines the threshold (default: ideal)"
    )
    parser.add_argument(
        "--noisy", metavar="NAME", help="environment to be detected by the threshold (default: noisy)"
    )
    parser.add_argument(
        "--bin-mm",
        type=positive,
        default=50.0,
        metavar="MM",
        help="bin width of distance_mm (default: 50)",
    )
    parser.add_argument(
        "--limit-mm",
        type=positive,
        metavar="MM",
        help="limit of the RMSE over distance (default: the manufacturer's RMSE, for tip and reference)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: runs/<date>-em-<name>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def _evaluate(args: argparse.Namespace) -> int:
    from flexneedle.lab.tracker_evaluation.commands.results import print_evaluation
    from flexneedle.lab.tracker_evaluation.evaluation.evaluate import (
        RESULT_FILES,
        EvaluationOptions,
        evaluate_table,
        write_evaluation,
    )
    from flexneedle.lab.tracker_evaluation.figures.evaluation import draw_evaluation
    from flexneedle.lab.tracker_evaluation.results_folder import make_results_folder

    names = ("register", "unit", "bin_mm", "limit_mm", "ideal", "noisy", "sensor", "environment")
    options = EvaluationOptions(tuple(args.columns), **{name: getattr(args, name) for name in names})
    evaluation = evaluate_table(args.data, options)
    folder = make_results_folder(args.out, args.data.stem, RESULT_FILES)
    values = write_evaluation(evaluation, folder, draw_evaluation(evaluation, folder))
    if args.json:
        print_json(values)
    else:
        print_evaluation(evaluation, folder)
    return 0
