"""Arguments shared by several commands, and output of results on stdout."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import length, seed
from flexneedle.planning import STRATEGIES

if TYPE_CHECKING:
    from flexneedle.control.interface import Controller
    from flexneedle.record.folder import Folder
    from flexneedle.results import Plan
    from flexneedle.scenario.model import Scenario
    from flexneedle.types import Floats

_TABLE_WIDTH = 200  # characters: a line that is wrapped in a table would split numbers


class _Target(argparse.Action):
    """Two or three numbers, kept as x, y, z; z is 0 unless it is given."""

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        _option: str | None = None,
    ) -> None:
        """Keep the target. Raises ArgumentError for anything but two or three numbers."""
        try:
            given = [float(value) for value in values]
        except ValueError:
            given = []
        if len(given) not in (2, 3):
            rule = "must be two or three numbers in mm, X Y and in space Z, with spaces between and decimal points"
            remedy = "; put SCENARIO before --target" if not values[-1].lstrip("+-.")[:1].isdigit() else ""
            raise argparse.ArgumentError(self, f"{' '.join(values)}: {rule}{remedy}")
        setattr(namespace, self.dest, (*given, 0.0)[:3])


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments common to `plan` and `insert`."""
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        nargs="?",
        default="phantom",
        help="preset name, wide:NUMBER, world:NUMBER or path of a scenario (default: phantom)",
    )
    parser.add_argument(
        "--target",
        nargs="+",
        action=_Target,
        metavar=("X Y", "Z"),
        help="target in mm: depth X, lateral offset Y, in space also Z (default: scenario)",
    )
    parser.set_defaults(load=load_named, image=None)
    add_seed(parser, "random seed")
    parser.add_argument(
        "--out",
        type=expand_home,
        metavar="DIR",
        help="folder of the run (default: runs/<date>-<scenario>-<seed>)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    add_width(parser)


def add_width(parser: argparse.ArgumentParser) -> None:
    """Add the width of the figures; `main` applies it to every command that has it."""
    parser.add_argument(
        "--width",
        type=length,
        metavar="WIDTH",
        help="width of the figures, such as 88mm for a journal's column; also cm, in (default: 9in)",
    )


def add_seed(parser: argparse.ArgumentParser, meaning: str) -> None:
    """Add the seed (default: 0); meaning: text of its help."""
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help=f"{meaning} (default: 0)")


def add_strategy(parser: argparse.ArgumentParser, meaning: str, *more: str) -> None:
    """Add the planning strategy; meaning: text of its help; more: further choices."""
    parser.add_argument(
        "--strategy",
        choices=(*STRATEGIES, *more),
        default=STRATEGIES[0],
        help=f"{meaning} (default: {STRATEGIES[0]})",
    )


def load_named(args: argparse.Namespace) -> Scenario:
    """Return the scenario of a name or path. An option may set another function as the default of `load`."""
    from flexneedle.scenario.files import load_scenario

    return load_scenario(args.scenario)


def choose_scenario(args: argparse.Namespace, *own: Controller) -> Scenario:
    """Return the scenario with the requested target and all controller settings.

    Raises ScenarioError. Warns, as `scenario check`, of zones whose place or image is in doubt.
    """
    from flexneedle.control.controllers import with_controller_defaults
    from flexneedle.errors import ScenarioWarning
    from flexneedle.scenario.plausible import find_unplaced
    from flexneedle.simulator.zone_doubts import find_zone_doubts

    source = args.image or args.scenario
    scenario = with_controller_defaults(args.load(args), *own, source=source)
    scenario = scenario if args.target is None else with_target(scenario, args.target)
    shown = () if args.image else find_zone_doubts(scenario)  # --image has printed them
    until = " until a registration comes" if getattr(args, "igtl_target", False) else ""
    for line in (*(f"{line}{until}" for line in find_unplaced(scenario)), *shown):
        warnings.warn(f"{source}: {line}", ScenarioWarning, stacklevel=2)
    return scenario


def with_target(scenario: Scenario, target: Sequence[float]) -> Scenario:
    """Return the scenario with a target x, y, z (mm). Raises ScenarioError for one out of reach."""
    keys = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
    return scenario.with_values(dict(zip(keys, target, strict=True)))


