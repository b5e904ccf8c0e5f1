"""`flexneedle em record`: measure a tracker on a grid, point by point."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from flexneedle.run.em.grid import Grid, Stop
    from flexneedle.run.em.record import Guide

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = subparsers.add_parser(
        "record",
        help="measure a tracker on a grid; writes the table that evaluate reads",
        description="Asks for the stage to be moved to each point of the grid and records the tracker there. "
        "Stopped at any time, it goes on at the next point when started again with the same --out.",
    )
    parser.add_argument("--tracker", required=True, metavar="SPEC", help="such as aurora:/dev/ttyUSB0")
    parser.add_argument(
        "--grid",
        required=True,
        metavar="GRID",
        help="file or name of the grid; cube comes along as an example",
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="FILE", help="table to write or to go on with (CSV)"
    )
    parser.add_argument(
        "--dwell",
        type=float,
        metavar="S",
        help="don't ask: give the stage so many seconds to reach each point by itself",
    )
    parser.set_defaults(handler=_record)


def _record(args: argparse.Namespace) -> int:
    from flexneedle.devices.clock import WallClock
    from flexneedle.run.em.grid import read_grid
    from flexneedle.run.em.record import open_session, record
    from flexneedle.run.em.trackers import open_tracker

    grid, clock = read_grid(args.grid), WallClock()
    with open_session(args.out, grid) as session:
        if session.left:
            if session.done:
                _say(f"{args.out}: goes on after {session.done} recorded points")
            with open_tracker(args.tracker, clock) as tracker:
                record(session, tracker, clock, grid, _guide(grid, args.dwell, clock.wait))
    print(args.out)
    return 0


def _guide(grid: Grid, dwell: float | None, wait: Callable[[float], None]) -> Guide:
    """Return the guide: a person who presses Enter, or time."""
    from flexneedle.run.em.record import Guide

    if dwell is None:
        return Guide(lambda stop: _ask(grid, stop), _say)

    def give_time(stop: Stop) -> None:
        _say(_where(grid, stop))
        wait(dwell)

    return Guide(give_time, _say, insists=False)


def _where(grid: Grid, stop: Stop) -> str:
    x, y, z = stop.place
    of = f"point {stop.point_id} of {len(grid.points)}, repeat {stop.repeat} of {grid.file.repeats}"
    return f"{of}: stage at {x:g}, {y:g}, {z:g} mm"


def _ask(grid: Grid, stop: Stop) -> None:
    from flexneedle.errors import RunError

    print(f"{_where(grid, stop)}? Enter: ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise RunError("no more input on stdin: go on with the same --out, or use --dwell without a person")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
