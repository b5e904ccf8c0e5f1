"""`flexneedle view`: redraw the figures of a run, or write a file that replays it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from flexneedle.console.commands import Commands, add_command
from flexneedle.errors import InputError

_REPLAY, _STDOUT = "replay.html", "-"


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "view",
        "redraw the figures of a run, finished or not, or replay it in a browser",
        _view,
        "flexneedle view runs/20260101T120000Z-phantom-0",
        "flexneedle view runs/mine --html",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the run")
    parser.add_argument(
        "--html",
        nargs="?",
        const="",
        metavar="FILE",
        help="instead, write one file that replays a finished insertion by itself in any browser, without network; "
        f"{_STDOUT}: stdout (default: RUN/{_REPLAY})",
    )
    parser.add_argument(
        "--compare",
        metavar="RUN",
        type=Path,
        help="with --html: folder of a second insertion, shown beside the first",
    )


def _view(args: argparse.Namespace) -> int:
    if args.html is not None:
        return _replay(args)
    if args.compare is not None:
        raise InputError("--compare: needs --html")
    from flexneedle.runs.figures import draw_run

    for path in draw_run(args.run, _note):
        print(path)
    return 0


def _replay(args: argparse.Namespace) -> int:
    from flexneedle.files import replace_file
    from flexneedle.page.replay.document import replay_of

    data = replay_of(args.run, args.compare, _note).encode()
    if args.html == _STDOUT:
        sys.stdout.buffer.write(data)
        return 0
    path = Path(args.html) if args.html else args.run / _REPLAY
    replace_file(path, data)
    print(path)
    return 0


def _note(line: str) -> None:
    print(f"flexneedle: {line}", file=sys.stderr)
