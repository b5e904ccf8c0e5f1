"""`flexneedle em`: evaluate, simulate and record electromagnetic trackers."""

from __future__ import annotations

from flexneedle.cli.commands import Commands, add_group
from flexneedle.lab.tracker_evaluation.commands import check, evaluate, record, register, simulate, watch


def add_parser(commands: Commands) -> None:
    """Add the command and its subcommands to the parser of `flexneedle`."""
    add_group(
        commands,
        "em",
        "evaluate, simulate or record an electromagnetic tracker",
        [command.add_parser for command in (evaluate, check, simulate, register, record, watch)],
        "flexneedle em simulate",
        "flexneedle em evaluate measurements.csv",
    )
