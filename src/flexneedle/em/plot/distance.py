"""RMSE over the distance from sensor to field generator, with the limit that it is to keep."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flexneedle.plot.layout import look, short
from flexneedle.plot.style import WIDTH, axes, new_figure, styled

_LEFT, _RIGHT, _TOP, _FOOT, _HIGH = 0.6, 2.95, 0.3, 0.5, 3.0  # inches
_NOTE, _NAME = 30, 30  # characters in a line beside the panel
_ROW = 0.145  # inches of a line beside the panel

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DistanceLine:
    """A sensor in an environment: distance and RMSE (k,) of each bin (mm), the limit of the RMSE, the verdict."""

    name: str
    distance: Floats
    rmse: Floats
    limit: float | None
    note: str


def distance_figure(lines: Sequence[DistanceLine]) -> Figure:
    """Return the figure with a line for each sensor and environment, and its limit dashed in the same colour."""
    with styled():
        labels = [f"{short(line.name, _NAME)}\n{fill(line.note, _NOTE)}" for line in lines]
        rows = sum(label.count("\n") + 2 for label in labels)
        high = max(_HIGH, _ROW * rows - _FOOT)  # the legend may be as long as the figure
        figure = new_figure(_TOP + high + _FOOT)
        ax = axes(figure, _LEFT, _TOP, WIDTH - _LEFT - _RIGHT, high)
        for number, (line, label) in enumerate(zip(lines, labels, strict=True)):
            own = look(number)
            ax.plot(line.distance, line.rmse, color=own.color, marker=own.marker, markersize=4.5, label=label)
        for limit in dict.fromkeys(line.limit for line in lines if line.limit is not None):
            number = next(k for k, line in enumerate(lines) if line.limit == limit)
            ax.axhline(limit, color=look(number).color, linewidth=0.9, linestyle=(0, (4, 2)), zorder=1)
            beside: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center", "fontsize": 8}
            ax.text(1.01, limit, f"limit {limit:g}", color=look(number).color, **beside)
        ax.set_ylim(bottom=0.0)
        ax.set_title("RMSE by distance")
        ax.set_xlabel("distance from the field generator (mm)")
        ax.set_ylabel("RMSE (mm)")
        ax.legend(loc="upper left", bbox_to_anchor=(1.12, 1.02), labelspacing=0.9)
    return figure
