"""Arguments shared by the commands of `flexneedle em`; argparse prints the reason why a value is invalid."""

from __future__ import annotations

import argparse


def parse_name(text: str) -> str:
    """Return a name without leading and trailing blanks."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be blank")
    return text.strip()


def add_columns(parser: argparse.ArgumentParser) -> None:
    """Add the option that maps the columns of a table."""
    parser.add_argument(
        "--columns",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="name of a column, such as X=x_mm; repeatable",
    )


def add_labels(parser: argparse.ArgumentParser) -> None:
    """Add the unit of a table, and the sensor and environment of a table that lacks these columns."""
    parser.add_argument(
        "--unit",
        choices=("mm", "m"),
        default="mm",
        help="unit of all lengths (default: mm)",
    )
    for column in ("sensor", "environment"):
        parser.add_argument(
            f"--{column}",
            type=parse_name,
            metavar="NAME",
            help=f"{column} of all rows, for a table without a column {column}",
        )
