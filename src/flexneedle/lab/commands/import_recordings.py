"""`flexneedle import`: recorded insertions as a session."""

from __future__ import annotations

import argparse

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.progress import print_note


def add_parser(commands: Commands) -> None:
    """Add `import` to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "import",
        "read recorded insertions into a session",
        _import,
        "flexneedle import recordings/*.csv --map lab.toml --out session",
        "flexneedle import runs/* --out session",
        about="Read recorded insertions, draw them, and write a session: CSV and other text, Parquet, MATLAB, MCAP and "
        "rosbag2 files with a map of their columns, and run folders of flexneedle insert without one.",
    )
    parser.add_argument(
        "files", metavar="FILE", nargs="+", type=expand_home, help="recordings or run folders"
    )
    parser.add_argument(
        "--map",
        metavar="MAP",
        type=expand_home,
        help="TOML file that names columns, units and axes of the recordings",
    )
    parser.add_argument("--out", metavar="DIR", type=expand_home, required=True, help="folder of the session")


def _import(args: argparse.Namespace) -> int:
    from flexneedle.lab.calibration.importing.importer import import_recordings
    from flexneedle.lab.calibration.importing.map_file import load_map
    from flexneedle.lab.calibration.importing.picture import draw_session, save_picture

    imported = import_recordings(args.files, None if args.map is None else load_map(args.map))
    figure = draw_session(imported.session)
    imported.session.save(args.out)
    save_picture(figure, args.out)
    for line in imported.understood:
        print(line)
    for line in imported.suspected:
        print_note(line)
    print(f"\nSession: {args.out}")
    return 0
