"""`flexneedle em evaluate`: errors, jitter and indicator of a tracker from a table of measurements."""

from __future__ import annotations

import argparse
from pathlib import Path

from flexneedle.console.common import described, print_json
from flexneedle.em.commands.arguments import add_columns, add_labels, positive


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = commands.add_parser(
        "evaluate",
        help="measure a tracker's errors and its indicator of distortion",
        **described(
            "Measure a tracker's errors, jitter and indicator of distortion from a table of repeated measurements on "
            "a grid, one row a sample (docs/tracking/evaluate.md).",
            "flexneedle em evaluate measurements.csv",
            'flexneedle em evaluate table.parquet --register --columns "X [mm]=x_mm" --json',
        ),
    )
    parser.add_argument("data", metavar="DATA", type=Path, help="table, CSV or Parquet")
    parser.add_argument(
        "--register",
        action="store_true",
        help="first fit the tracker's frame to the stage's (rigid, least squares), by sensor and environment",
    )
    add_columns(parser)
    add_labels(parser)
    parser.add_argument(
        "--ideal", metavar="NAME", help="environment that sets the threshold (default: ideal)"
    )
    parser.add_argument("--noisy", metavar="NAME", help="environment to separate from it (default: noisy)")
    parser.add_argument(
        "--bin-mm",
        type=positive,
        default=50.0,
        metavar="MM",
        help="width of the bins of distance_mm (default: 50)",
    )
    parser.add_argument(
        "--limit-mm",
        type=positive,
        metavar="MM",
        help="RMSE for the smallest distance (default: the maker's, for tip and reference)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results (default: runs/<date>-em-<name>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.set_defaults(handler=_evaluate)


def _evaluate(args: argparse.Namespace) -> int:
    from flexneedle.em.commands.results import print_evaluation
    from flexneedle.em.evaluation.evaluate import RESULT_FILES, Options, evaluate, write_evaluation
    from flexneedle.em.figures.evaluation import draw_evaluation
    from flexneedle.em.place import claim

    names = ("register", "unit", "bin_mm", "limit_mm", "ideal", "noisy", "sensor", "environment")
    options = Options(tuple(args.columns), **{name: getattr(args, name) for name in names})
    evaluation = evaluate(args.data, options)
    folder = claim(args.out, args.data.stem, RESULT_FILES)
    values = write_evaluation(evaluation, folder, draw_evaluation(evaluation, folder))
    if args.json:
        print_json(values)
    else:
        print_evaluation(evaluation, folder)
    return 0
