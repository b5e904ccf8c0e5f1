"""Cumulative distributions of the true error, one line per controller."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import legend
from flexneedle.figures.style import apply_style
from flexneedle.lab.study.figures.panels import FAINT, LIMIT, Panel, decades, limit_line, panels, ticks_of
from flexneedle.lab.study.figures.samples import ErrorSample


def draw_shares(shown: Sequence[Panel[Sequence[ErrorSample]]]) -> Figure:
    """Return the figure: one panel each; a line ends below 100 % by the share of unfinished insertions."""
    samples = [sample for panel in shown for sample in panel.content]
    colors = {sample.name: sample.look.color for sample in samples}
    with apply_style():
        figure, axes = panels(shown, 5.0 if len(shown) == 1 else 3.2, "true error (mm)", "insertions (%)")
        for ax, panel in zip(axes, shown, strict=True):
            decades(ax.xaxis, [sample.drawn for sample in samples], ticks_of(len(shown)))
            _draw(ax, panel.content)
        named = [Line2D([], [], color=color, linewidth=1.6, label=name) for name, color in colors.items()]
        legend(figure, [Line2D([], [], **LIMIT)], named)
    return figure


def _draw(ax: Axes, samples: Sequence[ErrorSample]) -> None:
    ax.set_ylim(0.0, 102.0)
    ax.grid(axis="y", color=FAINT, linewidth=0.4)
    limit_line(ax, vertical=True)
    for sample in samples:
        errors = np.append(np.sort(sample.drawn), ax.get_xlim()[1])
        share = 100.0 * np.arange(1, len(errors) + 1) / max(sample.count, 1)
        share[-1] = 100.0 * len(sample.errors) / max(sample.count, 1)
        ax.step(errors, share, where="post", color=sample.look.color, linewidth=1.4, label=sample.name)
