"""Live readings of a tracker: its frames, the verdict on each, and a recording of them."""

import csv
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import inf
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.replay import ENDED
from flexneedle.lab.rig.devices.tracker_recording import COLUMNS, rows_of
from flexneedle.loop.monitor.monitor import field_verdict, is_distorted
from flexneedle.ports import Clock, Tracker
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import ORIGIN, VISIBLE, Frame, SensorReading, is_reference

FieldCheck = Callable[[Sequence[Frame], bool], tuple[str, bool]]
"""Function of the frames of the last seconds, oldest first, and whether the field was distorted before; returns the
verdict ("ok" or the reason) and whether the field is distorted now."""

_PAUSE_S = 0.01
_HISTORY = 400  # frames: 10 s


@dataclass(frozen=True)
class TrackerSnapshot:
    """The newest frame (None before the first), whether it is new, the status of the tracker, and the verdict."""

    time: float
    frame: Frame | None
    is_new: bool
    status: str
    verdict: str


def watch_tracker(
    tracker: Tracker,
    clock: Clock,
    show: Callable[[TrackerSnapshot], None],
    seconds: float = inf,
    check: FieldCheck | None = None,
    record: Path | None = None,
) -> int:
    """Show each new frame, or the status every half second without one, for `seconds` or until a replay ends.

    check: verdict on the field (default: `field_checker()`). record: new CSV file for all frames. Returns the number of
    frames. Raises InputError if the file cannot be written.
    """
    chosen = check if check is not None else make_field_check()
    history: deque[Frame] = deque(maxlen=_HISTORY)
    start, count, shown_at, distorted = clock.now(), 0, -inf, False
    with ExitStack() as files:
        write = _open_recorder(files, record)
        while (now := clock.now()) - start < seconds:
            frames = tracker.read()
            for frame in frames:
                history.append(frame)
                write(frame)
                verdict, distorted = chosen(history, distorted)
                show(TrackerSnapshot(now, frame, True, tracker.status, verdict))
            count += len(frames)
            if frames:
                shown_at = now
            elif now - shown_at > 0.5:
                show(_without_new(now, history, tracker.status))
                shown_at = now
            if tracker.status == ENDED:
                break
            clock.wait(_PAUSE_S)
    return count


def _without_new(now: float, history: Sequence[Frame], status: str) -> TrackerSnapshot:
    last = history[-1] if history else None
    return TrackerSnapshot(now, last, False, status, "no new frames" if status == VISIBLE else status)


def _find_fault(reading: SensorReading) -> str:
    return "exactly (0, 0, 0), a code for missing?" if reading.position == ORIGIN else reading.fault


def check_field(
    frames: Sequence[Frame], settings: MonitorSettings, distorted: bool = False
) -> tuple[str, bool]:
    """Return the verdict, and whether the field is distorted.

    The verdict names sensors without a position, else the state of the field by the rules of the monitor. As in the
    monitor, a distorted field remains distorted until it is known to be good. distorted: the state before.
    """
    field = field_verdict(frames, settings, distorted)
    faults = ((name, _find_fault(reading)) for name, reading in frames[-1].readings.items())
    fault = "; ".join(f"{name}: {reason}" for name, reason in faults if reason)
    return fault or str(field), is_distorted(field, distorted)


def make_field_check(references: int | None = None) -> FieldCheck:
    """Return `check_field` with the settings of the default monitor and this number of references.

    references: None for the number that the tracker has, at least one and at most what an insertion needs.
    """
    default = MonitorSettings()

    def check(frames: Sequence[Frame], distorted: bool) -> tuple[str, bool]:
        present = sum(map(is_reference, frames[-1].readings))
        needed = max(1, min(default.references, present)) if references is None else references
        return check_field(frames, default.model_copy(update={"references": needed}), distorted)

    return check


def _open_recorder(files: ExitStack, path: Path | None) -> Callable[[Frame], None]:
    if path is None:
        return lambda _: None
    if path.suffix == ".parquet":
        raise InputError(f"{path}: the output is CSV: use a name that ends in .csv")
    try:
        file = files.enter_context(path.open("x", newline="", encoding="utf-8"))
    except FileExistsError:
        raise InputError(f"{path}: already exists: choose another file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    return lambda frame: writer.writerows(rows_of(frame))
