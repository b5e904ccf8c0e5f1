"""`flexneedle em check`: does the rig's own power distort the tracker's field?"""

from __future__ import annotations

import argparse

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json
from flexneedle.cli.values import positive
from flexneedle.lab.tracker_evaluation.commands.arguments import add_columns, add_labels

_THRESHOLD = 0.0547  # paper, section IV-B


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "check",
        "compare the indicator with the rig's power off and on",
        _check,
        "flexneedle em check power.csv",
        "flexneedle em check power.csv --off quiet --on driven --threshold 0.04",
        about="Compare the distortion indicator with the rig's power off and on, two environments in "
        "one table. Exit status 1 if the mean indicator of a sensor with power on exceeds the "
        "threshold.",
    )
    parser.add_argument(
        "data", metavar="DATA", type=expand_home, help="table with both environments (CSV or Parquet)"
    )
    for power in ("off", "on"):
        parser.add_argument(
            f"--{power}",
            default=power,
            metavar="NAME",
            help=f"environment measured with power {power} (default: {power})",
        )
    parser.add_argument(
        "--threshold",
        type=positive,
        default=_THRESHOLD,
        metavar="I",
        help="threshold of the mean indicator (default: %(default)s)",
    )
    add_columns(parser)
    add_labels(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def _check(args: argparse.Namespace) -> int:
    from flexneedle.lab.tracker_evaluation.commands.evaluation_tables import print_power
    from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions
    from flexneedle.lab.tracker_evaluation.evaluation.power_check import check_power

    options = EvaluationOptions(
        tuple(args.columns), unit=args.unit, sensor=args.sensor, environment=args.environment
    )
    found = check_power(args.data, args.off, args.on, args.threshold, options)
    if args.json:
        print_json(found.values())
    else:
        print_power(found)
    return 1 if found.above else 0
