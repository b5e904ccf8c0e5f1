"""`flexneedle em record`: measure a tracker on a grid, point by point."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.console.common import described
from flexneedle.em.commands.arguments import within

if TYPE_CHECKING:
    from flexneedle.em.recording.grid import Grid, Stop
    from flexneedle.em.recording.record import Guide


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = commands.add_parser(
        "record",
        help="measure a tracker on a grid; writes the table that evaluate reads",
        **described(
            "Ask for the stage to be moved to each point of the grid and record the tracker there. Stopped at any "
            "time, the recording continues at the next point when it is started again with the same --out.",
            "flexneedle em record --tracker aurora:/dev/ttyUSB0 --grid cube --out ideal.csv",
            "flexneedle em record --tracker aurora:/dev/ttyUSB0 --grid mine.toml --out noisy.csv --dwell 5",
        ),
    )
    parser.add_argument("--tracker", required=True, metavar="SPEC", help="such as aurora:/dev/ttyUSB0")
    parser.add_argument(
        "--grid",
        required=True,
        metavar="GRID",
        help="file or name of the grid; cube is shipped as an example",
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="FILE", help="table to write or to continue (CSV)"
    )
    parser.add_argument(
        "--dwell",
        type=within(0),
        metavar="S",
        help="seconds that a stage which moves by itself needs to reach each point (default: ask a person)",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="record also where a sensor did not move as the stage did: by more than 5 mm and 20 %% of the distance",
    )
    parser.set_defaults(handler=_record)


def _record(args: argparse.Namespace) -> int:
    from flexneedle.em.recording.grid import read_grid
    from flexneedle.em.recording.record import open_session, record
    from flexneedle.em.recording.trackers import clock_for, open_tracker

    grid, clock = read_grid(args.grid), clock_for(args.tracker)
    with open_session(args.out, grid) as session:
        if session.left:
            if session.done:
                _print(f"{args.out}: continues after {session.done} recorded points")
            with open_tracker(args.tracker, clock) as tracker:
                record(session, tracker, clock, grid, _guide(grid, args.dwell, args.force, clock.wait))
        else:
            _print(f"{args.out}: is complete: {session.done} points")
    print(args.out)
    return 0


def _guide(grid: Grid, dwell: float | None, force: bool, wait: Callable[[float], None]) -> Guide:
    """Return the guide: a person who presses Enter, or time. Only at a terminal is a person asked what to keep."""
    from flexneedle.em.recording.record import Guide

    def give_time(stop: Stop) -> None:
        _print(_where(grid, stop))
        wait(dwell or 0.0)

    by_itself = dwell is not None
    guide = Guide(give_time if by_itself else lambda stop: _ask(grid, stop), _print, insists=not by_itself)
    if force:
        return replace(guide, keeps=_force)
    return replace(guide, keeps=_keeps) if not by_itself and sys.stdin.isatty() else guide


def _where(grid: Grid, stop: Stop) -> str:
    x, y, z = stop.place
    of = f"point {stop.point_id} of {len(grid.points)}, repeat {stop.repeat} of {grid.file.repeats}"
    return f"{of}: stage at {x:g}, {y:g}, {z:g} mm"


def _ask(grid: Grid, stop: Stop) -> None:
    _answer(f"{_where(grid, stop)}? Enter:")


def _keeps(doubt: str) -> bool:
    _print(doubt)
    return _answer("Enter measures this point again, k keeps it:") == "k"


def _force(doubt: str) -> bool:
    _print(f"{doubt}; recorded (--force)")
    return True


def _answer(question: str) -> str:
    """Return what is typed in a line. Whatever is written next begins a line of its own. Raises RunError."""
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
            "no more input on stdin: continue with the same --out, or use --dwell without a person"
        )
    return line.strip()


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
