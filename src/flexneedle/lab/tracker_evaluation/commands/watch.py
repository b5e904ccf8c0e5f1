"""`flexneedle em watch`: live readings of a tracker with the verdict on its field."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack
from math import inf
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.values import positive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from flexneedle.lab.tracker_evaluation.recording.watch import TrackerSnapshot
    from flexneedle.types import Frame, SensorReading


_LINE_EVERY_S = 1.0


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle em`."""
    parser = add_command(
        commands,
        "watch",
        "show live readings and verdicts of a tracker",
        _watch,
        "flexneedle em watch --tracker aurora:/dev/ttyUSB0 --record frames.csv",
        "flexneedle em watch --tracker replay:frames.csv --json",
        about="Print a line each second and at each change of the verdict. Ends with Ctrl-C or the end of a replay.",
    )
    parser.add_argument(
        "--tracker",
        required=True,
        metavar="SPEC",
        help="tracker, such as aurora:/dev/ttyUSB0 or replay:FILE",
    )
    parser.add_argument(
        "--record", type=expand_home, metavar="FILE", help="save all frames to a new CSV file"
    )
    parser.add_argument(
        "--seconds", type=positive, default=inf, metavar="S", help="stop after S seconds (default: never)"
    )
    parser.add_argument(
        "--references",
        type=int,
        choices=range(7),
        metavar="N",
        help="number of reference sensors needed to judge the field (default: all of the tracker, at most 3)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame and line")


def _watch(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.clock import WallClock
    from flexneedle.lab.tracker_evaluation.recording.trackers import open_tracker
    from flexneedle.lab.tracker_evaluation.recording.watch import make_field_check, watch_tracker

    clock = WallClock()
    try:
        with ExitStack() as stack:
            tracker = stack.enter_context(open_tracker(args.tracker, clock))
            check = make_field_check(args.references)
            watch_tracker(tracker, clock, _display(stack, args.json), args.seconds, check, args.record)
    except KeyboardInterrupt:
        print(file=sys.stderr)  # the usual way to stop
    return 0


def _display(stack: ExitStack, as_json: bool) -> Callable[[TrackerSnapshot], None]:
    """Return the function that shows a snapshot."""
    if as_json:
        return _print_json
    lines = _Lines()
    stack.callback(lines.finish)
    return lines.show


def _print_json(snapshot: TrackerSnapshot) -> None:
    values: dict[str, Any] = {"time_s": snapshot.time, "frame_number": None, "status": snapshot.status}
    values |= {"verdict": snapshot.verdict, "sensors": {}}
    if snapshot.frame is not None and snapshot.is_new:
        values |= {"time_s": snapshot.frame.time, "frame_number": snapshot.frame.number}
        values["sensors"] = {name: _values(reading) for name, reading in snapshot.frame.readings.items()}
    print(json.dumps(values, allow_nan=False), flush=True)


def _values(reading: SensorReading) -> dict[str, Any]:
    return {
        "position_mm": reading.position,
        "quaternion": reading.orientation,
        "indicator": reading.indicator,
        "status": reading.status,
    }


class _Lines:
    """Prints one snapshot per second, each change of the verdict between good and bad, and the last snapshot."""

    def __init__(self) -> None:
        self._due = -inf
        self._last: TrackerSnapshot | None = None
        self._printed: TrackerSnapshot | None = None

    def show(self, snapshot: TrackerSnapshot) -> None:
        """Print a snapshot if it is due."""
        self._last = snapshot
        if snapshot.time >= self._due or self._has_changed(snapshot):
            self._due = snapshot.time + _LINE_EVERY_S
            self._print(snapshot)

    def finish(self) -> None:
        """Print the last snapshot if it has not been printed."""
        if self._last is not None and self._last is not self._printed:
            self._print(self._last)

    def _has_changed(self, snapshot: TrackerSnapshot) -> bool:
        from flexneedle.types import VISIBLE

        before = self._printed
        return before is not None and (snapshot.verdict == VISIBLE) != (before.verdict == VISIBLE)

    def _print(self, snapshot: TrackerSnapshot) -> None:
        self._printed = snapshot
        print(_line(snapshot), flush=True)


def _line(snapshot: TrackerSnapshot) -> str:
    if snapshot.frame is None or not snapshot.is_new:
        return f"{snapshot.time:8.2f} s  verdict: {snapshot.verdict}"
    time, sensors = snapshot.frame.time, "  ".join(_cells(snapshot.frame))
    return f"{time:8.2f} s  frame {snapshot.frame.number}  {sensors}  verdict: {snapshot.verdict}"


def _cells(frame: Frame) -> Iterator[str]:
    """Yield position and indicator of the tip (without a tip: of the first sensor), and the other indicators."""
    from flexneedle.types import TIP

    first = TIP if TIP in frame.readings else next(iter(frame.readings), "")
    for name, reading in frame.readings.items():
        if reading.position is None:
            yield f"{name} {reading.status}"
            continue
        position = " {:.2f} {:.2f} {:.2f} mm".format(*reading.position) if name == first else ""
        yield f"{name}{position}" + ("" if reading.indicator is None else f" I {reading.indicator:.4f}")
