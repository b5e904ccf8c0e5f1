"""Separation of environments by a threshold of the indicator: the ROC curve, and shares over the threshold."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from flexneedle.figures.layout import look, short
from flexneedle.figures.style import QUIET, new_figure, styled

_NAME = 24  # characters
_HIGH, _ROW = 4.4, 0.17  # inches: height of the axes with their labels; height of a line of the legends

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RocLine:
    """One sensor: its ROC curve (k,) and the mean indicators at grid points of the ideal and the noisy environment.

    environments: names of the two; values: their mean indicators; chosen: (false alarms, detected) at `threshold`;
    note: for the legend.
    """

    sensor: str
    environments: tuple[str, str]
    false_alarms: Floats
    detected: Floats
    values: tuple[Floats, Floats]
    threshold: float
    chosen: tuple[float, float]
    note: str


def roc_figure(lines: Sequence[RocLine]) -> Figure:
    """Return the figure: ROC curves on the left, shares above the threshold on the right, legends below."""
    rows = max(sum(line.note.count("\n") + 1 for line in lines), 2 * len(lines))
    with styled():
        figure = new_figure(_HIGH + _ROW * rows)
        left, right = figure.subplots(1, 2)
        _draw_roc(left, lines)
        _draw_shares(right, lines)
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", fontsize=7.5)
        figure.legend(*right.get_legend_handles_labels(), loc="outside lower right", fontsize=7.5)
    return figure


def _draw_roc(ax: Axes, lines: Sequence[RocLine]) -> None:
    ax.plot([0, 1], [0, 1], color=QUIET, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
    for number, line in enumerate(lines):
        own = look(number)
        dashes: Any = (0, (6, 1.5 * number)) if number else "-"
        common: dict[str, Any] = {"color": own.color, "clip_on": False, "in_layout": False}
        ax.plot(line.false_alarms, line.detected, linestyle=dashes, zorder=3, **common)
        label = f"{short(line.sensor, _NAME)}: {line.note}"
        ax.plot(*line.chosen, own.marker, ms=7, mec="white", zorder=4, label=label, **common)
    ideal, noisy = (short(name, 30) for name in lines[0].environments)
    _set_share(ax, "y", f"detected: points above ({noisy})")
    _set_share(ax, "x", f"false alarms: points above ({ideal})")
    ax.set_title("ROC curve of the indicator")


def _draw_shares(ax: Axes, lines: Sequence[RocLine]) -> None:
    for number, line in enumerate(lines):
        color = look(number).color
        for values, style, name in zip(line.values, ((0, (1, 1)), "-"), line.environments, strict=True):
            above = 1.0 - np.arange(len(values) + 1) / len(values)
            ends = np.concatenate([[0.0], np.sort(values)])
            label = f"{short(line.sensor, _NAME)}, {short(name, _NAME)}"
            ax.step(ends, above, where="post", color=color, linestyle=style, label=label, zorder=3)
        ax.axvline(line.threshold, color=color, linewidth=0.9, linestyle=(0, (4, 2)), zorder=1)
    ax.set_xlim(left=0.0)
    ax.set(title="Grid points above a threshold", xlabel="threshold of the indicator (dashed: in use)")
    _set_share(ax, "y", "grid points above")


def _set_share(ax: Axes, name: str, label: str) -> None:
    ax.set(**{f"{name}lim": (0.0, 1.0), f"{name}label": label})
    getattr(ax, f"{name}axis").set_major_formatter(PercentFormatter(1.0, symbol=" %"))
