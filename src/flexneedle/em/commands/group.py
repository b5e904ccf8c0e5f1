"""`flexneedle em`: evaluate, simulate and record electromagnetic trackers."""

from __future__ import annotations

import argparse
from typing import Any

from flexneedle.console.common import with_examples
from flexneedle.em.commands import check, evaluate, record, register, simulate, watch

_COMMANDS: tuple[Any, ...] = (evaluate, check, simulate, register, record, watch)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its subcommands to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "em",
        help="evaluate, simulate or record an electromagnetic tracker",
        **with_examples("flexneedle em simulate", "flexneedle em evaluate measurements.csv"),
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in _COMMANDS:
        command.add_parser(commands)
