"""Parts that figures share: titles, legends, a style for each controller."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from textwrap import fill, shorten
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.legend_handler import HandlerBase, HandlerLine2D, HandlerPatch
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray

from flexneedle.figures.style import WIDTH, is_column, is_narrow, new_figure, width
from flexneedle.planning import STRATEGIES

Floats = NDArray[np.float64]
COLUMNS: tuple[float, ...] = (1.8, 1.0)
"""Widths of a mosaic's columns, relative to each other."""
UPRIGHT = "upright"
"""gid of a line whose mark in the legend is upright."""
MOVABLE = "movable"
"""gid of a text beside its mark that may go to its other sides."""
ARROW = "arrow"
"""gid of arrows, whose mark in the legend is an arrow."""

# Okabe and Ito's colours without their yellow, which is too light for lines on white, with a marker each.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4d535c")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")

_TITLE, _ROW, _HANDLE = 88, 140, 7  # characters: of a line of the title, a row of the legend, a mark in it

# Rows of a figure in a column, inches: all others are low. A figure above the height of a page is lowered.
_HEIGHTS = {"cost": 1.7, "errors": 1.7} | dict.fromkeys(("scene", *STRATEGIES), 0.9)
_COSTS = 1.6  # of two plans
_SQUARES = {1: 2.6, 2: 1.5, 3: 2.3}  # by their number in a row
_SHARES = {1: (1,), 2: (1, 1), 3: (3, 2, 2)}  # of the width
_LOW, _OUTSIDE, _PAGE, _LEAST = 1.1, 1.1, 9.2, 0.5
_FIXED = 0.4  # share of the height that does not shrink with the width
TALLEST = 248.0 / 25.4
"""Height (inches) of the tallest figure in a column."""
_SMALLER = 1.25  # characters in a column for each at full width: of the sizes of fonts


@dataclass(frozen=True)
class Look:
    """Colour and marker of a controller, the same in all figures."""

    color: str
    marker: str


def look(number: int) -> Look:
    """Return colour and marker of controller `number`; colours repeat after seven, markers after eleven more."""
    again = number // len(_COLORS)
    return Look(_COLORS[number % len(_COLORS)], _MARKERS[(number + again) % len(_MARKERS)])


def mosaic(
    title: str,
    height: float,
    rows: Sequence[Sequence[str]],
    heights: Sequence[float],
    widths: Sequence[float] = COLUMNS,
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with its title and the axes named in `rows`; heights, widths: relative to each other."""
    if is_column():
        rows, heights, widths = _stack(rows)
        factor = max(_LEAST, min(1.0, (_PAGE - _OUTSIDE) / sum(heights)))
        height = factor * sum(heights) + _OUTSIDE
    else:
        height *= min(1.0, _FIXED + (1.0 - _FIXED) * width() / WIDTH)
    figure = new_figure(height)
    figure.set_layout_engine("constrained", h_pad=0.03 if is_narrow() else 0.08, w_pad=0.08)
    figure.suptitle(
        fill(title, fit(_TITLE)), x=0.01, ha="left", fontsize=8 if is_column() else 11, weight="bold"
    )
    return figure, figure.subplot_mosaic(
        [list(row) for row in rows], height_ratios=heights, width_ratios=widths
    )


def _stack(rows: Sequence[Sequence[str]]) -> tuple[list[list[str]], list[float], list[float]]:
    """Return rows, heights (inches) and widths with each part in its own row, squares side by side below."""
    names = dict.fromkeys(
        row[k] for k in range(len(rows[0])) for row in rows if row[k] != "."
    )  # column by column
    squares = [name for kind in ("along", "end") for name in names if kind in name.split()]
    wide = [name for name in names if name not in squares]
    heights = [max(_HEIGHTS.get(word, _LOW) for word in name.split()) for name in wide]
    if "cost" in wide and all(any(name.startswith(each) for name in wide) for each in STRATEGIES):
        heights[wide.index("cost")] = _COSTS
    shares = _SHARES.get(len(squares), (1,))
    last = [name for name, share in zip(squares, shares, strict=False) for _ in range(share)]
    stacked = [*([name] * sum(shares) for name in wide), *([last] if last else [])]
    return stacked, [*heights, *([_SQUARES[len(squares)]] if last else [])], [1.0] * sum(shares)


def fit(characters: int) -> int:
    """Return the number of characters in a line that has this many in a figure of full width."""
    return round(characters * width() / WIDTH * (_SMALLER if is_column() else 1.0))


class _Upright(HandlerLine2D):
    """Draws the mark of a line upright, as the line is in the figure."""

    def create_artists(self, legend: Any, original: Any, *place: Any) -> list[Artist]:
        xdescent, ydescent, width, height, *_ = place
        (line,) = super().create_artists(legend, original, *place)
        middle, above = 0.5 * width - xdescent, 0.25 * height
        ends = [-ydescent - above, height - ydescent + above]
        line.set(xdata=[middle, middle], ydata=ends, markevery=None)  # a marker at each end
        return [line]


class _ArrowHandle(HandlerPatch):
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


_MARKS: dict[str | None, HandlerBase] = {UPRIGHT: _Upright(), ARROW: _ArrowHandle()}


def legend_of(figure: Figure, shown: Iterable[Axes], facts: Sequence[str] = ()) -> None:
    """Name at the foot of the figure all artists of some of its axes, each label once, below lines of facts."""
    named: dict[str, Artist] = {}
    for ax in shown:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    legend(figure, list(named.values()))
    if facts:
        figure.legends[-1].set_title("\n".join(facts))


def legend(figure: Figure, handles: Sequence[Artist], named: Sequence[Artist] = ()) -> None:
    """Name marks at the foot of the figure: the given ones, and `handles` whose label an artist has."""
    drawn = {artist.get_label() for ax in figure.axes for artist in ax.get_children()}
    shown = [*named, *(handle for handle in handles if handle.get_label() in drawn)]
    rows = ceil(sum(len(str(handle.get_label())) + _HANDLE for handle in shown) / fit(_ROW))
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
        columnspacing=1.0 if is_column() else 1.6,
        handlelength=1.4 if is_column() else 1.8,
        handler_map={handle: _MARKS[handle.get_gid()] for handle in shown if handle.get_gid() in _MARKS},
    )


def short(text: str, most: int) -> str:
    """Return a text cut to `most` characters, at a space where there is one."""
    cut = shorten(text, most, placeholder=" …")
    return cut if cut.strip("… ") or not text.strip() else text[: most - 1] + "…"
