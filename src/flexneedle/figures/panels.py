"""Panels over the depth of the tip or over time: lines with their names at their ends."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from flexneedle.figures.scene import tint_layers
from flexneedle.figures.style import BAD, QUIET
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_GAP = 0.17  # least distance of two names, as a share of the panel's height
_VISIBLE = 0.008  # least extent of a visible line, as a share of the panel's width


@dataclass(frozen=True)
class Line:
    """A curve y (k,) over depth or time x (k,) with its name and how it is drawn."""

    name: str
    x: Floats
    y: Floats
    color: str
    style: str = "-"
    marker: str = ""


def draw_panels(
    panels: Sequence[Axes],
    scenario: Scenario,
    contents: Sequence[tuple[str, Sequence[Line], float]],
    span: tuple[float, float],
) -> None:
    """Draw panels one above the other over depth `span`: title, lines, and the least extent of the y axis of each."""
    for ax, (title, lines, least) in zip(panels, contents, strict=True):
        draw_panel(ax, scenario, title, lines, span, least)
        ax.tick_params(labelbottom=ax is panels[-1])
    panels[-1].set_xlabel("depth of the tip (mm)", labelpad=1.0)


def draw_panel(
    ax: Axes, scenario: Scenario, title: str, lines: Sequence[Line], span: tuple[float, float], least: float
) -> None:
    """Draw lines over depth `span`; the y axis spans at least `least`.

    A line without extent is a dot with its name beside it; a panel without lines gives the reason.
    """
    ax.set_title(title)
    ax.set_xlim(*span)
    tint_layers(ax, scenario, span[1])
    ax.axvline(0.0, color="#8c5a36", linewidth=1.0, zorder=1)
    ax.axhline(0.0, color=QUIET, linewidth=0.6, zorder=1)
    for line in lines:
        ax.plot(line.x, line.y, label=line.name, zorder=3, **_how(line))
    _set_height(ax, lines, least)
    ax.locator_params(axis="y", nbins=4)
    known = [line for line in lines if len(line.x)]
    dots = [line for line in known if _is_dot(line, span[1] - span[0])]
    _name_lines(ax, [line for line in known if line not in dots])
    for line in dots:
        _draw_dot(ax, line)
    if len(dots) == len(known):
        ax.set_title(_why_empty(lines), loc="right", color=QUIET, fontsize=8, weight="normal")


def draw_timeline(
    ax: Axes,
    title: str,
    lines: Sequence[Line],
    span: tuple[float, float],
    held: Sequence[tuple[float, float]],
) -> None:
    """Draw lines over time `span` (s) on an axis from 0, and shade the times `held` (begin, end)."""
    ax.set_title(title)
    ax.set_xlim(*span)
    for begin, end in held:
        ax.axvspan(begin, end, color=BAD, linewidth=0.5, alpha=0.2, zorder=0, label="held")
    for line in lines:
        ax.plot(line.x, line.y, label=line.name, zorder=3, **_how(line))
    ax.set_ylim(0.0, 1.15 * max(float(np.nanmax(line.y)) for line in lines))
    ax.locator_params(axis="y", nbins=4)
    _name_lines(ax, lines)


def _why_empty(lines: Sequence[Line]) -> str:
    """Reason why a panel shows no line: the tip hardly moved, or there is no data."""
    unknown = [line.name for line in lines if not len(line.x)]
    still = ["the tip hardly moved"] if len(unknown) < len(lines) else []
    return "; ".join(still + ([f"no data: {', '.join(unknown)}"] if unknown else []))


def _is_dot(line: Line, width: float) -> bool:
    return not line.marker and bool(np.ptp(line.x) < _VISIBLE * width)


def _draw_dot(ax: Axes, line: Line) -> None:
    """Draw the end of a line as a dot, with its name above or below it, where there is more room."""
    end = (float(line.x[-1]), float(line.y[-1]))
    how: dict[str, Any] = {"color": line.color, "markersize": 3.5, "markeredgewidth": 0.0, "clip_on": False}
    ax.plot(*end, "o", zorder=3.5, label=line.name, **how)
    low, high = ax.get_ylim()
    shift, align = (8, "bottom") if end[1] < (low + high) / 2 else (-8, "top")
    name: dict[str, Any] = {"color": line.color, "fontsize": 8, "va": align, "zorder": 6}
    name["path_effects"] = [withStroke(linewidth=2.5, foreground="white")]  # a line may pass behind it
    ax.annotate(line.name, end, (3, shift), textcoords="offset points", **name)


def _how(line: Line) -> dict[str, Any]:
    if line.marker:
        return {"color": line.color, "linestyle": "none", "marker": line.marker, "markersize": 2.4}
    return {"color": line.color, "linestyle": line.style}


def _set_height(ax: Axes, lines: Sequence[Line], least: float) -> None:
    values = np.concatenate([[0.0], *(line.y for line in lines)])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    pad = max(0.1 * (high - low), (least - (high - low)) / 2)
    bottom = -0.04 * least if low == 0.0 and high > 0.0 else low - pad
    ax.set_ylim(bottom, high + pad)


def _name_lines(ax: Axes, lines: Sequence[Line]) -> None:
    """Write the name of each line at the right of the panel, at the height of its end as far as there is room."""
    low, high = ax.get_ylim()
    ends = [(float(line.y[-1]) - low) / (high - low) for line in lines]
    for line, level in zip(lines, spread_out(ends, _GAP), strict=True):
        ax.text(1.015, level, line.name, color=line.color, transform=ax.transAxes, va="center", fontsize=8)


def spread_out(levels: Sequence[float], gap: float) -> list[float]:
    """Return the levels nearest to these with `gap` between neighbours, in the same order."""
    from scipy.optimize import isotonic_regression

    if len(levels) == 0:
        return []
    order = np.argsort(levels, kind="stable")
    step = gap * np.arange(len(order))
    # Less the gaps, the levels need only not fall.
    pooled = isotonic_regression(np.asarray(levels, dtype=float)[order] - step).x + step
    moved = np.empty(len(order))
    moved[order] = pooled
    return [float(level) for level in moved]
