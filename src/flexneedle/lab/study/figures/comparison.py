"""Paired mean differences with confidence intervals, one row each, and a line at zero."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import Look, legend, short
from flexneedle.figures.style import INK, QUIET, apply_style, format_signed
from flexneedle.lab.study.figures.panels import FAINT, Panel, panels, ticks_of

_SURE, _UNSURE = "mean with 95 % interval", "not separable from no difference"


@dataclass(frozen=True)
class DifferenceRow:
    """A mean difference (mm) with the ends of its interval, NaN where there is none."""

    name: str
    look: Look
    mean: float
    low: float
    high: float


def draw_differences(shown: Sequence[Panel[Sequence[DifferenceRow]]], label: str) -> Figure:
    """Return the figure: one panel each, with rows in the same order, on a common scale with `label`."""
    most = max(len(panel.content) for panel in shown)
    with apply_style():
        figure, axes = panels(shown, 0.3 * most + 0.8, label)
        for ax, panel in zip(axes, shown, strict=True):
            _draw(ax, panel.content)
            _scale(ax, [row for other in shown for row in other.content], ticks_of(len(shown)))
        legend(figure, _handles())
    return figure


def _draw(ax: Axes, rows: Sequence[DifferenceRow]) -> None:
    ax.axvline(0.0, color=INK, linewidth=0.8, zorder=1, label="no difference")
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_yticks(range(len(rows)), [short(row.name, 34) for row in rows])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="x", color=FAINT, linewidth=0.4)
    ax.set_axisbelow(True)
    for level, row in enumerate(rows):
        if isnan(row.mean):
            _write(ax, level, "no pairs")
        else:
            _draw_row(ax, level, row)


def _draw_row(ax: Axes, level: int, row: DifferenceRow) -> None:
    sure = row.low > 0.0 or row.high < 0.0
    if not isnan(row.low):
        ends = [row.low, row.high], [level, level]
        ax.plot(*ends, color=row.look.color, linewidth=2.0, zorder=3, label="interval")
    mark: dict[str, Any] = {"markersize": 6, "markeredgewidth": 1.4, "markeredgecolor": row.look.color}
    mark |= {"markerfacecolor": row.look.color if sure else "white", "zorder": 4}
    ax.plot([row.mean], [level], row.look.marker, label=_SURE if sure else _UNSURE, **mark)


def _write(ax: Axes, level: int, text: str) -> None:
    ground = {"facecolor": "white", "linewidth": 0.0, "pad": 1.0}  # hides the line at zero
    placed: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center", "bbox": ground}
    ax.text(0.01, level, text, color=QUIET, fontsize=8, **placed)


def _scale(ax: Axes, rows: Sequence[DifferenceRow], ticks: int) -> None:
    known = [v for row in rows for v in (row.mean, row.low, row.high) if not isnan(v)] or [0.0]
    low, high = min(0.0, *known), max(0.0, *known)
    pad = 0.06 * (high - low) or 0.05
    ax.set_xlim(low - pad, high + pad)
    ax.locator_params(axis="x", nbins=ticks)
    ax.xaxis.set_major_formatter(lambda value, _: format_signed(round(value, 9)))


def _handles() -> list[Line2D]:
    full: dict[str, Any] = {"color": QUIET, "marker": "o", "markersize": 6, "markeredgewidth": 1.4}
    return [
        Line2D([], [], linewidth=2.0, label=_SURE, **full),
        Line2D([], [], linewidth=2.0, markerfacecolor="white", label=_UNSURE, **full),
    ]
