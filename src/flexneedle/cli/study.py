"""`flexneedle study`: many insertions, on all cores or on a cluster, into tables."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.console.common import HelpFormatter, compile_first, examples, print_json

if TYPE_CHECKING:
    from flexneedle.console.progress import Progress
    from flexneedle.study.grid import Study
    from flexneedle.study.runner import Advance


_TABLE_WIDTH = 120  # a row stays a row where it is piped to a file
_STAGES = ("Planning", "Inserting")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "study",
        help="carry out many insertions and keep them in tables",
        epilog=examples(
            "flexneedle study phantom --out runs/accuracy",
            "flexneedle study mine.toml --workers 4 --out runs/mine --resume",
        ),
        formatter_class=HelpFormatter,
    )
    parser.add_argument("study", metavar="STUDY", help="name of a shipped study, or path of a TOML file")
    parser.add_argument(
        "--worlds",
        nargs=2,
        type=int,
        metavar=("FROM", "COUNT"),
        help="first number and count of worlds, for a study of worlds (default: those of its file)",
    )
    parser.add_argument(
        "--workers", type=_workers, metavar="N", help="processes on this machine (default: one per core)"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")
    parser.add_argument("--resume", action="store_true", help="resume the study in --out")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the study (default: runs/<date>-study-<name>)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.set_defaults(handler=_study)


def _workers(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) >= 1):
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, at least 1")
    return int(text)


def _study(args: argparse.Namespace) -> int:
    from flexneedle.console.progress import Progress
    from flexneedle.errors import InputError, RunError
    from flexneedle.study.grid import load_study
    from flexneedle.study.pools import check_address
    from flexneedle.study.runner import run_study
    from flexneedle.trace.files import new_folder

    if args.resume and args.out is None:
        raise InputError("--resume needs the folder of the study: give it with --out DIR")
    if args.workers is not None and args.scheduler is not None:
        raise InputError("--workers is for this machine: leave it out with --scheduler")
    if args.scheduler is not None:
        check_address(args.scheduler)
    study = load_study(args.study, None if args.worlds is None else tuple(args.worlds))
    folder = args.out or new_folder("study", study.name)
    compile_first()
    begun = time.monotonic()
    try:
        with Progress() as progress:
            progress.say(f"{study.title}: {len(study)} insertions, in {folder}")
            run_study(
                study,
                folder,
                workers=args.workers,
                scheduler=args.scheduler,
                resume=args.resume,
                on_advance=_StudyProgress(progress).advance,
                on_no_workers=lambda: progress.say(f"{args.scheduler} has no workers yet: waiting for them"),
                command=_command(args, folder),
            )
    except KeyboardInterrupt:
        print(f"flexneedle: interrupted; resume with: {_command(args, folder, '--resume')}", file=sys.stderr)
        return 130
    except RunError as error:
        raise RunError(f"{error}: {_command(args, folder, '--resume')}") from error
    return _report(study, folder, args.json, time.monotonic() - begun)


def _command(args: argparse.Namespace, folder: Path, *more: str) -> str:
    """The command line, as it can be given again."""
    words = ["flexneedle", "study", args.study]
    words += ["--worlds", *map(str, args.worlds)] if args.worlds is not None else []
    words += ["--workers", str(args.workers)] if args.workers is not None else []
    words += ["--scheduler", args.scheduler] if args.scheduler is not None else []
    return shlex.join([*words, "--out", str(folder), *more])


class _StudyProgress:
    """Turns what the runner reports into progress, with rate and time left."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._planning, self._inserting = _Pace(), _Pace()
        self._planned = False  # reported that no plan is missing

    def advance(self, advance: Advance) -> None:
        planning, inserting = _STAGES
        if not self._planned:
            self._planned = advance.plans == advance.all_plans
            left = self._planning.left(advance.plans, advance.all_plans)
            note = f"{advance.plans} of {advance.all_plans} plans{left}"
            total = max(advance.all_plans, 1)
            self._progress.show(planning, total if self._planned else advance.plans, total, note)
        note = f"{advance.insertions} of {advance.all_insertions}"
        note += self._inserting.left(advance.insertions, advance.all_insertions)
        note += f", {advance.unfinished} not done" if advance.unfinished else ""
        self._progress.show(inserting, advance.insertions, advance.all_insertions, note)


class _Pace:
    """How fast a stage goes. It is timed from the first that is in: neither work before nor other stages count."""

    def __init__(self) -> None:
        self._before: int | None = None  # done by an earlier run of the study
        self._first: tuple[float, int] | None = None  # when the first was in, and how many there were then

    def left(self, done: int, total: int) -> str:
        """Return rate and time left as an addition to a note, empty while they are not known."""
        rate = self._rate(time.monotonic(), done)
        return f", {rate:.2g} a second, {_duration((total - done) / rate)} left" if rate else ""

    def _rate(self, now: float, done: int) -> float:
        if self._before is None:
            self._before = done
        if self._first is None and done > self._before:
            self._first = now, done
        begun, first = self._first or (now, done)
        return (done - first) / (now - begun) if now > begun else 0.0


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _report(study: Study, folder: Path, as_json: bool, seconds: float) -> int:
    from flexneedle.scenario.problems import printable
    from flexneedle.study.summary import summarise

    summary = summarise(folder, study)
    summary["time"]["wall_s"] = seconds
    if as_json:
        print_json(summary)
    else:
        _table(summary)
    if "done" in summary["outcomes"]:
        return 0
    if summary["first_failure"] is not None:
        message = printable(summary["first_failure"])
        print(f"flexneedle: no insertion was done; the first ended so: {message}", file=sys.stderr)
    return 1


def _table(summary: Mapping[str, Any]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False)
    console.width = max(console.width, _TABLE_WIDTH)
    table = Table(box=box.SIMPLE, show_edge=False)
    heads = ("", "done", "mean ± sd", "median", "95 %", "max", "flips", "energy", "periods")
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number else "left")
    for name, part in ((_label(group["settings"]), group) for group in summary["groups"]):
        table.add_row(*map(Text, (name, *_cells(part))))
    table.add_row(*map(Text, ("all", *_cells(summary))))
    spent, unconverged = summary["time"], summary["unconverged_periods"]
    console.print(Text(summary["title"], style="bold"), table, sep="\n\n")
    console.print(
        "\nOver the insertions that are done: true error in mm; flips with the plan's; mean tissue energy and most "
        "periods over the plan's."
    )
    if unconverged:
        console.print(f"{unconverged} periods did not converge: see unconverged_periods in the table.")
    console.print(
        f"Work: {spent['plan_s']:.1f} s plan, {spent['control_s']:.1f} s control, {spent['plant_s']:.1f} s plant, "
        f"{spent['rest_s']:.1f} s rest; {spent['wall_s']:.1f} s on the clock"
    )
    console.print(Text(f"Tables: {summary['folder']}"))


def _label(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" if "." in key else str(value) for key, value in settings.items())


def _cells(part: Mapping[str, Any]) -> Sequence[str]:
    error, periods = part["true_error_mm"], part["period_ratio"]
    done = part["outcomes"].get("done", 0)
    return (
        f"{done} of {part['insertions']}",
        f"{_number(error['mean'])} ± {_number(error['sd'])}",
        *(_number(error[name]) for name in ("median", "p95", "max")),
        f"{_number(part['flips'], 1)} ({_number(part['planned_flips'], 1)})",
        _number(part["energy_ratio"], 2),
        _number(periods["max"], 2),
    )


def _number(value: float | None, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
