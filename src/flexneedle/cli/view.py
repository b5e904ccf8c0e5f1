"""`flexneedle view`: redraw the figures of a run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from flexneedle.console.commands import Commands, add_command


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "view",
        "redraw the figures of a run, finished or not",
        _view,
        "flexneedle view runs/20260101T120000Z-phantom-0",
        "flexneedle view runs/mine",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the run")


def _view(args: argparse.Namespace) -> int:
    from flexneedle.runs.figures import draw_run

    for path in draw_run(args.run, lambda line: print(f"flexneedle: {line}", file=sys.stderr)):
        print(path)
    return 0
