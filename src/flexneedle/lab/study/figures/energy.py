"""Strain energy of the tissue against the true error, one dot per insertion."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import (
    FAINT,
    LIMIT,
    Floats,
    Panel,
    decades,
    legend,
    limit_line,
    panels,
    scattered,
    ticks_of,
)
from flexneedle.figures.style import INK, QUIET, styled


def energy_figure(shown: Sequence[Panel[Floats]]) -> Figure:
    """Return the figure of energies (mJ) and true errors (mm) (n, 2) of finished insertions, one panel each.

    Dots of the other panels are grey; lines mark the medians.
    """
    with styled():
        label = "final strain energy of the tissue (mJ)"
        figure, axes = panels(shown, 4.6 if len(shown) == 1 else 2.8, label, "true error (mm)")
        for ax, panel in zip(axes, shown, strict=True):
            decades(ax.xaxis, [other.content[:, 0] for other in shown], ticks_of(len(shown)))
            decades(ax.yaxis, [other.content[:, 1] for other in shown], 6)
            _draw(ax, panel, [other for other in shown if other is not panel])
        legend(figure, _handles())
    return figure


def _draw(ax: Axes, panel: Panel[Floats], others: Sequence[Panel[Floats]]) -> None:
    for other in others:
        dots = {**scattered(len(other.content)), "alpha": 0.5, "rasterized": True}
        ax.scatter(*other.content.T, color=FAINT, zorder=1, label="other panels", **dots)
    dots = scattered(len(panel.content))
    ax.scatter(*panel.content.T, color=panel.color, zorder=3, label="one insertion", **dots)
    if len(panel.content):
        energy, error = np.median(panel.content, axis=0).tolist()
        ax.axvline(energy, color=INK, linewidth=0.9, zorder=4, label="medians")
        ax.axhline(error, color=INK, linewidth=0.9, zorder=4, label="medians")
    limit_line(ax, vertical=False)


def _handles() -> list[Line2D]:
    dot: dict[str, Any] = {"marker": "o", "markersize": 3.5, "linestyle": "none"}
    return [
        Line2D([], [], color=QUIET, label="one insertion", **dot),
        Line2D([], [], color=FAINT, label="other panels", **dot),
        Line2D([], [], color=INK, linewidth=0.9, label="medians"),
        Line2D([], [], **LIMIT),
    ]
