"""`flexneedle export`: control periods or tracker readings of a run as CSV."""

from __future__ import annotations

import argparse
import sys

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.progress import print_note
from flexneedle.errors import InputError

_PERIODS, _READINGS, _STDOUT = "periods.csv", "readings.csv", "-"
_COLUMN_HELP = """
--csv: one row per control period; columns as in flexneedle.to_dataframe.
--readings: one row per tracker reading.
  time_s, period, frame_number    time of measurement, control period of
                                  arrival, frame number of the tracker
  verdict                         ok, or the reason for the rejection
  x_mm, y_mm, z_mm                needle tip in the stage frame
  direction_theta_rad, direction_psi_rad, points_mm, covariance_mm2,
  direction_covariance_rad2       if measured: slopes of the needle at the tip,
                                  points along the needle, covariances; numbers
                                  separated by spaces, rows by semicolons
  NAME.x_mm, NAME.y_mm, NAME.z_mm, NAME.qw, NAME.qx, NAME.qy, NAME.qz,
  NAME.indicator, NAME.status     each sensor (tip, ref1, ...) as reported by
                                  the tracker, in the tracker frame
Unknown values are empty. A tracker without frames has no sensor columns. A dry
run adds a last column dry_run, an insertion disturbed on the page (serve) a
column disturbed.

"""


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "export",
        "export the control periods or the tracker readings of a run",
        export,
        "flexneedle export runs/mine --csv",
        "flexneedle export runs/mine --readings - | head",
        notes=_COLUMN_HELP,
    )
    parser.add_argument("run", metavar="RUN", type=expand_home, help="folder of the run")
    what = parser.add_mutually_exclusive_group()
    for option, rows, default in (
        ("--csv", "control periods", _PERIODS),
        ("--readings", "tracker readings", _READINGS),
    ):
        what.add_argument(
            option,
            nargs="?",
            const="",
            metavar="FILE",
            help=f"export {rows} as CSV, units in the header; {_STDOUT}: stdout (default: RUN/{default})",
        )


def export(args: argparse.Namespace) -> int:
    """Write the CSV file."""
    from flexneedle.record.export import write_csv, write_readings
    from flexneedle.record.loading import load_insertion

    if args.csv is None and args.readings is None:
        raise InputError("--csv or --readings: one must be given")
    if args.csv is not None:
        write, name, default = write_csv, args.csv, _PERIODS
    else:
        write, name, default = write_readings, args.readings, _READINGS
    insertion, note = load_insertion(args.run)
    if note:
        print_note(note)
    if name == _STDOUT:
        write(sys.stdout, insertion)
        return 0
    path = expand_home(name) if name else args.run / default
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            write(file, insertion)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    print(path)
    return 0
