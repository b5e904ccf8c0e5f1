"""RMSE over the distance from sensor to field generator, with its limit."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flexneedle.figures.layout import look, short
from flexneedle.figures.style import new_figure, styled

_LINE = 30  # characters per line of the legend
_HIGH, _ROW = 3.8, 0.16  # inches: least height of the figure; height of a line of the legend

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DistanceLine:
    """A sensor in an environment: distance and RMSE (k,) of the bins, limit of the RMSE (mm); note for the legend."""

    name: str
    distance: Floats
    rmse: Floats
    limit: float | None
    note: str


def draw_distance(lines: Sequence[DistanceLine]) -> Figure:
    """Return the figure with a line for each sensor and environment; its limit is dashed in the same colour."""
    labels = [f"{short(line.name, _LINE)}\n{fill(line.note, _LINE)}" for line in lines]
    limits = dict.fromkeys(line.limit for line in lines if line.limit is not None)
    rows = sum(label.count("\n") + 2 for label in labels) + 2 * len(limits)
    with styled():
        figure = new_figure(max(_HIGH, _ROW * rows))
        ax = figure.subplots()
        for number, (line, label) in enumerate(zip(lines, labels, strict=True)):
            own = look(number)
            ax.plot(line.distance, line.rmse, color=own.color, marker=own.marker, markersize=4.5, label=label)
        for limit in limits:
            color = look(next(k for k, line in enumerate(lines) if line.limit == limit)).color
            ax.axhline(limit, color=color, lw=0.9, ls=(0, (4, 2)), zorder=1, label=f"limit {limit:g} mm")
        ax.set_ylim(bottom=0.0)
        ax.set(title="RMSE by distance", xlabel="distance from the field generator (mm)", ylabel="RMSE (mm)")
        figure.legend(loc="outside right upper", labelspacing=0.9)
    return figure
