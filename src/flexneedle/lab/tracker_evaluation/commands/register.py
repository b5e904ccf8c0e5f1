"""`flexneedle em register`: the rigid transform from the tracker's frame to the stage's."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json, print_table
from flexneedle.cli.progress import print_line
from flexneedle.cli.values import finite
from flexneedle.lab.tracker_evaluation.commands.arguments import add_columns

if TYPE_CHECKING:
    from flexneedle.lab.tracker_evaluation.register import RegistrationResult


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "register",
        "register the tracker's frame to the stage's from pairs of points",
        _register,
        "flexneedle em register pairs.csv --target 40 5 0",
        "flexneedle em register table.csv --sensor ref1 --environment ideal --out rig.toml",
        about="Fit the rigid transform from the tracker's to the stage's frame to pairs of points, and estimate its "
        "errors. Writes a table for a scenario and a figure (docs/tracking/register.md).",
    )
    parser.add_argument(
        "data",
        type=expand_home,
        metavar="PAIRS",
        help="CSV or Parquet with true_x_mm, …, x_mm, …; rows with the same point_id are averaged",
    )
    parser.add_argument("--sensor", metavar="NAME", help="sensor to use, if the table has several")
    parser.add_argument("--environment", metavar="NAME", help="environment to use, if the table has several")
    parser.add_argument(
        "--target",
        nargs=3,
        type=finite,
        action="append",
        default=[],
        metavar=("X", "Y", "Z"),
        help="point in the stage's frame (mm) for the expected error; repeatable (default: centroid of the "
        "points)",
    )
    add_columns(parser)
    parser.add_argument(
        "--unit", choices=("mm", "m"), default="mm", help="unit of all coordinates (default: mm)"
    )
    parser.add_argument(
        "--out",
        type=expand_home,
        default=Path("registration.toml"),
        metavar="FILE",
        help="new file; its figure is written to the same folder (default: registration.toml)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def _register(args: argparse.Namespace) -> int:
    from flexneedle.lab.tracker_evaluation.register import read_pairs, register, write_registration

    pairs = read_pairs(args.data, args.columns, args.sensor, args.environment, args.unit)
    registered = register(pairs, [tuple(target) for target in args.target])
    write_registration(registered, args.out)
    if args.json:
        print_json({**registered.values(), "file": str(args.out)})
    else:
        _table(registered, args.out)
    return 0


def _table(registered: RegistrationResult, path: Path) -> None:
    values = registered.values()
    rows = [
        ("points", str(values["points"])),
        ("  readings, missing", f"{values['samples']}, {values['missing']}"),
        ("residual (FRE), RMS", f"{values['fre_mm']:.3f} mm"),
        ("  largest", f"{values['max_residual_mm']:.3f} mm, point {values['worst_point']}"),
        ("  leave-one-out, RMS", _left_out(values["left_out_rms_mm"])),
        ("error of a fiducial (FLE), RMS", f"{values['fle_mm']:.3f} mm"),
    ]
    for target in values["tre"]:
        x, y, z = target["target_mm"]
        rows.append((f"expected error (TRE) at {x:.4g}, {y:.4g}, {z:.4g}", f"{target['tre_mm']:.3f} mm"))
    w, i, j, k = values["rotation"]
    rows.append(("rotation w, x, y, z", f"{w:.6f}, {i:.6f}, {j:.6f}, {k:.6f}"))
    rows.append(("translation", ", ".join(f"{value:.3f}" for value in values["translation_mm"]) + " mm"))
    print_table("Tracker registered to stage", ("", ""), rows)
    for note in registered.notes:
        print_line(f"note: {note}")
    print(f"Record and figures: {path}")


def _left_out(error: float | None) -> str:
    """Return the leave-one-out error as text, or what it needs."""
    return (
        f"{error:.3f} mm" if error is not None else "unknown: needs four points, no three of them on a line"
    )
