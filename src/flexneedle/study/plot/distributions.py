"""Distributions of the true error: a row of dots for each group, with quartiles, mean and 95 %."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.plot.layout import (
    Floats,
    Look,
    Panels,
    decades,
    head,
    legend,
    panel_width,
    panels,
    scattered,
    short,
)
from flexneedle.plot.style import INK, QUIET, TARGET, WIDTH, axes, new_figure, styled

_LEAST = 1e-3  # mm; smaller errors are drawn here
_GOLDEN = 0.6180339887
_ROW, _CLOSE_ROW = 0.42, 0.31  # inches


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """True errors (k,) (mm) of the finished ones among `count` insertions."""

    name: str
    look: Look
    errors: Floats
    count: int


@dataclass(frozen=True, eq=False)
class ErrorPanel:
    """Rows under one title, all of one look."""

    title: str
    note: str
    alarm: str
    rows: Sequence[ErrorRow]


def error_rows_figure(rows: Sequence[ErrorRow]) -> Figure:
    """Return the figure of rows above each other, one for each controller or group."""
    left, right, top = 1.75, 1.35, 0.15
    height = _ROW * len(rows)
    with styled():
        figure = new_figure(top + height + 0.75)
        ax = axes(figure, left, top, WIDTH - left - right, height)
        decades(ax.xaxis, [_drawn(row.errors) for row in rows], 9)
        _draw_rows(ax, rows, high=0.3)
        for level, row in enumerate(rows):
            text = _counted(row)
            ax.text(
                1.02, level, text, transform=ax.get_yaxis_transform(), va="center", color=QUIET, fontsize=8
            )
        for label, row in zip(ax.get_yticklabels(), rows, strict=True):
            label.set(color=row.look.color, fontweight="bold")
        ax.set_xlabel("true error (mm)", labelpad=1.0)
        legend(figure, _handles(ax))
    return figure


def errors_by_level_figure(shown: Sequence[ErrorPanel], label: str) -> Figure:
    """Return the figure with a panel for each controller and in it a row for each level of `label`."""
    with styled():
        most = max(len(panel.rows) for panel in shown)
        made = panels(
            len(shown), ((_ROW if len(shown) == 1 else _CLOSE_ROW) * most + 0.2) / panel_width(len(shown))
        )
        for ax, panel in zip(made.axes, shown, strict=True):
            _draw_rows(ax, panel.rows, high=0.26)
            head(ax, panel.title, panel.note, panel.rows[0].look.color, panel.alarm)
        _share(made, shown, label)
        legend(made.figure, _handles(made.axes[0]))
    return made.figure


def _share(made: Panels, shown: Sequence[ErrorPanel], label: str) -> None:
    """Give all panels the same scale, and label the outer ones."""
    errors = [_drawn(row.errors) for panel in shown for row in panel.rows]
    for ax in made.axes:
        decades(ax.xaxis, errors, {1: 11, 2: 7}.get(made.columns, 5))
        ax.tick_params(labelleft=ax in made.leftmost, labelbottom=ax in made.lowest)
    for ax in made.lowest:
        ax.set_xlabel("true error (mm)", labelpad=1.0)
    for ax in made.leftmost:
        ax.set_ylabel(label)


def _draw_rows(ax: Axes, rows: Sequence[ErrorRow], high: float) -> None:
    """Draw rows from the top down; `high`: half of what the dots of a row spread over."""
    ax.set_ylim(len(rows) - 0.45, -0.6)
    ax.set_yticks(range(len(rows)), [short(row.name, 24) for row in rows])
    ax.tick_params(axis="y", length=0)
    ax.axvline(1.0, color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), zorder=1)
    for level, row in enumerate(rows):
        if len(row.errors):
            _draw_row(ax, level, row, high)


def _draw_row(ax: Axes, level: int, row: ErrorRow, high: float) -> None:
    errors = _drawn(row.errors)
    spread = level + high * (2.0 * ((np.arange(len(errors)) * _GOLDEN) % 1.0) - 1.0)
    ax.scatter(errors, spread, color=row.look.color, zorder=2, label="errors", **scattered(len(errors), 0.5))
    first, middle, third, most = np.quantile(errors, (0.25, 0.5, 0.75, 0.95)).tolist()
    thick: dict[str, Any] = {"color": INK, "zorder": 4, "solid_capstyle": "butt"}
    ax.plot([first, third], [level, level], linewidth=3.0, alpha=0.85, label="quartiles", **thick)
    ax.plot(
        [middle], [level], "o", color="white", markeredgecolor=INK, markersize=4.5, zorder=6, label="median"
    )
    average = float(_drawn(np.array([row.errors.mean()]))[0])
    ax.plot([average], [level], "D", color=INK, markersize=4, markeredgecolor="white", zorder=5, label="mean")
    ax.plot([most, most], [level - high, level + high], linewidth=1.6, label="95 %", **thick)


def _drawn(errors: Floats) -> Floats:
    return np.maximum(errors, _LEAST)


def _counted(row: ErrorRow) -> str:
    missing = row.count - len(row.errors)
    return f"n = {row.count}" + (f"\n{missing} not finished" if missing else "")


def _handles(ax: Axes) -> list[Line2D]:
    low, high = ax.get_xlim()
    limit = Line2D([], [], color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), label="1 mm")
    mark: dict[str, Any] = {"linestyle": "none"}
    white: dict[str, Any] = {"color": "white", "markeredgecolor": INK}
    return [
        Line2D([], [], color=QUIET, marker="o", markersize=3, label="an insertion", **mark),
        Line2D([], [], color=INK, linewidth=3.0, alpha=0.85, label="middle half"),
        Line2D([], [], marker="o", markersize=4.5, label="median", **white, **mark),
        Line2D([], [], color=INK, marker="D", markersize=4, label="mean", **mark),
        Line2D([], [], color=INK, marker="|", markersize=10, markeredgewidth=1.6, label="95 %", **mark),
        *([limit] if low < 1.0 < high else []),
    ]
