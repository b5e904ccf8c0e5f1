"""What a threshold of the indicator tells apart: detected distortion over false alarms, and both over the threshold."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from flexneedle.plot.layout import look, short
from flexneedle.plot.style import QUIET, WIDTH, axes, new_figure, styled

_SIDE, _LEFT, _RIGHT, _GAP, _TOP, _FOOT = 3.4, 0.75, 0.2, 0.85, 0.3, 0.55  # inches
_ENTRY = 0.185  # inches of a legend
_NAME = 24  # characters

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RocLine:
    """A sensor: shares (k,) of grid points above each threshold in an ideal and a noisy environment, and their values.

    environments: the names of these two.
    chosen: these shares (false alarms, detected) at the threshold in use, told in words by `note`.
    """

    sensor: str
    environments: tuple[str, str]
    false_alarms: Floats
    detected: Floats
    values: tuple[Floats, Floats]
    threshold: float
    chosen: tuple[float, float]
    note: str


def roc_figure(lines: Sequence[RocLine]) -> Figure:
    """Return the figure: the ROC of each sensor, and beside it the shares above each threshold; legends below."""
    with styled():
        figure = new_figure(_TOP + _SIDE + _FOOT + _ENTRY * (2 * len(lines) + 0.5))
        _draw_roc(axes(figure, _LEFT, _TOP, _SIDE, _SIDE), lines)
        left = _LEFT + _SIDE + _GAP
        _draw_shares(axes(figure, left, _TOP, WIDTH - left - _RIGHT, _SIDE), lines)
    return figure


def _draw_roc(ax: Axes, lines: Sequence[RocLine]) -> None:
    ax.plot([0, 1], [0, 1], color=QUIET, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
    for number, line in enumerate(lines):
        own = look(number)
        ax.plot(
            line.false_alarms,
            line.detected,
            color=own.color,
            linestyle=_dashes(number),
            zorder=3,
            clip_on=False,
        )
        mark: dict[str, Any] = {
            "color": own.color,
            "markersize": 7,
            "markeredgecolor": "white",
            "clip_on": False,
        }
        ax.plot(*line.chosen, own.marker, label=f"{short(line.sensor, _NAME)}: {line.note}", zorder=4, **mark)
    ideal, noisy = (short(name, 30) for name in lines[0].environments)
    _share_axis(ax, "y", f"detected: grid points above ({noisy})")
    _share_axis(ax, "x", f"false alarms: grid points above ({ideal})")
    ax.set_title("Each threshold of the indicator")
    _legend_below(ax)


def _draw_shares(ax: Axes, lines: Sequence[RocLine]) -> None:
    for number, line in enumerate(lines):
        color = look(number).color
        for values, style, name in zip(line.values, ((0, (1, 1)), "-"), line.environments, strict=True):
            above = 1.0 - np.arange(len(values) + 1) / len(values)
            ends = np.concatenate([[0.0], np.sort(values)])
            label = f"{short(line.sensor, _NAME)}, {short(name, _NAME)}"
            ax.step(ends, above, where="post", color=color, linestyle=style, label=label, zorder=3)
        ax.axvline(line.threshold, color=color, linewidth=0.9, linestyle=(0, (4, 2)), zorder=1)
    ax.set_xlim(left=0.0)
    ax.set_xlabel("threshold of the indicator (dashed: in use)")
    _share_axis(ax, "y", "grid points above")
    ax.set_title("Above the threshold")
    _legend_below(ax)


def _legend_below(ax: Axes) -> None:
    """Below the axis, however many lines there are: inside they would hide what they name."""
    ax.legend(
        loc="upper left",
        bbox_to_anchor=(-0.02, -_FOOT / _SIDE),
        borderaxespad=0.0,
        borderpad=0.0,
        fontsize=7.5,
    )


def _share_axis(ax: Axes, name: str, label: str) -> None:
    getattr(ax, f"set_{name}lim")(0.0, 1.0)
    getattr(ax, f"set_{name}label")(label)
    getattr(ax, f"{name}axis").set_major_formatter(PercentFormatter(1.0, symbol=" %"))


def _dashes(number: int) -> Any:
    return (0, (6, 1.5 * number)) if number else "-"
