"""`flexneedle view`: redraw the figures of a run."""

from __future__ import annotations

import argparse

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import add_width
from flexneedle.cli.progress import print_note


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "view",
        "redraw the figures of a run, finished or not, or of a row of a study, or replay it in a browser",
        draw,
        "flexneedle view runs/mine --html",
        "flexneedle view runs/accuracy --row 17",
    )
    parser.add_argument(
        "run", metavar="RUN", type=expand_home, help="folder of the run, or of a study with --row"
    )
    add_width(parser)


def draw(args: argparse.Namespace) -> int:
    """Draw the figures of a run and print their paths; return the exit status."""
    from flexneedle.record.figures import draw_run

    for path in draw_run(args.run, print_note):
        print(path)
    return 0
