"""The table of docs/safety.md and its picture, of the rows of trials."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fault_judging import MOTION_MM, good, seconds_of
from fault_list import Fault

Row = Mapping[str, Any]
_BLUE, _RED = "#0072b2", "#d55e00"


def table(faults: Sequence[Fault], rows: Sequence[Row]) -> str:
    """Markdown table, with a line below it on what the needle did when faults were injected."""
    lines = [
        "||fault|required|ended|detected within (limit) s|motion after it mm|roll after it °|",
        "|---|---|---|---|---:|---:|---:|",
        *(_line(fault, mine) for fault in faults if (mine := rows_of(fault, rows))),
    ]
    during = [row["during"] for row in rows]
    shares = ", ".join(
        f"{during.count(name)} {text}"
        for name, text in (
            ("advance", "an advance"),
            ("roll", "a roll"),
            ("rest", "a rest between two steps"),
        )
    )
    return "\n".join([*lines, "", f"{len(rows)} faults, during: {shares}."])


def rows_of(fault: Fault, rows: Sequence[Row]) -> list[Row]:
    """The rows of a fault."""
    return [row for row in rows if (row["group"], row["fault"]) == (fault.group, fault.name)]


def _line(fault: Fault, rows: Sequence[Row]) -> str:
    outcomes = sorted({"no record" if row["outcome"] == "running" else row["outcome"] for row in rows})
    longest = _longest([seconds_of(fault, row) for row in rows])
    if fault.timed == "rest_s":
        longest = f"at rest: {longest}"
    count = sum(good(fault, row) for row in rows)
    required = (
        fault.reaction.text if count == len(rows) else f"{fault.reaction.text} ({count} of {len(rows)})"
    )
    cells = [
        *(fault.group, fault.name, required, ", ".join(outcomes)),
        "–" if fault.within is None else f"{longest} ({fault.within:g})",
        _longest([row["motion_mm"] for row in rows]),
        _longest([row["rolled_deg"] for row in rows], 1),
    ]
    return f"|{'|'.join(cells)}|"


def _longest(values: Sequence[float | None], digits: int = 3) -> str:
    found = [value for value in values if value is not None]
    return f"{max(found):.{digits}f}" if found else "–"


def draw(faults: Sequence[Fault], rows: Sequence[Row], path: Path) -> None:
    """Draw the time to detection of each trial with its limit, and the motion and the roll after it."""
    import matplotlib.pyplot as plt

    shown = [(fault, mine) for fault in faults if (mine := rows_of(fault, rows))]
    figure, axes = plt.subplots(
        1,
        3,
        figsize=(11.0, 0.24 * len(shown) + 1.2),
        sharey=True,
        layout="constrained",
        width_ratios=[3, 3, 2],
    )
    for at, (fault, mine) in enumerate(shown):
        seconds = [seconds_of(fault, row) for row in mine]
        columns = (seconds, *([row[key] for row in mine] for key in ("motion_mm", "rolled_deg")))
        for axis, found in zip(axes, columns, strict=True):
            values = [value for value in found if value is not None]
            least = np.maximum(values, 1e-3) if axis is axes[0] else values
            axis.plot(least, [at] * len(values), "o", color=_BLUE, alpha=0.4, markersize=4)
        if fault.within is not None:
            axes[0].plot([fault.within], [at], "|", color=_RED, markersize=11, markeredgewidth=2)
    axes[1].axvline(MOTION_MM, color=_RED, linewidth=2)
    axes[0].set(xscale="log", xlim=(8e-4, 4.0), xlabel="time to detection, or to rest (s);\nred: its limit")
    axes[0].set_yticks(range(len(shown)), [f"{fault.group}: {fault.name}" for fault, _ in shown])
    axes[1].set(xlabel="motion of the base after detection (mm);\nred: its limit", xlim=(-0.02, 0.6))
    axes[2].set(xlabel="roll after detection (°)", xlim=(-5.0, 185.0))
    for axis in axes:
        axis.grid(axis="both", color="0.9")
        axis.set_axisbelow(True)
    axes[0].set_ylim(len(shown) - 0.5, -0.5)
    figure.savefig(path, dpi=150)
