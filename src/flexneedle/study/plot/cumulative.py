"""Distributions of the true error: the share of insertions that end nearer, a line for each controller."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.plot.layout import FAINT, Floats, Look, decades, head, legend, panels
from flexneedle.plot.style import INK, TARGET, styled

_LEAST = 1e-3  # mm; smaller errors are drawn here


@dataclass(frozen=True, eq=False)
class ShareRow:
    """True errors (k,) (mm) of the finished ones among `count` insertions."""

    name: str
    look: Look
    errors: Floats
    count: int


@dataclass(frozen=True, eq=False)
class SharePanel:
    """Lines under one title."""

    title: str
    note: str
    rows: Sequence[ShareRow]


def share_figure(shown: Sequence[SharePanel]) -> Figure:
    """Return the figure: a panel each; a line that does not reach 100 % is short of the insertions not finished."""
    with styled():
        made = panels(len(shown), 0.6 if len(shown) == 1 else 0.85)
        errors = [np.maximum(row.errors, _LEAST) for panel in shown for row in panel.rows]
        for ax, panel in zip(made.axes, shown, strict=True):
            decades(ax.xaxis, errors, {1: 9, 2: 7}.get(made.columns, 5))
            _draw(ax, panel)
            head(ax, panel.title, panel.note, INK)
            ax.tick_params(labelleft=ax in made.leftmost, labelbottom=ax in made.lowest)
        for ax in made.lowest:
            ax.set_xlabel("true error (mm)", labelpad=1.0)
        for ax in made.leftmost:
            ax.set_ylabel("insertions (%)")
        legend(made.figure, _handles(shown))
    return made.figure


def _draw(ax: Axes, panel: SharePanel) -> None:
    ax.set_ylim(0.0, 102.0)
    ax.grid(axis="y", color=FAINT, linewidth=0.4)
    ax.axvline(1.0, color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), zorder=1)
    end = ax.get_xlim()[1]
    for row in panel.rows:
        ordered = np.sort(np.maximum(row.errors, _LEAST))
        share = 100.0 * np.arange(len(ordered) + 1) / max(row.count, 1)
        places = np.append(ordered, end)
        shares = np.append(share[1:], share[-1])
        ax.step(places, shares, where="post", color=row.look.color, linewidth=1.4, label=row.name)


def _handles(shown: Sequence[SharePanel]) -> list[Line2D]:
    named = {row.name: row.look.color for panel in shown for row in panel.rows}
    lines = [Line2D([], [], color=color, linewidth=1.6, label=name) for name, color in named.items()]
    return [*lines, Line2D([], [], color=TARGET, linewidth=1.0, linestyle=(0, (4, 2)), label="1 mm")]
