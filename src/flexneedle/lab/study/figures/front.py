"""The front of the controllers: true error against the peak of the tissue energy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures.layout import Floats, Look, legend
from flexneedle.figures.style import apply_style
from flexneedle.lab.study.figures.panels import (
    LIMIT,
    Panel,
    choose_dots,
    decades,
    limit_line,
    panels,
    ticks_of,
)
from flexneedle.lab.study.figures.samples import LEAST

_LARGE: Any = {"markersize": 7, "markeredgecolor": "white"}


@dataclass(frozen=True, eq=False)
class FrontSample:
    """True errors (mm) and peaks of the tissue energy (E₁) of finished insertions of a controller, each (k,)."""

    name: str
    look: Look
    errors: Floats
    peaks: Floats


def draw_front(shown: Sequence[Panel[Sequence[FrontSample]]]) -> Figure:
    """Return the figure: one panel each, with a dot for each insertion and the medians with the quartiles."""
    samples = [sample for panel in shown for sample in panel.content]
    looks = {sample.name: sample.look for sample in samples}
    dots = choose_dots(sum(len(sample.errors) for sample in samples) // len(shown), 0.4)
    with apply_style():
        figure, axes = panels(
            shown, 4.0 if len(shown) == 1 else 3.2, "peak tissue energy (E₁)", "true error (mm)"
        )
        for ax, panel in zip(axes, shown, strict=True):
            decades(ax.xaxis, [sample.peaks for sample in samples], ticks_of(len(shown)))
            decades(ax.yaxis, [np.maximum(sample.errors, LEAST) for sample in samples], 6)
            limit_line(ax, vertical=False)
            for sample in panel.content:
                _draw(ax, sample, dots)
        named = [
            Line2D([], [], marker=look.marker, color=look.color, linewidth=1.6, label=name, **_LARGE)
            for name, look in looks.items()
        ]
        legend(figure, [Line2D([], [], **LIMIT)], named)
    return figure


def _draw(ax: Axes, sample: FrontSample, dots: dict[str, Any]) -> None:
    errors, color = np.maximum(sample.errors, LEAST), sample.look.color
    ax.scatter(sample.peaks, errors, color=color, zorder=2, **dots)
    (left, peak, right), (low, error, high) = (
        np.quantile(values, (0.25, 0.5, 0.75)) for values in (sample.peaks, errors)
    )
    ax.plot([left, right], [error, error], color=color, linewidth=1.6, zorder=3, label="quartiles")
    ax.plot([peak, peak], [low, high], color=color, linewidth=1.6, zorder=3, label="quartiles")
    ax.plot([peak], [error], sample.look.marker, color=color, zorder=4, label=sample.name, **_LARGE)
