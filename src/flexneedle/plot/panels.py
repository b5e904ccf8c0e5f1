"""Panels over the depth of the tip: lines with their names at their ends."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from flexneedle.plot.curves import Floats
from flexneedle.plot.scene import tint_layers
from flexneedle.plot.style import QUIET
from flexneedle.scenario import Scenario

__all__ = ["Line", "draw_panel", "spread_out"]

_GAP = 0.17  # least distance of two names, as a share of the panel's height


@dataclass(frozen=True)
class Line:
    """A curve y (k,) over depth x (k,) with its name and how it is drawn."""

    name: str
    x: Floats
    y: Floats
    color: str
    style: str = "-"
    marker: str = ""


def draw_panel(
    ax: Axes, scenario: Scenario, title: str, lines: Sequence[Line], span: tuple[float, float], least: float
) -> None:
    """Draw lines over depth `span`; the y axis shows at least `least` in all."""
    ax.set_title(title)
    ax.set_xlim(*span)
    tint_layers(ax, scenario, span[1])
    ax.axvline(0.0, color="#8c5a36", linewidth=1.0, zorder=1)
    ax.axhline(0.0, color=QUIET, linewidth=0.6, zorder=1)
    for line in lines:
        ax.plot(line.x, line.y, label=line.name, zorder=3, **_how(line))
    _set_height(ax, lines, least)
    ax.locator_params(axis="y", nbins=4)
    _name_lines(ax, [line for line in lines if len(line.x)])


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
    """Write the name of each line at the right of the panel, level with its end as far as there is room."""
    low, high = ax.get_ylim()
    ends = [(float(line.y[-1]) - low) / (high - low) for line in lines]
    for line, level in zip(lines, spread_out(ends, _GAP), strict=True):
        ax.text(1.015, level, line.name, color=line.color, transform=ax.transAxes, va="center", fontsize=8)


def spread_out(levels: Sequence[float], gap: float) -> list[float]:
    """Return levels moved as little as it takes to keep `gap` between neighbours; the order stays."""
    order = np.argsort(levels, kind="stable")
    step = gap * np.arange(len(order))
    # With the gaps taken off, levels need only rise: the least-squares fit that rises pools its violators.
    pooled = _rising(np.asarray(levels, dtype=float)[order] - step) + step
    moved = np.empty(len(order))
    moved[order] = pooled
    return [float(level) for level in moved]


def _rising(values: Floats) -> Floats:
    """Return the least-squares fit (k,) to values that nowhere falls (pool adjacent violators)."""
    blocks: list[tuple[float, int]] = []
    for value in values.tolist():
        blocks.append((value, 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, m), (b, n) = blocks[-2:]
            blocks[-2:] = [((a * m + b * n) / (m + n), m + n)]
    return np.concatenate([np.full(n, value) for value, n in blocks] or [np.empty(0)])
