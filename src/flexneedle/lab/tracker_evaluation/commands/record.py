"""`flexneedle em record`: record a tracker at the points of a grid."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.progress import print_line
from flexneedle.cli.values import make_number_type

if TYPE_CHECKING:
    from flexneedle.lab.tracker_evaluation.recording.grid import GridStop, StageGrid
    from flexneedle.lab.tracker_evaluation.recording.grid_recording import StageOperator


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "record",
        "record a tracker at the points of a grid; writes a table for evaluate",
        _record,
        "flexneedle em record --tracker aurora:/dev/ttyUSB0 --grid cube --out ideal.csv",
        "flexneedle em record --tracker aurora:/dev/ttyUSB0 --grid mine.toml --out noisy.csv --dwell 5",
        about="Record the tracker at each point of a grid, after a prompt to move the stage there. To "
        "resume after an interruption, repeat the command with the same --out.",
    )
    parser.add_argument(
        "--tracker", required=True, metavar="SPEC", help="tracker, such as aurora:/dev/ttyUSB0"
    )
    parser.add_argument(
        "--grid",
        required=True,
        metavar="GRID",
        help="TOML file or name of the grid (example: cube)",
    )
    parser.add_argument(
        "--out", required=True, type=expand_home, metavar="FILE", help="CSV table to write or resume"
    )
    parser.add_argument(
        "--dwell",
        type=make_number_type(float, 0.0),
        metavar="S",
        help="time for a motorised stage to reach each point (default: prompt for Enter)",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="record points even if sensor and stage moved by different distances (by more than 5 mm and 20 %%)",
    )


def _record(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.clock import WallClock
    from flexneedle.lab.tracker_evaluation.recording.grid import read_grid
    from flexneedle.lab.tracker_evaluation.recording.grid_recording import open_session, record_grid
    from flexneedle.lab.tracker_evaluation.recording.trackers import open_tracker

    grid, clock = read_grid(args.grid), WallClock()
    with open_session(args.out, grid) as session:
        if session.remaining:
            if session.done:
                print_line(f"{args.out}: resuming after {session.done} recorded points")
            with open_tracker(args.tracker, clock) as tracker:
                record_grid(
                    session, tracker, clock, grid, _operator(grid, args.dwell, args.force, clock.wait)
                )
        else:
            print_line(f"{args.out}: complete, {session.done} points")
    print(args.out)
    return 0


def _operator(
    grid: StageGrid, dwell: float | None, force: bool, wait: Callable[[float], None]
) -> StageOperator:
    """Return the operator: a person who presses Enter, or a wait. Mismatches are confirmed only at a terminal."""
    from flexneedle.lab.tracker_evaluation.recording.grid_recording import StageOperator

    def announce(stop: GridStop) -> None:
        print_line(f"{_progress(grid, stop)}: {_target(stop)}")
        wait(dwell or 0.0)

    motorised = dwell is not None
    operator = StageOperator(
        announce if motorised else lambda stop: _ask(grid, stop), print_line, retries=not motorised
    )
    if force:
        return replace(operator, accepts=_force)
    return replace(operator, accepts=_confirm) if not motorised and sys.stdin.isatty() else operator


def _progress(grid: StageGrid, stop: GridStop) -> str:
    return f"point {stop.point_id} of {len(grid.points)}, repeat {stop.repeat} of {grid.file.repeats}"


def _target(stop: GridStop) -> str:
    x, y, z = stop.position
    return (
        f"stage at {x:g}, {y:g}, {z:g} mm"  # read by scripts that move a stage, see docs/tracking/aurora.md
    )


def _ask(grid: StageGrid, stop: GridStop) -> None:
    _answer(f"{_progress(grid, stop)}: press Enter with the {_target(stop)}:")


def _confirm(mismatch: str) -> bool:
    print_line(mismatch)
    return _answer("press Enter to measure this point again, k to keep it:") == "k"


def _force(mismatch: str) -> bool:
    print_line(f"{mismatch}; recorded (--force)")
    return True


def _answer(question: str) -> str:
    """Return the line typed as the answer, and leave the terminal at the start of a line. Raises RunError."""
    from flexneedle.errors import RunError

    echoes = sys.stdin.isatty()
    print(question, end=" " if echoes else "\n", file=sys.stderr, flush=True)
    line = ""
    try:
        line = sys.stdin.readline()
    finally:
        if echoes and not line.endswith("\n"):
            print(file=sys.stderr)
    if not line:
        raise RunError(
            "end of input on stdin: resume with the same --out, or use --dwell for a motorised stage"
        )
    return line.strip()
