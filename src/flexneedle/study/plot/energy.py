"""Energy stored in the tissue against the true error, an insertion a dot."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.plot.layout import FAINT, Floats, Look, decades, head, legend, panels, scattered
from flexneedle.plot.style import INK, QUIET, TARGET, styled


@dataclass(frozen=True, eq=False)
class EnergyPanel:
    """Energies (mJ) and true errors (mm) (n,) of the finished insertions of a controller."""

    title: str
    note: str
    look: Look
    energy: Floats
    errors: Floats


def energy_figure(shown: Sequence[EnergyPanel]) -> Figure:
    """Return the figure: a panel for each controller, the others behind it in grey, medians as a cross of lines."""
    with styled():
        made = panels(len(shown), 0.5 if len(shown) == 1 else 0.75)
        ticks = {1: 9, 2: 7}.get(made.columns, 5)
        for ax, panel in zip(made.axes, shown, strict=True):
            decades(ax.xaxis, [other.energy for other in shown], ticks)
            decades(ax.yaxis, [other.errors for other in shown], 6)
            _draw(ax, panel, [other for other in shown if other is not panel])
            head(ax, panel.title, panel.note, panel.look.color)
            ax.tick_params(labelleft=ax in made.leftmost, labelbottom=ax in made.lowest)
        for ax in made.lowest:
            ax.set_xlabel("energy in the tissue at the end (mJ)", labelpad=1.0)
        for ax in made.leftmost:
            ax.set_ylabel("true error (mm)")
        legend(made.figure, _handles(len(shown) > 1, made.axes[0]))
    return made.figure


def _draw(ax: Axes, panel: EnergyPanel, others: Sequence[EnergyPanel]) -> None:
    for other in others:
        dots = {**scattered(len(other.errors)), "alpha": 0.5, "rasterized": True}
        ax.scatter(other.energy, other.errors, color=FAINT, zorder=1, label="others", **dots)
    style = scattered(len(panel.errors))
    ax.scatter(panel.energy, panel.errors, color=panel.look.color, zorder=3, label="own", **style)
    if len(panel.errors):
        ax.axvline(float(np.median(panel.energy)), color=INK, linewidth=0.9, zorder=4, label="median")
        ax.axhline(float(np.median(panel.errors)), color=INK, linewidth=0.9, zorder=4, label="median")
    ax.axhline(1.0, color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), zorder=2)


def _handles(others: bool, ax: Axes) -> list[Line2D]:
    low, high = ax.get_ylim()
    limit = Line2D([], [], color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), label="1 mm")
    dot: dict[str, Any] = {"marker": "o", "markersize": 3.5, "linestyle": "none"}
    grey = [Line2D([], [], color=FAINT, label="of the other panels", **dot)] if others else []
    return [
        Line2D([], [], color=QUIET, label="an insertion", **dot),
        *grey,
        Line2D([], [], color=INK, linewidth=0.9, label="medians"),
        *([limit] if low < 1.0 < high else []),
    ]
