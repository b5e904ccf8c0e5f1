"""Arguments that several commands of `flexneedle em` share; argparse prints what is wrong with a value."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from math import inf, isfinite


def within(least: float, most: float = inf, kind: type[float] | type[int] = float) -> Callable[[str], float]:
    """Return the type of a finite number from `least` to `most`."""
    rule = f"must be at least {least:g}" if most == inf else f"must be from {least:g} to {most:g}"

    def number(text: str) -> float:
        value = kind(text)
        if not (isfinite(value) and least <= value <= most):
            raise argparse.ArgumentTypeError(f"{text}: {rule}")
        return value

    number.__name__ = kind.__name__  # argparse names the type of a text that is no number by it
    return number


def positive(text: str) -> float:
    """Return a finite number above 0."""
    value = float(text)
    if not (isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0")
    return value


def finite(text: str) -> float:
    """Return a finite number."""
    value = float(text)
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number")
    return value


def name(text: str) -> str:
    """Return a name without blanks around it."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must be a name")
    return text.strip()


def add_columns(parser: argparse.ArgumentParser) -> None:
    """Add the names of the columns of a table."""
    parser.add_argument(
        "--columns",
        action="append",
        default=[],
        metavar="THEIRS=OURS",
        help='a column of another name, such as --columns X=x_mm, or a TOML file of lines such as X = "x_mm"; '
        "may be given several times",
    )


def add_labels(parser: argparse.ArgumentParser) -> None:
    """Add the unit of a table, and the sensor and environment of one without such columns."""
    parser.add_argument(
        "--unit",
        choices=("mm", "m"),
        help="of all lengths (default: mm; lengths that look like metres are refused)",
    )
    for column in ("sensor", "environment"):
        parser.add_argument(
            f"--{column}",
            type=name,
            metavar="NAME",
            help=f"of all rows, for a table without a column {column}",
        )
