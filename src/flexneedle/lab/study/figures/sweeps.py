"""The true error along an axis of a study: median, interquartile range and mean for each controller."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import Floats, legend, short
from flexneedle.figures.style import BAD, INK, apply_style
from flexneedle.lab.study.figures.panels import FAINT, Panel, decades, panels
from flexneedle.lab.study.figures.samples import ErrorSample

_FIRST, _THIRD = partial(np.quantile, q=0.25), partial(np.quantile, q=0.75)
_MOST_BANDS = 3
_GAP = 6.0  # pixels between names of levels
_WIDE = 20.0  # ratio of the largest to the smallest median or mean above which the scale is logarithmic
Sweep = Panel[Sequence[ErrorSample]]
"""A controller with the samples at the m levels."""


def draw_sweep(sweeps: Sequence[Sweep], label: str, places: Floats) -> Figure:
    """Return the figure along an axis with levels at `places` (m,); more than three controllers have no bands."""
    with apply_style():
        figure, (ax,) = panels([Panel("", "", INK, ())], 4.0, short(label, 60), "true error (mm)")
        for sweep in sweeps:
            _draw(ax, sweep, places, with_band=len(sweeps) <= _MOST_BANDS)
        _scale(ax, sweeps)
        _name_levels(ax, places, [row.name for row in sweeps[0].content])
        _count_unfinished(ax, sweeps, places)
        legend(figure, _handles(), [_name_sweep(sweep) for sweep in sweeps])
        figure.draw_without_rendering()
        _thin_names(ax)
    return figure


def _draw(ax: Axes, sweep: Sweep, places: Floats, *, with_band: bool) -> None:
    color, marker = sweep.color, sweep.content[0].look.marker
    if with_band:
        low, high = _apply_to_levels(sweep, _FIRST), _apply_to_levels(sweep, _THIRD)
        band: dict[str, Any] = {
            "color": color,
            "alpha": 0.16,
            "linewidth": 0.0,
            "label": "interquartile range",
        }
        ax.fill_between(places, low, high, zorder=2, **band)
    middle, average = _apply_to_levels(sweep, np.median), _apply_to_levels(sweep, np.mean)
    ax.plot(places, middle, color=color, marker=marker, markersize=5, zorder=4, label="median")
    ax.plot(places, average, color=color, linestyle=(0, (4, 2)), linewidth=1.2, zorder=3, label="mean")


def _apply_to_levels(sweep: Sweep, statistic: Callable[[Floats], object]) -> Floats:
    samples = (row.errors for row in sweep.content)
    return np.array([statistic(errors) if len(errors) else np.nan for errors in samples], dtype=float)


def _scale(ax: Axes, sweeps: Sequence[Sweep]) -> None:
    shown = [_apply_to_levels(sweep, statistic) for sweep in sweeps for statistic in (np.median, np.mean)]
    band = [_apply_to_levels(sweep, statistic) for sweep in sweeps for statistic in (_FIRST, _THIRD)]
    values = np.concatenate(shown)
    values = values[values > 0.0]
    if len(values) and values.max() > _WIDE * values.min():
        decades(ax.yaxis, [*shown, *band], 6)
    else:
        ax.set_ylim(0.0, 1.08 * float(np.nanmax(np.concatenate([*shown, *band, np.array([1e-6])]))))
    ax.grid(axis="y", color=FAINT, linewidth=0.4)
    ax.set_axisbelow(True)


def _name_levels(ax: Axes, places: Floats, names: Sequence[str]) -> None:
    """Set a tick with its name at each level."""
    span = float(places.max() - places.min()) or 1.0
    ax.set_xlim(places.min() - 0.05 * span, places.max() + 0.05 * span)
    ax.set_xticks(places, names)


def _thin_names(ax: Axes) -> None:
    """Hide each name of a level that would touch the one before. The layout of the figure must be final."""
    end = -inf
    for name in ax.get_xticklabels():
        box = name.get_window_extent()
        name.set_visible(box.x0 > end)
        end = box.x1 + _GAP if name.get_visible() else end


def _count_unfinished(ax: Axes, sweeps: Sequence[Sweep], places: Floats) -> None:
    """Write the number of unfinished insertions above each level that has any."""
    missing = [sum(row.missing for row in level) for level in zip(*(s.content for s in sweeps), strict=True)]
    look: dict[str, Any] = {"textcoords": "offset points", "color": BAD, "fontsize": 7.5}
    if any(missing):
        ax.annotate("not finished:", (0, 1), (0, 14), "axes fraction", **look)
    for place, count in zip(places.tolist(), missing, strict=True):
        if count:
            ax.annotate(str(count), (place, 1), (0, 3), ax.get_xaxis_transform(), ha="center", **look)


def _name_sweep(sweep: Sweep) -> Line2D:
    look = sweep.content[0].look
    return Line2D([], [], color=look.color, marker=look.marker, markersize=5, label=short(sweep.title, 30))


def _handles() -> list[Line2D]:
    return [
        Line2D([], [], color=INK, label="median"),
        Line2D([], [], color=INK, alpha=0.16, linewidth=6.0, label="interquartile range"),
        Line2D([], [], color=INK, linestyle=(0, (4, 2)), linewidth=1.2, label="mean"),
    ]
