"""`flexneedle em simulate`: measure a simulated tracker on a grid."""

from __future__ import annotations

import argparse
from pathlib import Path

from flexneedle.console.common import described, seed
from flexneedle.em.commands.arguments import within


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = commands.add_parser(
        "simulate",
        help="measure a simulated tracker on a grid; writes the table that evaluate reads",
        **described(
            "Measure the tip's and a reference sensor of a simulated tracker on a grid over the workspace: "
            "the paper's experiment. Writes the table that `flexneedle em evaluate` reads.",
            "flexneedle em simulate",
            "flexneedle em simulate --environment mine.toml --samples 20 --seed 1 --out mine.parquet",
        ),
    )
    parser.add_argument(
        "--environment",
        nargs="+",
        default=["ideal", "noisy"],
        metavar="ENVIRONMENT",
        help="shipped names or paths of TOML files (default: ideal noisy)",
    )
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        metavar="N",
        help="of the measurement: same seed, same file (default: 0)",
    )
    parser.add_argument(
        "--field-seed",
        type=seed,
        metavar="N",
        help="another room with errors of the same sizes (default: the environment's own)",
    )
    counts = (
        ("points", 2, 100, 5, "points on an edge of the grid"),
        ("samples", 1, 100_000, 100, "samples at a point"),
        ("repeats", 1, 1000, 5, "times through the grid"),
    )
    for name, least, most, default, what in counts:
        parser.add_argument(
            f"--{name}",
            type=within(least, most, int),
            default=default,
            metavar="N",
            help=f"{what} (default: {default})",
        )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("measurements.csv"),
        metavar="FILE",
        help="the table, CSV or Parquet by its suffix, a new file (default: measurements.csv)",
    )
    parser.set_defaults(handler=_simulate)


def _simulate(args: argparse.Namespace) -> int:
    from flexneedle.em.simulate import Experiment, check_new, measure, write_measurements
    from flexneedle.scenario.files import load_environment

    check_new(args.out)
    experiment = Experiment(args.seed, args.field_seed, args.points, args.samples, args.repeats)
    table = measure([load_environment(source) for source in args.environment], experiment)
    write_measurements(table, args.out)
    print(args.out)
    return 0
