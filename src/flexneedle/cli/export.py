"""`flexneedle export`: the periods of a run, or the tracker's readings, for other programs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from flexneedle.console.common import HelpFormatter, examples
from flexneedle.errors import InputError

_PERIODS, _READINGS, _STDOUT = "periods.csv", "readings.csv", "-"
_MORE = """
--csv: one row a control period, the columns of flexneedle.to_dataframe.
--readings: one row a reading of the tracker, the units in the header.
  time_s, period, frame_number    when it was taken, in which control period it
                                  came, the tracker's own count of frames
  verdict                         ok, or why it was not used
  x_mm, y_mm, z_mm                tip of the needle, in the frame of the stage
  NAME.x_mm, NAME.y_mm, NAME.z_mm, NAME.qw, NAME.qx, NAME.qy, NAME.qz,
  NAME.indicator, NAME.status     each sensor (tip, ref1, ...) as the tracker
                                  reports it, in the tracker's frame
What is not known is empty. A tracker without frames has no sensors.

"""
_EXAMPLES = examples("flexneedle export runs/mine --csv", "flexneedle export runs/mine --readings - | head")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "export",
        help="export the control periods or the tracker's readings of a run",
        epilog=_MORE + _EXAMPLES,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the run")
    what = parser.add_mutually_exclusive_group(required=True)
    for option, rows, default in (
        ("--csv", "control periods", _PERIODS),
        ("--readings", "readings of the tracker", _READINGS),
    ):
        what.add_argument(
            option,
            nargs="?",
            const="",
            metavar="FILE",
            help=f"{rows} as CSV, units in the header; {_STDOUT} is stdout (default: RUN/{default})",
        )
    parser.set_defaults(handler=_export)


def _export(args: argparse.Namespace) -> int:
    from flexneedle.runs.reading import load_insertion
    from flexneedle.trace.export import write_csv, write_readings

    if args.csv is not None:
        write, name, default = write_csv, args.csv, _PERIODS
    else:
        write, name, default = write_readings, args.readings, _READINGS
    insertion, note = load_insertion(args.run)
    if note:
        print(f"flexneedle: {note}", file=sys.stderr)
    if name == _STDOUT:
        write(sys.stdout, insertion.periods)
        return 0
    path = Path(name) if name else args.run / default
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            write(file, insertion.periods)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    print(path)
    return 0
