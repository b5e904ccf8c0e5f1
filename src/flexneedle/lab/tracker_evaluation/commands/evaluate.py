"""`flexneedle em evaluate`: errors, jitter and distortion indicator of a tracker, from a table of measurements."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json
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
    parser.add_argument(
        "data", metavar="DATA", type=expand_home, help="table of measurements (CSV or Parquet)"
    )
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
        "--out", type=expand_home, metavar="DIR", help="output folder (default: runs/<date>-em-<name>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def _evaluate(args: argparse.Namespace) -> int:
    from flexneedle.lab.tracker_evaluation.commands.evaluation_tables import print_evaluation
    from flexneedle.lab.tracker_evaluation.evaluation.evaluate import (
        RESULT_FILES,
        EvaluationOptions,
        evaluate_table,
        write_evaluation,
    )
    from flexneedle.lab.tracker_evaluation.figures.evaluation import draw_evaluation

    names = ("register", "unit", "ideal", "noisy", "sensor", "environment")
    options = EvaluationOptions(tuple(args.columns), **{name: getattr(args, name) for name in names})
    evaluation = evaluate_table(args.data, options)
    folder = _make_folder(args.out, args.data.stem, RESULT_FILES)
    values = write_evaluation(evaluation, folder, draw_evaluation(evaluation, folder))
    if args.json:
        print_json(values)
    else:
        print_evaluation(evaluation, folder)
    return 0


def _make_folder(out: Path | None, name: str, results: Sequence[str]) -> Path:
    """Create the folder `out`, or a new one in `runs/`, and return it."""
    from flexneedle.errors import InputError
    from flexneedle.files import create_folder

    path = out if out is not None else create_folder("em", name)
    for result in results:
        if (path / result).exists():
            raise InputError(f"{path}: already contains {result}: choose another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror}: choose another --out") from None
    return path
