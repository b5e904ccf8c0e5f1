"""`flexneedle em watch`: live readings of a tracker, and whether to trust them."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.console.common import described
from flexneedle.em.commands.arguments import positive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.table import Table

    from flexneedle.em.recording.watch import View
    from flexneedle.types import Frame, SensorReading


_LINE_EVERY_S = 1.0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = subparsers.add_parser(
        "watch",
        help="show live values and verdicts of a tracker",
        **described(
            "Show a live table in a terminal, elsewhere a line a second and at each change of the verdict, until "
            "Ctrl-C or the end of a replay.",
            "flexneedle em watch --tracker aurora:/dev/ttyUSB0 --record frames.csv",
            "flexneedle em watch --tracker replay:frames.csv@4 --json",
        ),
    )
    parser.add_argument(
        "--tracker", required=True, metavar="SPEC", help="such as aurora:/dev/ttyUSB0 or replay:FILE@2"
    )
    parser.add_argument("--record", type=Path, metavar="FILE", help="keep all frames in a new CSV")
    parser.add_argument(
        "--seconds", type=positive, default=inf, metavar="S", help="stop after S seconds (default: never)"
    )
    parser.add_argument(
        "--references",
        type=int,
        choices=range(7),
        metavar="N",
        help="reference sensors without which the field is not known (default: those of the tracker, 3 at most)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a frame, a line each")
    parser.set_defaults(handler=_watch)


def _watch(args: argparse.Namespace) -> int:
    from flexneedle.em.recording.trackers import clock_for, open_tracker
    from flexneedle.em.recording.watch import field_judge, watch

    clock = clock_for(args.tracker)
    try:
        with ExitStack() as stack:
            tracker = stack.enter_context(open_tracker(args.tracker, clock))
            judge = field_judge(args.references)
            watch(tracker, clock, _shower(stack, args.json), args.seconds, judge, args.record)
    except KeyboardInterrupt:
        print(file=sys.stderr)  # the usual end of a watch
    return 0


def _shower(stack: ExitStack, as_json: bool) -> Callable[[View], None]:
    """Return what shows a view: JSON, a live table, or a line now and then."""
    if as_json:
        return _print_json
    if sys.stdout.isatty():
        return _live_table(stack)
    lines = _Lines()
    stack.callback(lines.finish)
    return lines.show


def _print_json(view: View) -> None:
    values: dict[str, Any] = {"time_s": view.time, "frame_number": None, "status": view.status}
    values |= {"verdict": view.verdict, "sensors": {}}
    if view.frame is not None and view.is_new:
        values |= {"time_s": view.frame.time, "frame_number": view.frame.number}
        values["sensors"] = {name: _values(reading) for name, reading in view.frame.readings.items()}
    print(json.dumps(values, allow_nan=False), flush=True)


def _values(reading: SensorReading) -> dict[str, Any]:
    return {
        "position_mm": reading.position,
        "quaternion": reading.orientation,
        "indicator": reading.indicator,
        "status": reading.status,
    }


class _Lines:
    """Prints a view a second, each at which the verdict changes from good to bad or back, and the last one."""

    def __init__(self) -> None:
        self._due = -inf
        self._last: View | None = None
        self._printed: View | None = None

    def show(self, view: View) -> None:
        """Print a view, if it is due."""
        self._last = view
        if view.time >= self._due or self._changed(view):
            self._due = view.time + _LINE_EVERY_S
            self._print(view)

    def finish(self) -> None:
        """Print the last view, if it was not."""
        if self._last is not None and self._last is not self._printed:
            self._print(self._last)

    def _changed(self, view: View) -> bool:
        from flexneedle.types import VISIBLE

        before = self._printed
        return before is not None and (view.verdict == VISIBLE) != (before.verdict == VISIBLE)

    def _print(self, view: View) -> None:
        self._printed = view
        print(_line(view), flush=True)


def _line(view: View) -> str:
    if view.frame is None or not view.is_new:
        return f"{view.time:8.2f} s  verdict: {view.verdict}"
    time, sensors = view.frame.time, "  ".join(_cells(view.frame))
    return f"{time:8.2f} s  frame {view.frame.number}  {sensors}  verdict: {view.verdict}"


def _cells(frame: Frame) -> Iterator[str]:
    """Position and indicator of the tip, or of the first sensor; of the others the indicator."""
    from flexneedle.rig.tracking.table import TIP

    first = TIP if TIP in frame.readings else next(iter(frame.readings), "")
    for name, reading in frame.readings.items():
        if reading.position is None:
            yield f"{name} {reading.status}"
            continue
        place = " {:.2f} {:.2f} {:.2f} mm".format(*reading.position) if name == first else ""
        yield f"{name}{place}" + ("" if reading.indicator is None else f" I {reading.indicator:.4f}")


def _live_table(stack: ExitStack) -> Callable[[View], None]:
    from rich.live import Live

    live = stack.enter_context(Live(auto_refresh=True, refresh_per_second=10))
    return lambda view: live.update(_table(view))


def _table(view: View) -> Table:
    from rich.table import Table
    from rich.text import Text

    number = "none yet" if view.frame is None else str(view.frame.number)
    table = Table(title=f"{view.time:.1f} s, frame {number}", caption=Text(f"verdict: {view.verdict}"))
    for head in ("sensor", "x mm", "y mm", "z mm", "indicator", "status"):
        table.add_column(head, justify="left" if head in ("sensor", "status") else "right")
    for name, reading in view.frame.readings.items() if view.frame is not None and view.is_new else ():
        place = (
            ("", "", "") if reading.position is None else tuple(f"{part:.2f}" for part in reading.position)
        )
        indicator = "" if reading.indicator is None else f"{reading.indicator:.4f}"
        table.add_row(*map(Text, (name, *place, indicator, reading.status)))
    return table
