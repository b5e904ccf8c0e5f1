"""`flexneedle calibrate`: a scenario fitted to the insertions of a session."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import print_json, print_table
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import make_number_type
from flexneedle.errors import InputError

if TYPE_CHECKING:
    from flexneedle.lab.calibration.design import Proposal


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
    from flexneedle.lab.calibration.calibration import calibrate, make_problem
    from flexneedle.lab.calibration.files import read_record, write_calibration
    from flexneedle.lab.calibration.parameters import find_parameter
    from flexneedle.lab.calibration.session import load_session
    from flexneedle.scenario.files import load_scenario

    session = load_session(args.session)
    chosen = session if args.name is None else session.of(args.name)
    if args.profile is not None:
        find_parameter(make_problem(load_scenario(args.scenario), chosen, args.fit).parameters, args.profile)
    _check_out(args.out)
    found = calibrate(args.scenario, chosen, args.fit)
    write_calibration(found, args.out, str(args.scenario))
    if not args.json:
        print_table("", ("parameter", "value", "95 %"), found.table())
        position, slope = found.final.noise.sd[-2:].tolist()
        print(f"Errors of readings: {position:.2g} mm, {1e3 * slope:.2g} mrad")
        if rows := found.by_readings():
            print_table("95 % by the readings of", ("parameter", "tip", "sensors", "both"), rows)
            for name, (noise, model) in found.final.factors.items():
                print(f"Errors of {name}: {noise:.2g} times its noise, {model:.2g} times its model error")
        print(f"\nScenario: {args.out}")
    profile = None
    if args.profile is not None:
        from flexneedle.lab.calibration.picture import save_profile

        profile = str(save_profile(found, args.profile, args.out))
    if args.json:
        print_json({**(read_record(args.out) or {}), "profile": profile})
    elif profile is not None:
        print(f"Profile: {profile}")
    for line in (*found.notes, *found.problems):
        print_note(line)
    return 1 if found.problems else 0


def _check_out(path: Path) -> None:
    """Create the folder of the scenario. Raises InputError if no file can be written there."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder: --out must be a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}: choose another --out") from None


def _design(args: argparse.Namespace) -> int:
    from flexneedle.lab.calibration.design import propose
    from flexneedle.scenario.files import load_scenario

    if args.session is not None:
        raise InputError(f"{args.session}: --design needs no session: give only the scenario")
    proposals = propose(load_scenario(args.scenario), args.fit, args.design)
    if args.json:
        print_json({"insertions": [_to_values(each) for each in proposals]})
        return 0
    print(f"Insertions to {proposals[0].depth:.0f} mm, each with the intervals of 95 % after it")
    for number, each in enumerate(proposals, 1):
        moves = [f"at {depth:.0f} mm guide to {_format_place(place)} mm" for depth, *place in each.moves]
        widths = [f"{parameter.label} {parameter.format_width(width)}" for parameter, width in each.widths]
        print(f"\nInsertion {number}", *(moves or ["guide at rest"]), *widths, sep="\n  ")
    return 0


def _format_place(place: list[float]) -> str:
    text = ", ".join(f"{value + 0.0:+.1f}" for value in place)
    return text if len(place) == 1 else f"({text})"


def _to_values(proposal: Proposal) -> dict[str, Any]:
    """Return a proposal as plain values; the interval of a positive quantity by its factor to either side."""
    return {
        "depth_mm": proposal.depth,
        "guide": [{"depth_mm": depth, "position_mm": place} for depth, *place in proposal.moves],
        "intervals": {
            each.label: {"factor": math.exp(width)} if each.log else {"half_width": width, "unit": each.unit}
            for each, width in proposal.widths
        },
    }
