"""Watching a tracker live: its frames, what they are judged as, and a recording of them."""

import csv
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import inf
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.rig.devices.recording import COLUMNS, rows_of
from flexneedle.rig.devices.replay import ENDED
from flexneedle.rig.monitor.monitor import field_verdict, is_distorted
from flexneedle.rig.ports import Clock, Tracker
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import VISIBLE, Frame, is_reference

Judge = Callable[[Sequence[Frame], bool], tuple[str, bool]]
"""From the frames of the last seconds, oldest first, and whether the field was distorted before, to the verdict
("ok" or the reason) and whether the field is distorted now."""

_PAUSE_S = 0.01
_HISTORY = 400  # frames: 10 s


@dataclass(frozen=True)
class View:
    """What there is to show: the newest frame (None before the first), new or not; how the tracker is; the verdict."""

    time: float
    frame: Frame | None
    is_new: bool
    status: str
    verdict: str


def watch(
    tracker: Tracker,
    clock: Clock,
    show: Callable[[View], None],
    seconds: float = inf,
    judge: Judge | None = None,
    record: Path | None = None,
) -> int:
    """Show each new frame, and the state every half second where none arrives, for `seconds` or until a replay ends.

    judge: `field_judge()`, if left out. record: a CSV of all frames, which must not exist yet. Returns the number
    of frames. Raises InputError if the file cannot be written.
    """
    chosen = judge if judge is not None else field_judge()
    history: deque[Frame] = deque(maxlen=_HISTORY)
    start, count, shown_at, distorted = clock.now(), 0, -inf, False
    with ExitStack() as files:
        keep = _recorder(files, record)
        while (now := clock.now()) - start < seconds:
            frames = tracker.read()
            for frame in frames:
                history.append(frame)
                keep(frame)
                verdict, distorted = chosen(history, distorted)
                show(View(now, frame, True, tracker.status, verdict))
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


def _without_new(now: float, history: Sequence[Frame], status: str) -> View:
    last = history[-1] if history else None
    return View(now, last, False, status, "no new frames" if status == VISIBLE else status)


def judge_field(
    frames: Sequence[Frame], settings: MonitorSettings, distorted: bool = False
) -> tuple[str, bool]:
    """Return the first thing that is wrong: sensors without a position, then the field by the monitor's rules.

    And whether the field is distorted: as the monitor holds an insertion, until the field is known to be good again.
    distorted: whether it was before.
    """
    field = field_verdict(frames, settings, distorted)
    fault = "; ".join(f"{name}: {r.status}" for name, r in frames[-1].readings.items() if r.status != VISIBLE)
    return fault or str(field), is_distorted(field, distorted)


def field_judge(references: int | None = None) -> Judge:
    """Return `judge_field` by the default monitor with this number of references; without a number, with those that the
    tracker has: one at least, and no more than an insertion needs."""
    default = MonitorSettings()

    def judge(frames: Sequence[Frame], distorted: bool) -> tuple[str, bool]:
        there = sum(map(is_reference, frames[-1].readings))
        wanted = max(1, min(default.references, there)) if references is None else references
        return judge_field(frames, default.model_copy(update={"references": wanted}), distorted)

    return judge


def _recorder(files: ExitStack, path: Path | None) -> Callable[[Frame], None]:
    if path is None:
        return lambda _: None
    if path.suffix == ".parquet":
        raise InputError(f"{path}: a CSV is written: give a name that ends in .csv")
    try:
        file = files.enter_context(path.open("x", newline="", encoding="utf-8"))
    except FileExistsError:
        raise InputError(f"{path}: exists: give another file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    return lambda frame: writer.writerows(rows_of(frame))
