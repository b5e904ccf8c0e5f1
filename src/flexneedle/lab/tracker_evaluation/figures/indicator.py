"""Error over the distortion indicator, like the paper's figure of indicator values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from flexneedle.figures.layout import short
from flexneedle.figures.style import ESTIMATE, INK, QUIET, TARGET, TRUE, apply_style, new_figure

FAR, CUT = 2.0, 1.2
"""If the largest indicator exceeds FAR times the 95th percentile, the axis ends at CUT times that percentile and a
note gives the number of points beyond it."""
_HIGH = 4.3  # inches
_STYLES = ((ESTIMATE, "o"), (TRUE, "^"))

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlottedPoints:
    """Mean indicator and error (mm) (n,) at the grid points of one environment, and the label of its fit."""

    name: str
    indicator: Floats
    error: Floats
    fit: str


@dataclass(frozen=True, eq=False)
class IndicatorPanel:
    """One sensor: points of up to two environments, constant fit (mean, sd), line (slope, intercept), threshold."""

    sensor: str
    ideal: PlottedPoints | None
    noisy: PlottedPoints | None
    constant: tuple[float, float] | None
    line: tuple[float, float] | None
    threshold: float | None


def draw_indicator(panels: Sequence[IndicatorPanel], more: int = 0) -> Figure:
    """Return the figure with a panel for each sensor, side by side; more: number of sensors not shown."""
    with apply_style():
        figure = new_figure(_HIGH)
        for ax, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _draw(ax, panel)
        figure.axes[0].set_ylabel("error of the mean position (mm)")
        if more:
            plural = "s" if more > 1 else ""
            figure.supxlabel(f"{more} more sensor{plural} not shown", color=QUIET, fontsize=8)
    return figure


def _draw(ax: Axes, panel: IndicatorPanel) -> None:
    pairs = zip((panel.ideal, panel.noisy), _STYLES, strict=True)
    widest = _widest(panel)
    handles = [_scatter(ax, shown, color, marker, widest) for shown, (color, marker) in pairs if shown]
    ax.set_xlim(0.0, widest)
    ax.set_ylim(0.0, _highest(panel, widest))
    if panel.constant:
        _draw_constant(ax, *panel.constant, panel, widest)
    if panel.line and panel.noisy and np.isfinite(panel.line[0]):
        _draw_line(ax, *panel.line, panel.noisy.indicator, widest)
    if panel.threshold is not None:
        handles.append(_draw_threshold(ax, panel.threshold))
    ax.set_title(panel.sensor)
    ax.set_xlabel("mean indicator I at a grid point")
    legend = ax.legend(handles=handles, loc="upper left", borderaxespad=0.2, frameon=True, framealpha=0.92)
    legend.get_frame().set(edgecolor="none", facecolor="white")
    legend.set_zorder(5)


def _widest(panel: IndicatorPanel) -> float:
    """Return the upper limit of the indicator axis."""
    reach = [_reach(shown.indicator) for shown in (panel.ideal, panel.noisy) if shown]
    return 1.04 * max([*reach, panel.threshold or 0.0]) or 1.0


def _reach(values: Floats) -> float:
    largest, typical = float(values.max()), float(np.quantile(values, 0.95))
    return CUT * typical if typical > 0.0 and largest > FAR * typical else largest


def _scatter(ax: Axes, shown: PlottedPoints, color: str, marker: str, widest: float) -> Line2D:
    many, inside = len(shown.indicator) > 1500, shown.indicator <= widest
    how: dict[str, Any] = {"color": color, "marker": marker, "linewidths": 0.0}
    x, y, size = shown.indicator[inside], shown.error[inside], 4 if many else 13
    ax.scatter(x, y, size, alpha=0.55, rasterized=many, zorder=3, **how)
    label, beyond = f"{short(shown.name, 40)}: {shown.fit}", len(shown.indicator) - len(x)
    if beyond:
        points = "point" if beyond == 1 else "points"
        label += f"\n({beyond} {points} not shown, up to I = {float(shown.indicator.max()):.3g})"
    return Line2D([], [], color=color, marker=marker, markersize=4.5, linestyle="none", label=label)


def _highest(panel: IndicatorPanel, widest: float) -> float:
    inside = [shown.error[shown.indicator <= widest] for shown in (panel.ideal, panel.noisy) if shown]
    return 1.28 * float(np.concatenate([*inside, [1e-6]]).max())  # room for the legend


def _draw_constant(ax: Axes, mean: float, sd: float, panel: IndicatorPanel, widest: float) -> None:
    reach = panel.threshold if panel.threshold is not None else 0.0
    if panel.ideal:
        reach = max(reach, min(widest, float(panel.ideal.indicator.max())))
    if np.isfinite(sd):
        ax.fill_between(
            [0.0, reach], mean - sd, mean + sd, color=ESTIMATE, alpha=0.15, linewidth=0.0, zorder=1
        )
    ax.plot([0.0, reach], [mean, mean], color=INK, linewidth=1.6, zorder=4)


def _draw_line(ax: Axes, slope: float, intercept: float, indicator: Floats, widest: float) -> None:
    ends = np.array([indicator.min(), min(indicator.max(), widest)])
    ax.plot(ends, slope * ends + intercept, color=INK, linewidth=1.6, linestyle=(0, (5, 1.5)), zorder=4)


def _draw_threshold(ax: Axes, threshold: float) -> Line2D:
    dashed: dict[str, Any] = {"color": TARGET, "linewidth": 1.2, "linestyle": (0, (2, 1.5))}
    return ax.axvline(threshold, zorder=2, label=f"threshold {threshold:.4f}", **dashed)
