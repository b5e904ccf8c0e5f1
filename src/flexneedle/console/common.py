"""Arguments that several commands share, and how results reach stdout."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexneedle.control.interface import Method
    from flexneedle.scenario.model import Scenario


class HelpFormatter(argparse.HelpFormatter):
    """Wraps a text of one line, and keeps the lines of one that has several, such as `examples`."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" not in text:
            return super()._fill_text(text, width, indent)
        return "".join(indent + line for line in text.strip("\n").splitlines(keepends=True))


def examples(*lines: str) -> str:
    """Return the end of a command's help: command lines that can be pasted."""
    return "\n".join(["examples:", *(f"  {line}" for line in lines)])


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what `plan` and `insert` have in common."""
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        nargs="?",
        default="phantom",
        help="preset name, world:NUMBER or path (default: phantom)",
    )
    parser.add_argument(
        "--target",
        nargs=2,
        type=float,
        metavar=("X", "Y"),
        help="depth and lateral offset of the target in mm (default: those of the scenario)",
    )
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="same seed, same result (default: 0)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the run (default: runs/<date>-<scenario>-<seed>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def seed(text: str) -> int:
    """Return the seed of an argument. Raises what argparse prints."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value}: must be at least 0")
    return value


def chosen_scenario(args: argparse.Namespace, *own: Method) -> Scenario:
    """Return the scenario with the target that was asked for and all settings of controllers. Raises ScenarioError."""
    from flexneedle.control.methods import used
    from flexneedle.scenario.files import load_scenario

    scenario = used(load_scenario(args.scenario), *own, source=args.scenario)
    if args.target is None:
        return scenario
    depth, lateral = args.target
    return scenario.with_values({"target.depth_mm": depth, "target.lateral_mm": lateral})


def compile_first() -> None:
    """Compile the kernels; the first time takes a while, which is announced."""
    from flexneedle.console.progress import Progress
    from flexneedle.rig.kernels import all_compiled, compile_kernels

    with Progress() as progress:
        if not all_compiled():
            progress.begin("Compiling kernels (first run only)")
        compile_kernels()


def run_name(args: argparse.Namespace) -> str:
    """Return the name of the scenario in the name of a folder."""
    return Path(args.scenario).stem


def print_json(values: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout; NaN becomes null."""
    from flexneedle.trace.plain import to_text

    print(to_text(values), end="")


def print_table(title: str, rows: Iterable[Sequence[str]], folder: Path, heads: Sequence[str] = ()) -> None:
    """Print a short table on stdout, and below it the folder of the record; heads name the columns of values."""
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


def described(text: str, *lines: str) -> dict[str, Any]:
    """Return what argparse needs for a command's description and the examples at the end of its help."""
    return {"description": text, "epilog": examples(*lines), "formatter_class": HelpFormatter}
