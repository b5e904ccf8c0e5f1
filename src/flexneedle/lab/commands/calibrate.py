"""`flexneedle calibrate`: a scenario fitted to the insertions of a session."""

from __future__ import annotations

import argparse
from pathlib import Path

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json, print_table
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import make_number_type
from flexneedle.errors import InputError


def add_parser(commands: Commands) -> None:
    """Add `calibrate` to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "calibrate",
        "fit a scenario to recorded insertions",
        _calibrate,
        "flexneedle calibrate session gel --out calibrated.toml",
        "flexneedle calibrate session mine.toml --fit stiffness bevel guide yield --profile yield",
        about="Fit a scenario to the insertions of a session. Exit status 1: the fit is not to be trusted, for the "
        "reasons that are printed.",
    )
    parser.add_argument(
        "session",
        metavar="SESSION",
        nargs="?",
        type=expand_home,
        help="folder of the session; not for --design",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="scenario from which the fit starts")
    parser.add_argument(
        "--fit",
        nargs="+",
        metavar="NAME",
        default=["stiffness", "bevel", "guide"],
        help="parameters: stiffness, bevel, guide, clearance, yield, drift (default: the first three)",
    )
    parser.add_argument(
        "--session", metavar="NAME", dest="name", help="use one of the sessions (default: all)"
    )
    parser.add_argument(
        "--profile", metavar="NAME", help="draw the profile likelihood of a parameter, beside the scenario"
    )
    parser.add_argument(
        "--design",
        metavar="N",
        type=make_number_type(int, 1, 20),
        help="propose the N insertions that shrink the intervals most, and end",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=expand_home,
        default=Path("calibrated.toml"),
        help="calibrated scenario (default: calibrated.toml)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def _calibrate(args: argparse.Namespace) -> int:
    if args.design is not None:
        return _design(args)
    if args.session is None:
        raise InputError("SESSION: missing: the folder of flexneedle import, before the scenario")
    from flexneedle.lab.calibration.calibration import calibrate
    from flexneedle.lab.calibration.files import read_record, write_calibration
    from flexneedle.lab.calibration.session import load_session

    session = load_session(args.session)
    found = calibrate(args.scenario, session if args.name is None else session.of(args.name), args.fit)
    write_calibration(found, args.out, str(args.scenario))
    if args.json:
        print_json(read_record(args.out) or {})
    else:
        print_table("", ("parameter", "value", "95 %"), found.table())
        position, slope = found.final.noise.sd[-2:].tolist()
        print(f"Errors of readings: {position:.2g} mm, {1e3 * slope:.2g} mrad")
        print(f"\nScenario: {args.out}")
    if args.profile is not None:
        from flexneedle.lab.calibration.picture import save_profile

        print(f"Profile: {save_profile(found, args.profile, args.out)}")
    for line in (*found.notes, *found.problems):
        print_note(line)
    return 1 if found.problems else 0


def _design(args: argparse.Namespace) -> int:
    from flexneedle.lab.calibration.design import propose
    from flexneedle.scenario.files import load_scenario

    proposals = propose(load_scenario(args.scenario), args.fit, args.design)
    rows = [
        (
            str(k),
            f"{each.depth:.0f} mm",
            "; ".join(f"at {x:.0f} mm to ({y:+.1f}, {z:+.1f}) mm" for x, y, z in each.moves) or "at rest",
            ", ".join(parameter.format_width(width) for parameter, width in each.widths),
        )
        for k, each in enumerate(proposals, 1)
    ]
    print_table("", ("insertion", "depth", "guide (y, z)", "intervals of 95 % after it"), rows)
    return 0
