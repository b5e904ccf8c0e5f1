"""Options of `flexneedle view`: a row of a study, and a file that replays a run."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands
from flexneedle.cli.progress import print_note
from flexneedle.cli.view import draw
from flexneedle.errors import InputError

if TYPE_CHECKING:
    from flexneedle.results import Insertion

_REPLAY, _STDOUT = "replay.html", "-"
_FIGURES = (".png", ".svg")
_SHORT_S = 1.0  # what takes no longer shows no progress


def add_options(commands: Commands) -> None:
    """Add the options to the command `view`."""
    parser = commands.choices["view"]
    parser.set_defaults(handler=_view)
    parser.add_argument(
        "--row",
        type=int,
        metavar="INDEX",
        help="compute this row of the study again, and save and draw the run",
    )
    parser.add_argument(
        "--out",
        type=expand_home,
        metavar="DIR",
        help="with --row: folder of the new run (default: RUN/rows/row-INDEX)",
    )
    parser.add_argument(
        "--html",
        nargs="?",
        const="",
        metavar="FILE",
        help="write one HTML file that replays a finished insertion offline in any browser; -: stdout "
        "(default: RUN/replay.html)",
    )
    parser.add_argument(
        "--compare",
        metavar="RUN",
        type=expand_home,
        help="with --html: folder of a second insertion, shown beside the first",
    )


def _view(args: argparse.Namespace) -> int:
    if args.html is None and args.compare is not None:
        raise InputError("--compare: needs --html")
    if args.row is None and args.out is not None:
        raise InputError("--out: needs --row")
    folder, drawn = (args.run, []) if args.row is None else _row(args.run, args.row, args.out)
    if args.row is None and _has_study(folder):
        raise InputError(f"{folder}: is a study: choose a row with --row INDEX")
    if args.html is not None:
        return _replay(folder, args.html, args.compare)
    if not drawn:
        return draw(argparse.Namespace(run=folder))
    for path in drawn:
        print(path)
    return 0


def _has_study(folder: Path) -> bool:
    from flexneedle.record.folder import RUN_FILE, STUDY_FILE

    return (folder / STUDY_FILE).is_file() and not (folder / RUN_FILE).exists()


def _row(study: Path, index: int, out: Path | None) -> tuple[Path, list[Path]]:
    """Return the folder of a row's run, and the figures drawn with it: none if it was computed before."""
    from flexneedle.lab.study.recompute import row_folder
    from flexneedle.record.folder import RUN_FILE
    from flexneedle.record.saving import save

    folder = row_folder(study, index) if out is None else out
    if (folder / RUN_FILE).exists():
        if out is not None:
            raise InputError(f"{out}: already contains a run ({RUN_FILE}): choose another folder")
        print_note(f"{folder}: computed before: remove it to compute the row again")
        return folder, []
    save(_recompute_row(study, index), folder)
    return folder, sorted(path for path in folder.iterdir() if path.suffix in _FIGURES)


def _recompute_row(study: Path, index: int) -> Insertion:
    from flexneedle.cli.progress import Progress
    from flexneedle.lab.study.recompute import recompute

    begun = time.monotonic()
    with Progress() as progress:

        def on_share(share: float) -> None:
            if time.monotonic() > begun + _SHORT_S:
                progress.show("Inserting", share, 1.0, f"row {index}")

        again = recompute(study, index, on_share)
    if again.note:
        print_note(again.note)
    return again.insertion


def _replay(folder: Path, html: str, compare: Path | None) -> int:
    from flexneedle.files import replace_file
    from flexneedle.lab.page.replay import make_replay

    data = make_replay(folder, compare, print_note).encode()
    if html == _STDOUT:
        sys.stdout.buffer.write(data)
        return 0
    path = expand_home(html) if html else folder / _REPLAY
    replace_file(path, data)
    print(path)
    return 0
