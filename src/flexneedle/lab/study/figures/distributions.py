"""Distributions of the true error: one row of dots per group, with quartiles, mean and 95 %."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import legend, short
from flexneedle.figures.style import INK, QUIET, apply_style
from flexneedle.lab.study.figures.panels import (
    LIMIT,
    Panel,
    choose_dots,
    decades,
    limit_line,
    panels,
    ticks_of,
)
from flexneedle.lab.study.figures.samples import LEAST, ErrorSample

_GOLDEN = 0.6180339887
_HIGH = 0.28  # half height of the scatter of a row


def draw_errors(shown: Sequence[Panel[Sequence[ErrorSample]]], label: str) -> Figure:
    """Return the figure: one panel each, one row per sample; label: factor of the rows."""
    single, most = len(shown) == 1, max(len(panel.content) for panel in shown)
    with apply_style():
        figure, axes = panels(shown, (0.42 if single else 0.31) * most + 0.75, "true error (mm)", label)
        for ax, panel in zip(axes, shown, strict=True):
            errors = [sample.drawn for other in shown for sample in other.content]
            decades(ax.xaxis, errors, ticks_of(len(shown)))
            _draw_rows(ax, panel.content)
        if single:
            _count(axes[0], shown[0].content)
        legend(figure, _handles())
    return figure


def _draw_rows(ax: Axes, rows: Sequence[ErrorSample]) -> None:
    """Draw rows from the top down."""
    ax.set_ylim(len(rows) - 0.45, -0.6)
    ax.set_yticks(range(len(rows)), [short(row.name, 24) for row in rows])
    ax.tick_params(axis="y", length=0)
    limit_line(ax, vertical=True)
    for level, row in enumerate(rows):
        if len(row.errors):
            _draw_row(ax, level, row)


def _draw_row(ax: Axes, level: int, row: ErrorSample) -> None:
    errors = row.drawn
    spread = level + _HIGH * (2.0 * ((np.arange(len(errors)) * _GOLDEN) % 1.0) - 1.0)
    dots = choose_dots(len(errors), 0.5)
    ax.scatter(errors, spread, color=row.look.color, zorder=2, label="one insertion", **dots)
    first, middle, third, most = np.quantile(errors, (0.25, 0.5, 0.75, 0.95)).tolist()
    thick: dict[str, Any] = {"color": INK, "zorder": 4, "solid_capstyle": "butt"}
    white: dict[str, Any] = {"color": "white", "markeredgecolor": INK, "markersize": 4.5, "zorder": 6}
    dark: dict[str, Any] = {"color": INK, "markeredgecolor": "white", "markersize": 4, "zorder": 5}
    ax.plot([first, third], [level, level], linewidth=3.0, alpha=0.85, label="interquartile range", **thick)
    ax.plot([middle], [level], "o", label="median", **white)
    ax.plot([max(row.errors.mean(), LEAST)], [level], "D", label="mean", **dark)
    ax.plot([most, most], [level - _HIGH, level + _HIGH], linewidth=1.6, label="95 %", **thick)


def _count(ax: Axes, rows: Sequence[ErrorSample]) -> None:
    """Write the number of insertions to the right of each row."""
    for level, row in enumerate(rows):
        text = f"n = {row.count}" + (f"\n{row.missing} not finished" if row.missing else "")
        placed: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center", "fontsize": 8}
        ax.text(1.02, level, text, color=QUIET, **placed)


def _handles() -> list[Line2D]:
    mark: dict[str, Any] = {"linestyle": "none"}
    white: dict[str, Any] = {"color": "white", "markeredgecolor": INK}
    return [
        Line2D([], [], color=QUIET, marker="o", markersize=3, label="one insertion", **mark),
        Line2D([], [], color=INK, linewidth=3.0, alpha=0.85, label="interquartile range"),
        Line2D([], [], marker="o", markersize=4.5, label="median", **white, **mark),
        Line2D([], [], color=INK, marker="D", markersize=4, label="mean", **mark),
        Line2D([], [], color=INK, marker="|", markersize=10, markeredgewidth=1.6, label="95 %", **mark),
        Line2D([], [], **LIMIT),
    ]
