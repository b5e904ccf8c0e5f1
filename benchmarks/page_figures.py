"""Figures of the page, from what benchmarks/page_probe.js has noted, and the table of them."""

from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Log = Mapping[str, Any]
GROWTH_MB = {"server": 5.0, "its workers": 20.0, "objects of a page": 1.0, "arrays of a page": 5.0}
"""Growth that counts as none. Ten minutes have 20 to 40 insertions; to keep one takes a server or a page 0.1 MB for its
rows, a page 4 MB for its shapes, and a worker 1 MB, whose size varies by some MB."""

_FRAME, _IN_FRAME = "AnimationFrame::Render", "FireAnimationFrame"
_REFUSED = -1  # the revision of an edit that was refused; None: not answered
_SCRIPT = (_IN_FRAME, "FunctionCall", "TimerFire", "EventDispatch")


@dataclass(frozen=True)
class Figure:
    """A figure with its bar (None: none), which is the most that it may be, or the least."""

    name: str
    unit: str
    value: float
    bar: float | None
    detail: str = ""
    least: bool = False

    @property
    def kept(self) -> bool:
        """Whether the bar is kept; a figure that is NaN keeps none."""
        if self.bar is None:
            return True
        return self.value >= self.bar if self.least else self.value <= self.bar


def spread(
    name: str, unit: str, values: Sequence[float] | Mapping[str, Sequence[float]], bar: float | None
) -> Figure:
    """The figure that 95 % of the values do not exceed; with the 95 % of each group, if there are groups."""
    groups = values if isinstance(values, Mapping) else {}
    all_values = [value for group in groups.values() for value in group] if groups else list(values)
    of_groups = "".join(f"; {key} {_most(group):.3g}" for key, group in groups.items())
    detail = f"95 % of {len(all_values)}; median {np.median(all_values or [np.nan]):.3g}, largest "
    return Figure(
        name, unit, _most(all_values), bar, f"{detail}{max(all_values, default=np.nan):.3g}{of_groups}"
    )


def clicked(name: str, logs: Sequence[Log], key: str, bar: float) -> Figure:
    """The time (ms) of clicks in all logs."""
    return spread(name, "ms", [ms for log in logs for ms in log[key]], bar)


def rate(name: str, frames: Sequence[Sequence[float]], bar: float) -> Figure:
    """Animation frames a second, of their times (ms) in several insertions: the least of them."""
    rates = [1e3 * (len(times) - 1) / (times[-1] - times[0]) for times in frames]
    longest = max(float(np.diff(times).max()) for times in frames)
    detail = (
        f"least of {len(rates)} insertions; median {np.median(rates):.1f}, longest pause {longest:.0f} ms"
    )
    return Figure(name, "1/s", min(rates), bar, detail, least=True)


def growth(memory: Sequence[Sequence[float]], warm: int, viewers: int) -> list[Figure]:
    """Growth from the first insertions after `warm` to the last, of what `GROWTH_MB` names, in MB after each."""
    few = max(1, min(3, (len(memory) - warm) // 2))
    first, last = (np.median(part, axis=0) for part in (memory[warm : warm + few], memory[-few:]))
    return [
        Figure(
            f"growth of memory: {name}",
            "MB",
            float(now - then),
            bar,
            f"{then:.1f} to {now:.1f} MB, {viewers} pages, {len(memory)} insertions",
        )
        for (name, bar), then, now in zip(GROWTH_MB.items(), first, last, strict=True)
    ]


def estimate_delays(log: Log) -> list[float]:
    """Time (ms) from each move of the target until an estimate of that place, or of a later one, was painted.

    Infinite where no edit has followed, or the edit was not answered. A refused one has no estimate (see `refusals`).
    """
    delays = []
    for moved in log["moves"]:
        revision = next((edit["revision"] for edit in log["edits"] if edit["time"] >= moved), None)
        if revision != _REFUSED:
            delays.append(_painted(log["estimates"], revision) - moved)
    return delays


def plan_delay(log: Log) -> float:
    """Time (ms) from the release of the target until the plan to its last place was painted."""
    revisions = [edit["revision"] for edit in log["edits"] if edit["revision"] != _REFUSED]
    last = revisions[-1] if revisions else None
    return _painted(log["plans"], last) - float(log["releases"][-1])


def refusals(name: str, logs: Sequence[Log]) -> Figure:
    """Requests that were refused in all logs: none may be, as nobody else is in control and no target out of bounds."""
    reasons = Counter(reason for log in logs for reason in log["refused"])
    detail = "; ".join(f"{count} × {reason}" for reason, count in reasons.most_common())
    return Figure(name, "", float(reasons.total()), 0.0, detail)


def processor_times(trace: Mapping[str, Any]) -> list[float]:
    """Processor time (ms) of the script before each paint that drew, of a browser's trace (category devtools.timeline).

    Its clock stops while other processes have the processor. The probe itself has one callback in each animation
    frame, so one that drew has more.
    """
    events = trace["traceEvents"]
    threads = Counter(_thread(event) for event in events if event["name"] == _IN_FRAME)
    if not threads:
        return []
    thread = threads.most_common(1)[0][0]
    begins = sorted(event["ts"] for event in events if (event["name"], event["ph"]) == (_FRAME, "b"))
    known = [event for event in events if event["ph"] == "X" and _thread(event) == thread]
    script = sorted((event for event in known if event["name"] in _SCRIPT), key=lambda event: event["ts"])
    spent, drawn, end = defaultdict(float), Counter(), 0.0
    for event in script:
        if event["ts"] < end:
            continue  # a part of the event before
        end = event["ts"] + event["dur"]
        in_frame = event["name"] == _IN_FRAME
        frame = bisect(begins, event["ts"]) + (not in_frame)  # what is between frames is of the next one
        spent[frame] += 1e-3 * event["tdur"]
        drawn[frame] += in_frame
    return [spent[frame] for frame, callbacks in drawn.items() if callbacks > 1]


def _thread(event: Mapping[str, Any]) -> tuple[int, int]:
    return event["pid"], event["tid"]


def _painted(shown: Sequence[Log], revision: int | None) -> float:
    """Return the time (ms) of the first painting of a revision; infinite if it was never painted or is unknown."""
    known = [] if revision is None else [one["time"] for one in shown if one["revision"] >= revision]
    return min(known, default=float("inf"))


def _most(values: Sequence[float]) -> float:
    """Return the smallest value that 95 % of the values do not exceed."""
    return float(np.quantile(values, 0.95, method="higher")) if len(values) else float("nan")


def table(figures: Sequence[Figure]) -> str:
    """A line for each figure."""
    width = max(len(figure.name) for figure in figures)
    lines = []
    for figure in figures:
        sign = "≥" if figure.least else "≤"
        bar = "" if figure.bar is None else f"{sign} {figure.bar:g}"
        verdict = "" if figure.bar is None else "kept" if figure.kept else "EXCEEDED"
        value = f"{figure.value:.3g} {figure.unit}"
        lines.append(f"{figure.name:{width}}  {bar:>7}  {value:>16}  {verdict:8}  {figure.detail}")
    return "\n".join(lines)
