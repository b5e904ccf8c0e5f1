"""`flexneedle image`: scenarios by an image; the option `--image` of other commands; `export --slicer`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command, add_group
from flexneedle.cli.common import add_seed, load_named
from flexneedle.cli.export import export
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import make_number_type
from flexneedle.errors import InputError

if TYPE_CHECKING:
    from flexneedle.lab.images.case_import import ImportedCase
    from flexneedle.scenario.model import Scenario

_DEFAULT = "phantom"
_edge = make_number_type(float, 0.3, 10.0)


def add_parser(commands: Commands) -> None:
    """Add the command, `--image` to `plan`, `insert` and `serve`, and `--slicer` to `export`."""
    add_group(
        commands,
        "image",
        "check a case by an image, print its scenario, or write an example",
        (_add_check, _add_show, _add_example),
        "flexneedle image example abdomen",
        "flexneedle image check abdomen/case.toml",
    )
    for name in ("plan", "insert", "serve"):
        parser = commands.choices[name]
        parser.set_defaults(load=_load)
        parser.add_argument(
            "--image",
            type=expand_home,
            metavar="CASE",
            help="path of a case file, instead of SCENARIO: target, entry, layers and zones by a label map and "
            "markups of 3D Slicer",
        )
    parser = commands.choices["export"]
    parser.set_defaults(handler=_export)
    parser.add_argument(
        "--slicer",
        type=expand_home,
        metavar="DIR",
        help="write entry, target, paths, needle and zones of a run or plan, or best entries and zones of a map, for "
        "3D Slicer, in the frame of the image",
    )


def _add_check(commands: Commands) -> None:
    parser = add_command(
        commands,
        "check",
        "check a case: print what is imported, and what is outside of the model's assumptions",
        _check,
        "flexneedle image check case.toml",
        "flexneedle image check abdomen/case.toml",
    )
    _add_case(parser)


def _add_show(commands: Commands) -> None:
    parser = add_command(
        commands,
        "show",
        "print the scenario of a case, as TOML",
        _show,
        "flexneedle image show case.toml > mine.toml",
        "flexneedle image show abdomen/case.toml | less",
    )
    _add_case(parser)


def _add_case(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE", type=expand_home, help="path of a case file")


def _add_example(commands: Commands) -> None:
    parser = add_command(
        commands,
        "example",
        "write label map, markups and case file of a synthetic abdomen",
        _example,
        "flexneedle image example abdomen",
        "flexneedle image example abdomen --seed 3 --spacing 0.8 0.8 5",
    )
    parser.add_argument("folder", metavar="DIR", type=expand_home, help="folder of the files")
    add_seed(parser, "seed of the anatomy")
    parser.add_argument(
        "--spacing",
        nargs=3,
        type=_edge,
        default=(1.0, 1.0, 1.0),
        metavar=("X", "Y", "Z"),
        help="size of a voxel in mm (default: 1 1 1)",
    )


def _load(args: argparse.Namespace) -> Scenario:
    """Return the scenario of `--image`, after printing its lines, or of SCENARIO."""
    if args.image is None:
        return load_named(args)
    if args.scenario != _DEFAULT:
        raise InputError(f"{args.scenario}: not with --image: write it in {args.image.name}, as scenario")
    if getattr(args, "target", None) is not None:
        raise InputError(f"--target: not with --image, whose case {args.image.name} names the target")
    made = _import(args)
    _print(made, to_stderr=getattr(args, "json", True))  # serve prints its address alone
    return made.scenario


def _import(args: argparse.Namespace) -> ImportedCase:
    from flexneedle.lab.images.case_import import import_case

    return import_case(getattr(args, "case", None) or args.image)


def _print(made: ImportedCase, *, to_stderr: bool = False) -> None:
    doubts = ["outside of the model's assumptions:", *(f"  {line}" for line in made.doubts)]
    print("\n".join([*made.lines, *doubts]), file=sys.stderr if to_stderr else sys.stdout, flush=True)


def _check(args: argparse.Namespace) -> int:
    _print(_import(args))
    return 0


def _show(args: argparse.Namespace) -> int:
    from flexneedle.scenario.files import dump_scenario

    print(dump_scenario(_import(args).scenario), end="")
    return 0


def _example(args: argparse.Namespace) -> int:
    from flexneedle.lab.images.example import write_example

    for path in write_example(args.folder, args.seed, tuple(args.spacing)):
        print(path)
    return 0


def _export(args: argparse.Namespace) -> int:
    """Write files for 3D Slicer, or what else is exported."""
    has_table = any(table is not None for table in (args.csv, args.readings, args.sensors))
    if args.slicer is None and not has_table:
        raise InputError("--csv, --readings, --sensors or --slicer: one must be given")
    if args.slicer is None:
        return export(args)
    if has_table:
        raise InputError("--slicer: not with --csv, --readings or --sensors: export one after the other")
    from flexneedle.lab.images.slicer_scene import has_image, write_entries, write_scene
    from flexneedle.record.entries import read_entries
    from flexneedle.record.folder import read_run
    from flexneedle.record.loading import load_insertion
    from flexneedle.simulator.zones import zones_of_record

    run = read_run(args.run)
    if run.kind == "map":
        paths = write_entries(read_entries(args.run, run.scenario), args.slicer)
    elif not run.plans:
        raise InputError(f"{args.run}: the run ended before planning finished")
    elif run.kind == "insertion":
        found, note = load_insertion(args.run)
        if note:
            print_note(note)
        paths = write_scene(found, args.slicer)
    else:
        paths = write_scene(run.plans, args.slicer)
    for path in paths:
        print(path)
    for reason in zones_of_record(run.scenario).lost.values():
        print_note(f"not written: {reason}")
    print(
        f"frame: {'image' if has_image(run.scenario) else 'needle, since the run has no image'} (LPS in files)"
    )
    return 0
