"""Parts that figures share: titles, legends, a style for each controller, panels side by side, axes over decades."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from textwrap import fill, shorten
from typing import Any, Generic, TypeVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.legend_handler import HandlerBase, HandlerLine2D, HandlerPatch
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray

from flexneedle.figures.style import BAD, QUIET, TARGET, WIDTH, new_figure

Floats = NDArray[np.float64]
Content = TypeVar("Content")

COLUMNS: tuple[float, ...] = (1.8, 1.0)
"""Widths of a mosaic's columns, relative to each other."""
UPRIGHT = "upright"
"""gid of a line whose mark in the legend is upright."""
ARROW = "arrow"
"""gid of arrows, whose mark in the legend is an arrow."""
MOST_PANELS = 9
OVERLAID = 3  # controllers in one panel; more get a panel each
MANY = 1500  # dots; more are small and drawn as an image inside the SVG
FAINT = "#c9cbd0"
LIMIT: Any = {"color": TARGET, "linewidth": 1.0, "linestyle": (0, (4, 2)), "label": "1 mm"}

# Okabe and Ito's colours without their yellow, which is too light for lines on white, with a marker each.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4d535c")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")

_LEGEND = 0.45  # inches
_TITLE, _ROW, _HANDLE = 88, 140, 7  # characters: of a line of the title, a row of the legend, a mark in it


@dataclass(frozen=True)
class Look:
    """Colour and marker of a controller, the same in all figures."""

    color: str
    marker: str


@dataclass(frozen=True, eq=False)
class Panel(Generic[Content]):
    """Content of one panel of a figure. Title and note are above it, the alarm at the right."""

    title: str
    note: str
    color: str
    content: Content
    alarm: str = ""


def look(number: int) -> Look:
    """Return colour and marker of controller `number`; colours repeat after seven, markers after eleven more."""
    again = number // len(_COLORS)
    return Look(_COLORS[number % len(_COLORS)], _MARKERS[(number + again) % len(_MARKERS)])


def columns_of(count: int) -> int:
    """Return the number of columns for `count` panels."""
    return {1: 1, 2: 2, 4: 2}.get(count, 3)


def ticks_of(count: int) -> int:
    """Return the number of ticks that fit along each of `count` panels."""
    return {1: 9, 2: 7}.get(columns_of(count), 5)


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
    most = int((WIDTH / columns - 0.7 - 0.06 * len(panel.alarm)) / 0.085)
    pad = 15.0 if panel.note else 4.0
    ax.set_title(short(panel.title, most), loc="left", color=panel.color, pad=pad)
    ax.set_title(panel.alarm, loc="right", color=BAD, weight="normal", pad=pad)
    ax.annotate(panel.note, (0, 1), (0, 4), "axes fraction", "offset points", color=QUIET, fontsize=7.5)


def mosaic(
    title: str,
    height: float,
    rows: Sequence[Sequence[str]],
    heights: Sequence[float],
    widths: Sequence[float] = COLUMNS,
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with its title and the axes named in `rows`; heights, widths: relative to each other."""
    figure = new_figure(height)
    figure.set_layout_engine("constrained", h_pad=0.08, w_pad=0.08)
    figure.suptitle(fill(title, _TITLE), x=0.01, ha="left", fontsize=11, weight="bold")
    return figure, figure.subplot_mosaic(
        [list(row) for row in rows], height_ratios=heights, width_ratios=widths
    )


class _Upright(HandlerLine2D):
    """Draws the mark of a line upright, as the line is in the figure."""

    def create_artists(self, legend: Any, original: Any, *place: Any) -> list[Artist]:
        xdescent, ydescent, width, height, *_ = place
        (line,) = super().create_artists(legend, original, *place)
        middle, above = 0.5 * width - xdescent, 0.25 * height
        ends = [-ydescent - above, height - ydescent + above]
        line.set(xdata=[middle, middle], ydata=ends, markevery=None)  # a marker at each end
        return [line]


class _Arrow(HandlerPatch):
    """Draws the mark of arrows as one of them."""

    def create_artists(self, *given: Any) -> list[Artist]:
        _, original, xdescent, ydescent, width, height, _, transform = given
        middle = 0.5 * height - ydescent
        ends = ((-xdescent, middle), (width - xdescent, middle))
        style = "Simple,tail_width=1.6,head_width=7,head_length=8"
        arrow = FancyArrowPatch(*ends, arrowstyle=style, mutation_scale=1.0, shrinkA=0.0, shrinkB=0.0)
        face, edge = (np.atleast_2d(of())[0] for of in (original.get_facecolor, original.get_edgecolor))
        width = float(np.atleast_1d(original.get_linewidth())[0])
        arrow.set(facecolor=face, edgecolor=edge, linewidth=width, transform=transform)
        return [arrow]


_MARKS: dict[str | None, HandlerBase] = {UPRIGHT: _Upright(), ARROW: _Arrow()}


def legend_of(figure: Figure, shown: Iterable[Axes]) -> None:
    """Name at the foot of the figure all artists of some of its axes, each label once."""
    named: dict[str, Artist] = {}
    for ax in shown:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    legend(figure, list(named.values()))


def legend(figure: Figure, handles: Sequence[Artist], named: Sequence[Artist] = ()) -> None:
    """Name marks at the foot of the figure: the given ones, and `handles` whose label an artist has."""
    drawn = {artist.get_label() for ax in figure.axes for artist in ax.get_children()}
    shown = [*named, *(handle for handle in handles if handle.get_label() in drawn)]
    rows = ceil(sum(len(str(handle.get_label())) + _HANDLE for handle in shown) / _ROW)
    columns = ceil(len(shown) / max(1, rows)) or 1
    made = _legend(figure, shown, columns)
    while columns > 1 and made.get_window_extent().width > figure.bbox.width:
        made.remove()
        columns = ceil(len(shown) / ceil(len(shown) / (columns - 1)))  # as many in each
        made = _legend(figure, shown, columns)


def _legend(figure: Figure, shown: Sequence[Artist], columns: int) -> Legend:
    return figure.legend(
        handles=shown,
        loc="outside lower center",
        ncols=columns,
        columnspacing=1.6,
        handlelength=1.8,
        handler_map={handle: _MARKS[handle.get_gid()] for handle in shown if handle.get_gid() in _MARKS},
    )


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


def scattered(count: int, alpha: float = 0.75) -> dict[str, Any]:
    """Return the style of dots with which `count` of them can be distinguished."""
    if count > MANY:
        return {"s": 2.0, "alpha": 0.25, "linewidths": 0.0, "rasterized": True}
    return {"s": 9.0 if count <= 300 else 5.0, "alpha": alpha if count <= 300 else 0.55, "linewidths": 0.0}


def short(text: str, most: int) -> str:
    """Return a text cut to `most` characters, at a space where there is one."""
    cut = shorten(text, most, placeholder=" …")
    return cut if cut.strip("… ") or not text.strip() else text[: most - 1] + "…"
