"""Panels over the depth of the tip or over time: lines that end in a dot, with their names beside the panel."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from flexneedle.figures.scene import tint_layers
from flexneedle.figures.style import BAD, BOX, QUIET, is_narrow, small
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_ANGLES = (15, 30, 45, 90, 180, 360, 720, 1440)  # distances of ticks at angles (degrees)
_TICKS = 4
_POINTS = ("o", "x")  # styles of lines that are points
_MARK = 30  # characters of a line of the text of a mark, which fits in half a panel
_ROW, _HANDLE = 56, 6  # characters: of a line of names above a panel, of the mark of a name
ENERGY = "Energy stored in the tissue (µJ), ◇ peak"
_FEW = 4  # names that fit beside a panel
_VISIBLE = 0.008  # least extent of a visible line, as a share of the panel's width


@dataclass(frozen=True)
class Line:
    """A curve y (k,) over depth or time x (k,) with its name and how it is drawn.

    style "o" or "x": as points. A name that begins with _ is not shown.
    """

    name: str
    x: Floats
    y: Floats
    color: str
    style: str = "-"


@dataclass(frozen=True)
class Band:
    """A band from `low` to `high` (k,) over depth x (k,) with its name."""

    name: str
    x: Floats
    low: Floats
    high: Floats
    color: str


@dataclass(frozen=True)
class Mark:
    """An event at a depth, with its text."""

    x: float
    text: str
    color: str


@dataclass(frozen=True)
class DepthPanel:
    """Lines over the depth of the tip; the y axis spans at least `least`.

    angles: the lines are angles in degrees; peaks: the largest value of each line is marked; log: the y axis is
    logarithmic, begins at `least` or above, and has a line at 1.
    """

    title: str
    lines: Sequence[Line]
    least: float
    angles: bool = False
    peaks: bool = False
    bands: Sequence[Band] = ()
    marks: Sequence[Mark] = ()
    log: bool = False

    @property
    def named(self) -> int:
        """Number of lines with a name."""
        return sum(not line.name.startswith("_") for line in self.lines)


def draw_depths(axes: Sequence[Axes], scenario: Scenario, shown: Sequence[DepthPanel]) -> None:
    """Draw panels one below the other, over the depth that their lines span; the lowest has the axis.

    A depth that is not known (NaN) is not drawn; one at least must be known.
    """
    depth = np.concatenate([line.x for panel in shown for line in panel.lines])
    depth = depth[np.isfinite(depth)]
    room = 0.01 * float(np.ptp(depth))
    named: list[tuple[str, str]] = []
    for ax, panel in zip(axes, shown, strict=True):
        ax.set_xlim(depth.min() - room, depth.max() + room)
        _draw_panel(ax, scenario, panel)
        names = [(line.name, line.color) for line in panel.lines]
        legend = ax.get_legend()
        if is_narrow() and names == named and legend is not None:  # once is enough
            legend.remove()
            ax.set_title(ax.get_title(loc="left"), pad=4.0)
        named = names
        ax.tick_params(labelbottom=ax is axes[-1])
    axes[-1].set_xlabel("depth of the tip (mm)")


def _draw_panel(ax: Axes, scenario: Scenario, panel: DepthPanel) -> None:
    """Draw a panel, each line with a dot at its end; a panel without visible lines gives the reason."""
    tint_layers(ax, scenario)
    ax.axvline(0.0, color="#8c5a36", linewidth=1.0, zorder=1)
    if panel.log:
        ax.set_yscale("log")
    ax.axhline(1.0 if panel.log else 0.0, color=QUIET, linewidth=0.6, zorder=1)
    for band in panel.bands:
        how: dict[str, Any] = {"color": band.color, "alpha": 0.25, "linewidth": 0.0}
        ax.fill_between(band.x, band.low, band.high, label=band.name, **how)
    _draw_lines(ax, panel.title, panel.lines)
    for line in panel.lines:
        if len(line.x) and line.style not in _POINTS:
            ax.plot(line.x[-1], line.y[-1], "o", color=line.color, markersize=3, zorder=3.5)
        if len(line.x) and panel.peaks:
            k = int(np.argmax(np.nan_to_num(line.y)))
            ax.plot(
                line.x[k], line.y[k], "D", color=line.color, markerfacecolor="white", markersize=4, zorder=3.6
            )
    _set_height(ax, panel)
    _draw_marks(ax, panel.marks)
    if not any(_is_visible(line, float(np.ptp(ax.get_xlim()))) for line in panel.lines):
        middle: dict[str, Any] = {"transform": ax.transAxes, "ha": "center", "va": "center"}
        middle["bbox"] = {"facecolor": "white", "linewidth": 0.0, "pad": 1.5}
        ax.text(0.5, 0.75, _why_empty(panel.lines), color=QUIET, fontsize=small(), **middle)


def _draw_marks(ax: Axes, marks: Sequence[Mark]) -> None:
    """Draw a vertical line at each mark, its text beside it, towards the middle."""
    middle, above = np.mean(ax.get_xlim()), 0
    for mark in marks:
        rows = textwrap.wrap(mark.text, _MARK)
        ax.axvline(mark.x, color=mark.color, linewidth=1.0, zorder=2)
        side = -1 if mark.x > middle else 1
        how: dict[str, Any] = {
            "xytext": (3 * side, -9 * above - 2),
            "textcoords": "offset points",
            "zorder": 4,
        }
        how |= {"va": "top", "ha": "left" if side > 0 else "right", "color": mark.color, "fontsize": small()}
        at = (mark.x, 1.0)
        made = ax.annotate("\n".join(rows), at, xycoords=ax.get_xaxis_transform(), bbox=BOX, **how)
        above += len(rows)
        made.set_in_layout(False)  # a long one would make the panels narrow


def draw_timeline(
    ax: Axes, title: str, lines: Sequence[Line], held: Sequence[tuple[float, float]], shade: str
) -> None:
    """Draw lines over time (s) on an axis from 0, and shade the times `held` (begin, end), named `shade`."""
    for begin, end in held:
        ax.axvspan(begin, end, color=BAD, linewidth=0.5, alpha=0.2, zorder=0, label=shade)
        shade = ""  # named once
    _draw_lines(ax, title, lines)
    ax.set(ylim=(0.0, 1.15 * max(float(np.nanmax(line.y)) for line in lines)), xlabel="time (s)")
    ax.margins(x=0.01)


def _draw_lines(ax: Axes, title: str, lines: Sequence[Line]) -> None:
    drawn = [line for line in lines if len(line.x)]
    for line in drawn:
        ax.plot(line.x, line.y, line.style, color=line.color, markersize=2.4, zorder=3, label=line.name)
    ax.set_title(title)
    if ax.get_yscale() == "linear":
        ax.locator_params(axis="y", nbins=3 if is_narrow() else 4)
    if drawn and is_narrow():
        _name_above(ax)
    elif drawn:
        many = len(ax.get_legend_handles_labels()[1]) > _FEW
        dense = {"labelspacing": 0.2, "borderaxespad": 0.0} if many else {}
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1.4, **dense)


def _name_above(ax: Axes) -> None:
    """Name the lines of a panel of a narrow figure between title and panel."""
    names = ax.get_legend_handles_labels()[1]
    columns = len(names) if sum(len(name) + _HANDLE for name in names) <= _ROW else 2
    rows = -(-len(names) // columns)
    beside: dict[str, Any] = {
        "handlelength": 1.4,
        "columnspacing": 1.0,
        "borderaxespad": 0.0,
        "borderpad": 0.2,
    }
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, **beside)
    ax.set_title(ax.get_title(loc="left"), pad=4.0 + 10.5 * rows)


def _is_visible(line: Line, width: float) -> bool:
    return len(line.x) > 0 and bool(line.style in _POINTS or np.ptp(line.x) >= _VISIBLE * width)


def _why_empty(lines: Sequence[Line]) -> str:
    """Return the reason why a panel shows no line: the tip hardly moved, or there is no data."""
    unknown = [line.name for line in lines if not len(line.x)]
    still = ["the tip hardly moved"] if len(unknown) < len(lines) else []
    return "; ".join(still + ([f"no data: {', '.join(unknown)}"] if unknown else []))


def _set_height(ax: Axes, panel: DepthPanel) -> None:
    if panel.log:
        ax.yaxis.set_major_formatter("{x:g}")
        values = np.concatenate([[1.0], *(line.y for line in panel.lines)])
        positive = values[values > 0.0]
        ax.set_ylim(0.7 * max(panel.least, float(positive.min())), 1.6 * float(positive.max()))
        return
    bands = (side for band in panel.bands for side in (band.low, band.high))
    values = np.concatenate([[0.0], *(line.y for line in panel.lines), *bands])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    pad = max(0.1 * (high - low), (panel.least - (high - low)) / 2)
    bottom = -0.04 * panel.least if low == 0.0 and high > 0.0 else low - pad
    ax.set_ylim(bottom, high + pad)
    if panel.angles:
        span = high + pad - bottom
        ax.yaxis.set_major_locator(
            MultipleLocator(next((a for a in _ANGLES if a * _TICKS >= span), _ANGLES[-1]))
        )
