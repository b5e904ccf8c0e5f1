"""Panels side by side, and axes over decades, which the figures of a study share."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Any, Generic, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure

from flexneedle.figures.layout import Floats, short
from flexneedle.figures.style import BAD, QUIET, TARGET, is_column, new_figure, width

Content = TypeVar("Content")

MOST_PANELS = 9
MANY = 1500  # dots; more are small and drawn as an image inside the SVG
FAINT = "#c9cbd0"
LIMIT: Any = {"color": TARGET, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": "1 mm"}

_LEGEND = 0.45  # inches


@dataclass(frozen=True, eq=False)
class Panel(Generic[Content]):
    """Content of one panel of a figure. Title and note are above it, the alarm at the right."""

    title: str
    note: str
    color: str
    content: Content
    alarm: str = ""


def columns_of(count: int) -> int:
    """Return the number of columns for `count` panels."""
    return 1 if is_column() else {1: 1, 2: 2, 4: 2}.get(count, 3)


def ticks_of(count: int) -> int:
    """Return the number of ticks that fit along each of `count` panels."""
    return 5 if is_column() else {1: 9, 2: 7}.get(columns_of(count), 5)


def sheet(
    height: float, rows: int = 1, columns: int = 1, widths: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes row by row, `height` inches for each row, and room for a legend.

    widths: of the columns, relative to each other (default: equal).
    """
    figure = new_figure(rows * height + _LEGEND)
    figure.set_layout_engine("compressed", w_pad=0.1, h_pad=0.08)  # axes of equal scale leave no gaps
    return figure, list(figure.subplots(rows, columns, squeeze=False, width_ratios=widths).flat)


def panels(
    shown: Sequence[Panel[Any]], height: float, xlabel: str, ylabel: str = ""
) -> tuple[Figure, list[Axes]]:
    """Return a figure with empty axes for panels, labelled at the outer ones; `height`: inches for each row."""
    columns = columns_of(len(shown))
    figure, made = sheet(height, ceil(len(shown) / columns), columns)
    for ax in made[len(shown) :]:
        ax.remove()
    for k, (ax, panel) in enumerate(zip(made, shown, strict=False)):
        head(ax, panel, columns)
        first, lowest = k % columns == 0, k >= len(shown) - columns
        ax.tick_params(labelleft=first, labelbottom=lowest)
        ax.set_ylabel(ylabel if first else "")
        ax.set_xlabel(xlabel if lowest else "")
    return figure, made[: len(shown)]


def head(ax: Axes, panel: Panel[Any], columns: int) -> None:
    """Write title, note and alarm above a panel, one of `columns` side by side."""
    most = int((width() / columns - 0.7 - 0.06 * len(panel.alarm)) / 0.085)
    pad = 15.0 if panel.note else 4.0
    ax.set_title(short(panel.title, most), loc="left", color=panel.color, pad=pad)
    ax.set_title(panel.alarm, loc="right", color=BAD, weight="normal", pad=pad)
    ax.annotate(panel.note, (0, 1), (0, 4), "axes fraction", "offset points", color=QUIET, fontsize=7.5)


def limit_line(ax: Axes, vertical: bool) -> None:
    """Draw the limit of 1 mm into a panel if its scale reaches there."""
    low, high = ax.get_xlim() if vertical else ax.get_ylim()
    draw = ax.axvline if vertical else ax.axhline
    if low < 1.0 < high:
        draw(1.0, **LIMIT, zorder=1)


def decades(axis: XAxis | YAxis, values: Iterable[Floats], most: int) -> None:
    """Make an axis logarithmic over all positive values, with up to `most` ticks at plain numbers."""
    known = np.concatenate([np.asarray(array, dtype=float).ravel() for array in values] or [np.empty(0)])
    known = known[np.isfinite(known) & (known > 0.0)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.1, 1.0)
    low, high = low / 1.25, high * 1.25
    ticks = _ticks(low, high, most)
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _ticks(low: float, high: float, most: int) -> list[float]:
    first, last = floor(log10(low)), ceil(log10(high))
    for digits in ((1, 2, 5), (1, 3), (1,)):
        ticks = [float(f"{digit}e{k}") for k in range(first, last + 1) for digit in digits]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) <= most:
            return inside
    return inside[:: ceil(len(inside) / most)]


def choose_dots(count: int, alpha: float = 0.75) -> dict[str, Any]:
    """Return the style of dots with which `count` of them can be distinguished."""
    if count > MANY:
        return {"s": 2.0, "alpha": 0.25, "linewidths": 0.0, "rasterized": True}
    return {"s": 9.0 if count <= 300 else 5.0, "alpha": alpha if count <= 300 else 0.55, "linewidths": 0.0}
