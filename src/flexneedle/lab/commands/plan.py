"""Option of `flexneedle plan --entries` for 3D Slicer."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands
from flexneedle.cli.plan import run_plan
from flexneedle.errors import InputError

if TYPE_CHECKING:
    from flexneedle.planning.entry_map import EntryMap


def add_options(commands: Commands) -> None:
    """Add the option to the command `plan`."""
    parser = commands.choices["plan"]
    parser.set_defaults(handler=_plan, write_entries=_write)
    parser.add_argument(
        "--slicer",
        type=expand_home,
        metavar="FILE",
        help="with --entries: write the best entries as a markup of 3D Slicer (.mrk.json), in the frame of the image",
    )


def _plan(args: argparse.Namespace) -> int:
    if args.slicer is not None and not args.entries:
        raise InputError("--slicer: needs --entries")
    return run_plan(args)


def _write(args: argparse.Namespace, found: EntryMap) -> None:
    if args.slicer is None:
        return
    from flexneedle.lab.images.entry_markup import entry_markup
    from flexneedle.lab.images.markups import write_markups

    write_markups([entry_markup(found)], args.slicer)
