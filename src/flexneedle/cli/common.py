"""Arguments shared by several commands, and output of results on stdout."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.cli.values import seed
from flexneedle.errors import InputError, RunError

if TYPE_CHECKING:
    from flexneedle.control.interface import Controller
    from flexneedle.record.folder import Folder
    from flexneedle.results import Plan
    from flexneedle.scenario.model import Scenario

SWITCHED_ON = (
    "The motors of all axes are switched on first. A motor that rests away from its commanded position is switched "
    "off and on again at its present position: support a vertical axis."
)
"""Notice before any motion of a rig."""
ARMS = f"{SWITCHED_ON} Ctrl-C stops."
"""Printed before any motion of a rig."""
STILL_IN = "the needle stays in place: withdraw it with flexneedle rig retract {rig}"
"""Notice of a needle that is left in; rig: as the user gave it."""
STRATEGIES = ("manipulation", "steering")
"""Strategies of planning, the default first."""


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
            rule = "must be two or three numbers (depth, y and, in space, z); put SCENARIO before --target"
            raise argparse.ArgumentError(self, f"{' '.join(values)}: {rule}")
        setattr(namespace, self.dest, (*given, 0.0)[:3])


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments common to `plan` and `insert`."""
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        nargs="?",
        default="phantom",
        help="preset name, world:NUMBER or path of a scenario (default: phantom)",
    )
    parser.add_argument(
        "--target",
        nargs="+",
        action=_Target,
        metavar=("X Y", "Z"),
        help="depth and lateral offset of the target in mm, in space both offsets (default: scenario)",
    )
    add_seed(parser, "random seed")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the run (default: runs/<date>-<scenario>-<seed>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


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


def choose_scenario(args: argparse.Namespace, *own: Controller) -> Scenario:
    """Return the scenario with the requested target and all controller settings. Raises ScenarioError."""
    from flexneedle.control.controllers import with_controller_defaults
    from flexneedle.scenario.files import load_scenario

    scenario = with_controller_defaults(load_scenario(args.scenario), *own, source=args.scenario)
    return scenario if args.target is None else with_target(scenario, args.target)


def with_target(scenario: Scenario, target: Sequence[float]) -> Scenario:
    """Return the scenario with a target x, y, z (mm). Raises ScenarioError for one out of reach."""
    keys = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
    return scenario.with_values(dict(zip(keys, target, strict=True)))


def target_row(scenario: Scenario, target: Sequence[float]) -> tuple[str, str]:
    """Return the row of a table for a target x, y, z (mm), without z in the plane."""
    shown = ", ".join(f"{value:g}" for value in target[: 1 + scenario.setup.axes])
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


def compile_first(*axes: int) -> None:
    """Compile the kernels for values of `setup.axes`, with a progress line if they are not in the cache."""
    from flexneedle.cli.progress import Progress
    from flexneedle.phantom.kernels import all_compiled, compile_kernels

    with Progress() as progress:
        if not all(map(all_compiled, axes)):
            progress.begin("Compiling kernels (first run only)")
        for each in axes:
            compile_kernels(each)


def run_name(args: argparse.Namespace) -> str:
    """Return the scenario name used in the name of the run folder."""
    return Path(args.scenario).stem


def print_json(values: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout; NaN becomes null."""
    from flexneedle.record.plain import to_text

    print(to_text(values), end="")


def print_table(title: str, rows: Iterable[Sequence[str]], folder: Path, heads: Sequence[str] = ()) -> None:
    """Print a short table and the folder of the record on stdout; heads: names of the value columns."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False)
    table = Table(box=box.SIMPLE, show_header=bool(heads), show_edge=False)
    for number, head in enumerate(("", *(heads or ("",)))):
        table.add_column(head, justify="right" if number else "left", style="" if number else "dim")
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(Text(title, style="bold"), table, sep="\n\n")
    console.print(Text(f"\nRecord and figures: {folder}"))


@contextmanager
def print_problems(folder: Folder) -> Iterator[None]:
    """Print a line on stderr at the end for each file not written and each figure not drawn.

    After an error or an interrupt, also print the folder of the record, since no table names it then.
    """
    try:
        yield
    except BaseException:
        print(f"flexneedle: incomplete record: {folder.path}", file=sys.stderr)
        raise
    finally:
        for line in dict.fromkeys([*folder.problems, *folder.undrawn]):
            print(f"flexneedle: {line}", file=sys.stderr)


def require_terminal() -> None:
    """Raise InputError if there is no terminal on which motions could be confirmed."""
    if not sys.stdin.isatty():
        raise InputError("no terminal to confirm the motion: use --yes to move without asking")


def confirm_motions(lines: Iterable[str], question: str) -> None:
    """Print the motions, and ask on stderr; question "": do not ask.

    Raises RunError for any answer but yes, InputError without a terminal.
    """
    print("\n".join(lines), file=sys.stderr)
    if not question:
        return
    require_terminal()
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise RunError("not confirmed: nothing was moved")
