"""`flexneedle study`: run many insertions on all cores or on a cluster and write tables."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Mapping, Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import compile_first, print_json, print_table
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import make_number_type

if TYPE_CHECKING:
    from flexneedle.cli.progress import Progress
    from flexneedle.lab.study.findings.findings import Findings
    from flexneedle.lab.study.findings.groups import SettingGroup
    from flexneedle.lab.study.findings.sensors import SensorGroup
    from flexneedle.lab.study.runner import StudyProgress


_STAGES = ("Planning", "Inserting")


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "study",
        "run many insertions and write tables",
        _study,
        "flexneedle study phantom --out runs/accuracy",
        "flexneedle study mine.toml --workers 4 --out runs/mine --resume",
    )
    parser.add_argument("study", metavar="STUDY", help="name of a shipped study, or path to a TOML file")
    parser.add_argument(
        "--worlds",
        nargs=2,
        type=int,
        metavar=("FROM", "COUNT"),
        help="number of the first world and count, for a study of worlds (default: as in the study file)",
    )
    parser.add_argument(
        "--workers",
        type=make_number_type(int, 1),
        metavar="N",
        help="number of local processes (default: one per core)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="run on the Dask cluster at this scheduler address"
    )
    parser.add_argument("--resume", action="store_true", help="resume the study in --out")
    parser.add_argument(
        "--out",
        type=expand_home,
        metavar="DIR",
        help="folder of the study (default: runs/<date>-study-<name>)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def _study(args: argparse.Namespace) -> int:
    from flexneedle.arguments import require_extra
    from flexneedle.cli.progress import Progress
    from flexneedle.errors import InputError, RunError
    from flexneedle.files import create_folder
    from flexneedle.lab.study.grid import load_study
    from flexneedle.lab.study.pools import check_address
    from flexneedle.lab.study.runner import run_study

    if args.scheduler is None:
        require_extra("study", "pyarrow")
    else:
        require_extra("cluster", "pyarrow", "distributed")
    if args.resume and args.out is None:
        raise InputError("--resume needs the folder of the study: add --out DIR")
    if args.workers is not None and args.scheduler is not None:
        raise InputError("--workers sets local processes: remove it, or remove --scheduler")
    if args.scheduler is not None:
        check_address(args.scheduler)
    study = load_study(args.study, None if args.worlds is None else tuple(args.worlds))
    folder = args.out or create_folder("study", study.name)
    compile_first(*study.axes)
    begun = time.monotonic()
    try:
        with Progress() as progress:
            progress.print_line(f"{study.title}: {len(study)} insertions, folder {folder}")
            run_study(
                study,
                folder,
                workers=args.workers,
                scheduler=args.scheduler,
                resume=args.resume,
                on_advance=_StudyProgress(progress).advance,
                on_no_workers=lambda: progress.print_line(f"{args.scheduler}: no workers yet, waiting"),
                command=_command(args, folder),
            )
    except KeyboardInterrupt:
        print_note(f"interrupted; resume with: {_command(args, folder, '--resume')}")
        return 130
    except RunError as error:
        raise RunError(f"{error}: {_command(args, folder, '--resume')}") from error
    return _report(folder, args.json, time.monotonic() - begun)


def _command(args: argparse.Namespace, folder: Path, *options: str) -> str:
    """Return the command line, with the folder and further options."""
    words = ["flexneedle", "study", args.study]
    words += ["--worlds", *map(str, args.worlds)] if args.worlds is not None else []
    words += ["--workers", str(args.workers)] if args.workers is not None else []
    words += ["--scheduler", args.scheduler] if args.scheduler is not None else []
    return shlex.join([*words, "--out", str(folder), *options])


class _StudyProgress:
    """Shows the progress reports of the runner, with rate and remaining time."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._planning, self._inserting = _Pace(), _Pace()
        self._planned = False  # whether completed planning has been shown

    def advance(self, advance: StudyProgress) -> None:
        planning, inserting = _STAGES
        if not self._planned:
            self._planned = advance.plans == advance.all_plans
            left = self._planning.format_remaining(advance.plans, advance.all_plans)
            note = f"{advance.plans} of {advance.all_plans} plans{left}"
            total = max(advance.all_plans, 1)
            self._progress.show(planning, total if self._planned else advance.plans, total, note)
        note = f"{advance.insertions} of {advance.all_insertions}"
        note += self._inserting.format_remaining(advance.insertions, advance.all_insertions)
        note += f", {advance.unfinished} not finished" if advance.unfinished else ""
        self._progress.show(inserting, advance.insertions, advance.all_insertions, note)


class _Pace:
    """Rate of a stage, timed from its first completed item; earlier runs and other stages do not count."""

    def __init__(self) -> None:
        self._before: int | None = None  # completed by an earlier run of the study
        self._first: tuple[float, int] | None = None  # time and count at the first completion

    def format_remaining(self, done: int, total: int) -> str:
        """Return rate and remaining time to append to a note; empty while unknown."""
        rate = self._rate(time.monotonic(), done)
        return f", {rate:.2g}/s, {_duration((total - done) / rate)} left" if rate else ""

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


