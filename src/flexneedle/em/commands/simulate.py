"""`flexneedle em simulate`: measure a simulated tracker on a grid."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from flexneedle.console.common import seed


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = subparsers.add_parser(
        "simulate",
        help="measure a simulated tracker on a grid, as `em evaluate` reads it",
        description="Measure the tip's and a reference sensor of a simulated tracker on a grid over the workspace: "
        "the paper's experiment. Writes the table that `flexneedle em evaluate` reads.",
    )
    parser.add_argument(
        "--environment",
        nargs="+",
        default=["ideal", "noisy"],
        metavar="ENVIRONMENT",
        help="shipped names or paths of TOML files (ideal noisy)",
    )
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="of the measurement: same seed, same file (0)"
    )
    parser.add_argument(
        "--field-seed",
        type=seed,
        metavar="N",
        help="another room with errors of the same sizes (that of the environment)",
    )
    parser.add_argument(
        "--points", type=_count(2, 100), default=5, metavar="N", help="points on an edge of the grid (5)"
    )
    parser.add_argument(
        "--samples", type=_count(1, 100_000), default=100, metavar="N", help="samples at a point (100)"
    )
    parser.add_argument(
        "--repeats", type=_count(1, 1000), default=5, metavar="N", help="times through the grid (5)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("measurements.csv"),
        metavar="FILE",
        help="the table, CSV or Parquet by its suffix, a new file (measurements.csv)",
    )
    parser.set_defaults(handler=_simulate)


def _count(least: int, most: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        value = int(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{value}: must be from {least} to {most}")
        return value

    return count


def _simulate(args: argparse.Namespace) -> int:
    from flexneedle.em.simulate import Experiment, check_new, measure, write_measurements
    from flexneedle.scenario.files import load_environment

    check_new(args.out)
    experiment = Experiment(args.seed, args.field_seed, args.points, args.samples, args.repeats)
    table = measure([load_environment(source) for source in args.environment], experiment)
    write_measurements(table, args.out)
    print(args.out)
    return 0
