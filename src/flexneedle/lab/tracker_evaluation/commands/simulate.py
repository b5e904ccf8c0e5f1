"""`flexneedle em simulate`: record a simulated tracker at the points of a grid."""

from __future__ import annotations

import argparse
from pathlib import Path

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import add_seed
from flexneedle.cli.values import make_number_type, seed


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "simulate",
        "record a simulated tracker at the points of a grid; writes a table for evaluate",
        _simulate,
        "flexneedle em simulate",
        "flexneedle em simulate --environment mine.toml --samples 20 --seed 1 --out mine.parquet",
        about="Record the tip sensor and a reference sensor of a simulated tracker on a grid over the workspace: "
        "the paper's experiment. Writes a table for `flexneedle em evaluate`.",
    )
    parser.add_argument(
        "--environment",
        nargs="+",
        default=["ideal", "noisy"],
        metavar="ENVIRONMENT",
        help="names of shipped environments or paths of TOML files (default: ideal noisy)",
    )
    add_seed(parser, "seed of the noise: same seed, same file")
    parser.add_argument(
        "--field-seed",
        type=seed,
        metavar="N",
        help="seed of the field errors (default: as in the environment)",
    )
    counts = (
        ("points", 2, 100, 5, "grid points per edge"),
        ("samples", 1, 100_000, 100, "samples per point and repeat"),
        ("repeats", 1, 1000, 5, "repeats of the grid"),
    )
    for name, minimum, maximum, default, meaning in counts:
        parser.add_argument(
            f"--{name}",
            type=make_number_type(int, minimum, maximum),
            default=default,
            metavar="N",
            help=f"{meaning} (default: {default})",
        )
    parser.add_argument(
        "--out",
        type=expand_home,
        default=Path("measurements.csv"),
        metavar="FILE",
        help="new file, CSV or Parquet by its suffix (default: measurements.csv)",
    )


def _simulate(args: argparse.Namespace) -> int:
    from flexneedle.arguments import require_extra
    from flexneedle.lab.tables.write import check_new, write_table
    from flexneedle.lab.tracker_evaluation.simulate import Experiment, measure_grid
    from flexneedle.scenario.files import load_environment

    require_extra("em", "duckdb")
    check_new(args.out)
    experiment = Experiment(args.seed, args.field_seed, args.points, args.samples, args.repeats)
    table = measure_grid([load_environment(source) for source in args.environment], experiment)
    write_table(table, args.out)
    print(args.out)
    return 0
