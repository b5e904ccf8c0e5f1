"""`flexneedle export`: the periods of a run for other programs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

__all__ = ["add_parser"]

_DEFAULT, _STDOUT = "periods.csv", "-"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser("export", help="export the control periods of a run")
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the run")
    parser.add_argument(
        "--csv",
        nargs="?",
        const="",
        required=True,
        metavar="FILE",
        help=f"as CSV, units in the header; {_STDOUT} is stdout (RUN/{_DEFAULT})",
    )
    parser.set_defaults(handler=_export)


def _export(args: argparse.Namespace) -> int:
    from flexneedle.run.export import write_csv
    from flexneedle.run.figures import load_insertion

    insertion, note = load_insertion(args.run)
    if note:
        print(f"flexneedle: {note}", file=sys.stderr)
    if args.csv == _STDOUT:
        write_csv(sys.stdout, insertion.periods)
        return 0
    path = Path(args.csv) if args.csv else args.run / _DEFAULT
    with path.open("w", encoding="utf-8", newline="") as file:
        write_csv(file, insertion.periods)
    print(path)
    return 0
