"""What the figures of studies share: one look for each controller, panels side by side, axes over decades."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from textwrap import shorten
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from flexneedle.plot.style import BAD, QUIET, WIDTH, axes, new_figure

Floats = NDArray[np.float64]

MOST_PANELS = 9
OVERLAID = 3  # so many controllers in one panel; more get a panel each
MANY = 1500  # dots; more are small and drawn as an image inside the SVG
FAINT = "#c9cbd0"

# Okabe and Ito's colours without their yellow, which is too light for lines on white, with a marker each.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4d535c")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")

_LEFT, _RIGHT, _GAP, _TITLE, _FOOT, _LEGEND = 0.62, 0.15, 0.3, 0.5, 0.45, 0.3  # inches


@dataclass(frozen=True)
class Look:
    """Colour and marker of a controller, the same in all figures."""

    color: str
    marker: str


@dataclass(frozen=True, eq=False)
class Panels:
    """A figure with panels of one size, row by row."""

    figure: Figure
    axes: list[Axes]
    columns: int

    @property
    def lowest(self) -> list[Axes]:
        """The panels with none below."""
        return self.axes[-self.columns :] if self.columns else []

    @property
    def leftmost(self) -> list[Axes]:
        """The panels with none to their left."""
        return self.axes[:: self.columns]


def look(number: int) -> Look:
    """Return the look of controller `number`; colours come again after seven, markers after eleven more."""
    again = number // len(_COLORS)
    return Look(_COLORS[number % len(_COLORS)], _MARKERS[(number + again) % len(_MARKERS)])


def panel_width(count: int, left: float = _LEFT) -> float:
    """Return the width (inches) of each of `count` panels; `left`: what labels take."""
    columns = _columns(count)
    return (WIDTH - left - _RIGHT - (columns - 1) * _GAP) / columns


def panels(count: int, ratio: float, left: float = _LEFT, title: float = _TITLE) -> Panels:
    """Return `count` empty panels, their height `ratio` times their width, with room for a legend.

    left, title: inches for the labels of a row's first panel, and above each panel.
    """
    columns, width = _columns(count), panel_width(count, left)
    height = ratio * width
    figure = new_figure(ceil(count / columns) * (height + title) + _FOOT + _LEGEND)
    places = [divmod(k, columns) for k in range(count)]
    made = [
        axes(figure, left + j * (width + _GAP), title - 0.06 + i * (height + title), width, height)
        for i, j in places
    ]
    return Panels(figure, made, columns)


def head(ax: Axes, title: str, note: str, color: str, alarm: str = "") -> None:
    """Write title and note above a panel, and at the right what must not be overlooked."""
    height, width = (float(size) / float(ax.figure.dpi) for size in (ax.bbox.height, ax.bbox.width))
    most = int((width - 0.06 * len(alarm)) / 0.085)
    above: dict[str, Any] = {"transform": ax.transAxes}
    ax.text(0, 1 + 0.19 / height, short(title, most), color=color, weight="bold", **above)
    ax.text(1, 1 + 0.19 / height, alarm, color=BAD, ha="right", **above)
    ax.text(0, 1 + 0.05 / height, note, color=QUIET, fontsize=7.5, **above)


def legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Name the marks in one row at the foot of the figure."""
    figure.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.05 / float(figure.get_figheight())),
        ncols=len(handles),
        columnspacing=1.6,
        handlelength=1.8,
        borderaxespad=0,
    )


def decades(axis: Axis, values: Iterable[Floats], most: int) -> None:
    """Make an axis logarithmic over all positive values, with up to `most` ticks at plain numbers."""
    known = np.concatenate([np.asarray(array, dtype=float).ravel() for array in values] or [np.empty(0)])
    known = known[np.isfinite(known) & (known > 0.0)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.1, 1.0)
    low, high = low / 1.25, high * 1.25
    ticks = _ticks(low, high, most)
    bounds: Any = {"x": axis.axes.set_xlim, "y": axis.axes.set_ylim}
    scales: Any = {"x": axis.axes.set_xscale, "y": axis.axes.set_yscale}
    name = axis.axis_name  # type: ignore[attr-defined]
    scales[name]("log")
    bounds[name](low, high)
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _columns(count: int) -> int:
    return {1: 1, 2: 2, 4: 2}.get(count, 3)


def _ticks(low: float, high: float, most: int) -> list[float]:
    first, last = floor(log10(low)), ceil(log10(high))
    for digits in ((1, 2, 5), (1, 3), (1,)):
        ticks = [float(f"{digit}e{k}") for k in range(first, last + 1) for digit in digits]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) <= most:
            return inside
    return inside[:: ceil(len(inside) / most)]


def scattered(count: int, alpha: float = 0.75) -> dict[str, Any]:
    """Return how dots are drawn so that `count` of them can be told apart."""
    if count > MANY:
        return {"s": 2.0, "alpha": 0.25, "linewidths": 0.0, "rasterized": True}
    return {"s": 9.0 if count <= 300 else 5.0, "alpha": alpha if count <= 300 else 0.55, "linewidths": 0.0}


def short(text: str, most: int) -> str:
    """Return a text cut to `most` characters, at a space where there is one."""
    cut = shorten(text, most, placeholder=" …")
    return cut if cut.strip("… ") or not text.strip() else text[: most - 1] + "…"
