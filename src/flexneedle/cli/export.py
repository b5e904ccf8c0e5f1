"""`flexneedle export`: control periods, or readings of the tracker or of other sensors, of a run as CSV."""

from __future__ import annotations

import argparse
import sys

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.progress import print_note
from flexneedle.errors import InputError

_STDOUT = "-"
_TABLES = {
    "csv": ("control periods", "periods.csv"),
    "readings": ("tracker readings", "readings.csv"),
    "sensors": ("readings of the sensors along the needle", "sensors.csv"),
}
"""Rows and default file by option."""
_COLUMN_HELP = """
--csv: one row per control period; columns as in flexneedle.to_dataframe.
With sensors along the needle, the last columns are tip_sd_x_mm, tip_sd_y_mm,
tip_sd_z_mm (sd of the estimated tip), and for each sensor NAME.nis (normalised
square of the innovation, 1 on average) and NAME.verdict.
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
--sensors: one row per reading of the sensors along the needle.
  time_s, period, sensor          time of measurement, control period of
                                  arrival, name of the sensor
  verdict, status                 ok, excluded with its sensor, or the reason
                                  for the rejection; ok, or why the sensor has
                                  no value
  rows                            what it measured, rows of numbers as
                                  flexneedle.devices.Reading
  unit                            unit of rows: 1/mm, mm, px; empty for a kind
                                  without one
Unknown values are empty. A tracker without frames has no sensor columns. A dry
run adds a last column dry_run, an insertion disturbed on the page (serve) a
column disturbed.

"""


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "export",
        "export the control periods or the readings of a run",
        export,
        "flexneedle export runs/mine --csv",
        "flexneedle export runs/mine --readings - | head",
        notes=_COLUMN_HELP,
    )
    parser.add_argument("run", metavar="RUN", type=expand_home, help="folder of the run")
    what = parser.add_mutually_exclusive_group()
    for option, (rows, default) in _TABLES.items():
        what.add_argument(
            f"--{option}",
            nargs="?",
            const="",
            metavar="FILE",
            help=f"export {rows} as CSV, units in the header; {_STDOUT}: stdout (default: RUN/{default})",
        )


def export(args: argparse.Namespace) -> int:
    """Write the CSV file."""
    from flexneedle.record.export import write_csv, write_readings, write_sensor_readings
    from flexneedle.record.loading import load_insertion

    writers = {"csv": write_csv, "readings": write_readings, "sensors": write_sensor_readings}
    chosen = next((option for option in _TABLES if getattr(args, option) is not None), None)
    if chosen is None:
        raise InputError("--csv, --readings or --sensors: one must be given")
    write, name, (_, default) = writers[chosen], getattr(args, chosen), _TABLES[chosen]
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