def target_row(scenario: Scenario, target: Sequence[float]) -> tuple[str, str]:
    """Return the row of a table for a target x, y, z (mm), without z in the plane."""
    shown = ", ".join(f"{round(value, 3) + 0.0:g}" for value in target[: 1 + scenario.setup.axes])
    return f"target (depth, lateral offset{'s' if scenario.setup.axes > 1 else ''})", f"{shown} mm"


def entry_rows(scenario: Scenario, plan: Plan) -> list[tuple[str, str]]:
    """Return the rows of a table for the entry that a plan has chosen; none if the scenario fixes it."""
    if plan.scenario is None or not scenario.entry.free:
        return []
    entry, axes = plan.scenario.entry, scenario.setup.axes
    point, slope = (
        (entry.lateral_mm, entry.lateral_z_mm)[:axes],
        (entry.slope_mrad, entry.slope_z_mrad)[:axes],
    )
    return [
        ("chosen entry, lateral", f"{', '.join(f'{value:.2f}' for value in point)} mm"),
        ("  slope of the axis", f"{', '.join(f'{value:.1f}' for value in slope)} mrad"),
    ]


def clearance_rows(
    scenario: Scenario, title: str, clearance: float, shapes: Iterable[Floats]
) -> dict[str, str]:
    """Return the row of a table for the least clearance (mm) of shapes (n, ≥ 3) of the needle.

    There is none without zones in reach.
    """
    import numpy as np

    from flexneedle.simulator.zones import zones_of

    if not scenario.zone:
        return {}
    zones = zones_of(scenario)
    if len(zones.out_of_reach) == len(zones.names):
        return {}
    near = zones.closest(np.stack(list(shapes)), clearance)
    if near is None:
        return {title: "not in the tissue"}
    return {title: f"{near.clearance:.3f} mm to {near.zone} (margin {near.margin:g} mm)"}


def out_of_reach_rows(scenario: Scenario) -> dict[str, str]:
    """Return a row of a table for each zone that the needle cannot reach."""
    from flexneedle.simulator.zones import zones_of

    return {f"zone {name}": "out of the needle's reach" for name in zones_of(scenario).out_of_reach}


def compile_first(*axes: int, phantoms: bool = True) -> None:
    """Compile the kernels for values of `setup.axes`, with a progress line if they are not in the cache.

    phantoms: include the virtual phantoms, which a plan without zones does not need.
    """
    from flexneedle.cli.progress import Progress
    from flexneedle.phantom.kernels import compile_kernels, find_uncompiled

    with Progress() as progress:
        if lacking := find_uncompiled(*axes, phantoms=phantoms):
            about = f"first run only, about {sum(lacking.values()):.0f} s"
            progress.begin(f"Compiling kernels for {' and '.join(lacking)} ({about})")
        for each in axes:
            compile_kernels(each, phantoms=phantoms)


def run_name(args: argparse.Namespace) -> str:
    """Return the scenario name used in the name of the run folder."""
    return Path(args.image or args.scenario).stem


def print_json(values: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout; NaN becomes null."""
    from flexneedle.record.plain import to_text

    print(to_text(values), end="")


def print_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table on stdout; its first column has names, and a name that begins with a space is of the row above."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False)
    console.width = max(console.width, _TABLE_WIDTH)
    table = Table(box=box.SIMPLE, show_header=any(heads), show_edge=False)
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        style = "dim" if row[0].startswith(" ") else ""
        table.add_row(*(Text(cell, style=style) for cell in row))
    console.print(Text(title, style="bold"), end="\n\n")
    console.print(table)
    console.print()


@contextmanager
def print_problems(folder: Folder) -> Iterator[None]:
    """Print a line on stderr at the end for each file not written and each figure not drawn.

    After an error or an interrupt, also print the folder of the record, since no table names it then.
    """
    try:
        yield
    except BaseException:
        print_note(f"incomplete record: {folder.path}")
        raise
    finally:
        for line in dict.fromkeys([*folder.problems, *folder.undrawn]):
            print_note(line)