def _report(folder: Path, as_json: bool, seconds: float) -> int:
    from flexneedle.errors import make_printable
    from flexneedle.lab.study.findings.findings import compute_findings
    from flexneedle.lab.study.findings.reading import read_study_folder
    from flexneedle.lab.study.tables import sum_times

    found = compute_findings(read_study_folder(folder))
    spent = {**sum_times(folder), "wall_s": seconds}
    if as_json:
        print_json({"folder": str(folder), **found.values(), "time": spent})
    else:
        _print_table(found, spent)
    if found.finished:
        return 0
    first = found.endings[0]
    message = make_printable(f"{first.outcome}: {first.reason}".removesuffix(": "))
    print_note(f"no insertion finished; most frequent failure: {message}")
    return 1


def _print_table(found: Findings, spent: Mapping[str, float]) -> None:
    from flexneedle.lab.study.findings.groups import ENTERED_MM

    heads = ("", "finished", "mean ± sd", "median", "95 %", "max", "periods")
    load_heads = ("", "energy (µJ)", "over planned", "over E₁", "stretch", "travel", "rolls")
    varied = [factor.key for factor in found.design.factors if factor.varies]
    pooled = found.whole if len(found.groups) > len(found.whole) else ()
    rows = [(_label(group.levels, varied) or group.name, group) for group in found.groups]
    rows += [(f"{group.name}, all", group) for group in pooled]
    unconverged = sum(group.unconverged_periods for group in found.whole)
    print_table(found.study.title, heads, ((name, *_format_cells(group)) for name, group in rows))
    print("Finished insertions: true error (mm); largest number of periods, relative to the plan.\n")
    if any(group.has_clearances for _, group in rows):
        print_table(
            "Zones",
            ("", "least clearance", "margin entered"),
            ((name, *_format_zones(group)) for name, group in rows),
        )
        print(
            f"All insertions: least clearance of the true needle (mm); insertions with one more than {ENTERED_MM:g} mm "
            "below the least margin.\n"
        )
    if found.sensors:
        print_table(
            "Sensors along the needle",
            ("", "sensor", "insertions", "NIS", "excluded", "depth"),
            (
                _format_sensor(one, _label(one.levels, varied) or found.groups[0].name)
                for one in found.sensors
            ),
        )
        print(
            "All insertions: median of the medians of NIS; insertions in which the sensor is excluded to the end, and "
            "median depth (mm) from which it is.\n"
        )
    print_table("Load on the tissue", load_heads, ((name, *_format_load(group)) for name, group in rows))
    print(
        f"Over finished insertions: {found.energy_means} of peak, mean and end of the tissue energy; means of each "
        "insertion's least stretch, guide travel in the tissue (mm) and rolls (planned)."
    )
    if unconverged:
        print(f"{unconverged} periods did not converge: see column unconverged_periods of runs.parquet.")
    print(
        f"Time, all workers: planning {spent['plan_s']:.1f} s, control {spent['control_s']:.1f} s, "
        f"plant {spent['plant_s']:.1f} s, other {spent['rest_s']:.1f} s; wall-clock time {spent['wall_s']:.1f} s"
    )
    print(f"Tables: {found.study.folder}")


def _format_zones(group: SettingGroup) -> Sequence[str]:
    entered = f"{group.entered} of {group.count}" if group.has_clearances else "–"
    return _number(group.least_clearance_mm), entered


def _format_sensor(one: SensorGroup, name: str) -> Sequence[str]:
    return (
        name,
        one.sensor,
        str(one.count),
        _number(one.median_nis, 2),
        one.verdicts,
        _number(one.excluded_mm, 1),
    )


def _label(levels: Mapping[str, str], varied: Sequence[str]) -> str:
    return ", ".join(f"{key} {levels[key]}" if "." in key else levels[key] for key in varied)


def _format_cells(group: SettingGroup) -> Sequence[str]:
    value = {name: estimate.value for name, estimate in group.estimates.items()}
    return (
        f"{group.finished} of {group.count}",
        f"{_number(value['mean_mm'])} ± {_number(value['sd_mm'])}",
        *map(_number, (value["median_mm"], value["p95_mm"], group.largest_mm)),
        _number(group.largest_period_ratio, 2),
    )


def _format_load(group: SettingGroup) -> Sequence[str]:
    from flexneedle.invasiveness import format_number
    from flexneedle.lab.study.findings.groups import ENERGIES

    value = {name: estimate.value for name, estimate in group.estimates.items()}
    energies = (
        ", ".join(format_number(value[f"{of}_energy_{kind}"]) for of in ENERGIES)
        for kind in ("uj", "ratio", "relative")
    )
    return (
        *energies,
        _number(value["least_stretch"]),
        f"{_number(value['guide_travel_mm'], 1)} ({_number(value['planned_guide_travel_mm'], 1)})",
        f"{_number(value['flips'], 1)} ({_number(value['planned_flips'], 1)})",
    )


def _number(value: float, digits: int = 3) -> str:
    return "–" if isnan(value) else f"{value:.{digits}f}"
