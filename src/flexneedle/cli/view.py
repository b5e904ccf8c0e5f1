"""`flexneedle view`: redraw the figures of a run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from flexneedle.console.common import with_examples


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "view",
        help="redraw the figures of a run, finished or not",
        **with_examples(
            "flexneedle view runs/20260101T120000Z-phantom-0",
            "flexneedle view runs/mine",
        ),
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the run")
    parser.set_defaults(handler=_view)


def _view(args: argparse.Namespace) -> int:
    from flexneedle.runs.figures import draw_run

    for path in draw_run(args.run, lambda line: print(f"flexneedle: {line}", file=sys.stderr)):
        print(path)
    return 0
