"""Paired mean differences with confidence intervals, one row each, and a line at zero."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, inf, isnan, log10
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import Look, legend, short
from flexneedle.figures.style import INK, QUIET, signed, styled
from flexneedle.lab.study.figures.panels import FAINT, Panel, panels, ticks_of

_WIDE = 10.0  # ratio of the largest value to the linear range above which the scale is symlog
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
    with styled():
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
    even = _find_linear_range(rows)
    if max(high, -low) > _WIDE * even:
        _scale_decades(ax, low, high, even, ticks)
    else:
        pad = 0.06 * (high - low) or 0.05
        ax.set_xlim(low - pad, high + pad)
        ax.locator_params(axis="x", nbins=ticks)
    ax.xaxis.set_major_formatter(lambda value, _: signed(round(value, 9)))


def _find_linear_range(rows: Sequence[DifferenceRow]) -> float:
    """Return the range of the linear scale around zero: largest interval that contains zero, or else nearest end."""
    known = [(abs(row.low), abs(row.high), row.low <= 0.0 <= row.high) for row in rows if not isnan(row.low)]
    holding = [max(low, high) for low, high, holds in known if holds]
    nearest = [min(low, high) for low, high, _ in known]
    return max(holding) if holding else min(nearest, default=inf)


def _scale_decades(ax: Axes, low: float, high: float, even: float, most: int) -> None:
    """Make the scale linear within ±`even` around zero, and logarithmic beyond."""
    ax.set_xscale("symlog", linthresh=even)
    ax.set_xlim(min(1.3 * low, -1.3 * even), max(1.3 * high, 1.3 * even))
    sizes = [float(f"{digit}e{k}") for k in range(floor(log10(even)) - 1, 4) for digit in (1, 3)]
    beyond = [sign * size for size in sizes if size > 0.3 * even for sign in (-1.0, 1.0)]
    inside = sorted([0.0, *(value for value in beyond if low <= value <= high)])
    ax.set_xticks(inside if len(inside) <= most else [v for v in inside if f"{abs(v):e}"[0] in "01"])
    ax.set_xticks([], minor=True)


def _handles() -> list[Line2D]:
    full: dict[str, Any] = {"color": QUIET, "marker": "o", "markersize": 6, "markeredgewidth": 1.4}
    return [
        Line2D([], [], linewidth=2.0, label=_SURE, **full),
        Line2D([], [], linewidth=2.0, markerfacecolor="white", label=_UNSURE, **full),
    ]
