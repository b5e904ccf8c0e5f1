"""Final true tips and targets with circles of 1 mm radius, as in the paper's figure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from flexneedle.figures.layout import Floats, legend
from flexneedle.figures.style import BAD, QUIET, TARGET, apply_style, width
from flexneedle.lab.study.figures.panels import FAINT, Panel, choose_dots, columns_of, head, panels, sheet

MAP = ("depth (mm)", "lateral (mm)")
BEYOND = ("depth beyond the target (mm)", "lateral (mm)")
_MOST_TARGETS = 40  # above this, all targets are drawn at the origin
_MARGIN, _FAR = 2.0, 6.0  # smallest and largest margin (mm) around the targets
_CIRCLE, _TIP, _CROSS = (
    "target, 1 mm radius",
    "final true tip",
    "final true tip, not finished",
)


@dataclass(frozen=True, eq=False)
class TipPositions:
    """Targets and true tips (n, 2) of n insertions, mm, NaN where unknown; done (n,): whether they finished.

    labels: of both axes.
    """

    targets: Floats
    tips: Floats
    done: NDArray[np.bool_]
    labels: tuple[str, str] = MAP

    @property
    def on_one(self) -> "TipPositions":
        """The tips relative to their targets, all targets at the origin."""
        tips = self.tips - self.targets
        return replace(self, targets=np.zeros_like(self.targets), tips=tips, labels=BEYOND)


def draw_targeting(shown: Sequence[Panel[TipPositions]]) -> Figure:
    """Return the figure: one panel each, on the same scale; a single panel has a magnified view beside it."""
    targets = np.unique(np.concatenate([panel.content.targets for panel in shown]), axis=0)
    if len(targets) > _MOST_TARGETS:
        shown = [replace(panel, content=panel.content.on_one) for panel in shown]
        targets = np.zeros((1, 2))
    low, high = _find_window(targets, [panel.content.tips for panel in shown])
    ratio = float(high[1] - low[1]) / float(high[0] - low[0])
    with apply_style():
        if len(shown) == 1:
            figure, axes = _with_close_up(shown[0], ratio)
        else:
            height = ratio * (width() / columns_of(len(shown)) - 0.3) + 0.75
            figure, axes = panels(shown, height, *shown[0].content.labels)
        for ax, panel in zip(axes, shown, strict=True):
            _draw_map(ax, panel, low, high)
        legend(figure, _handles())
    return figure


def _find_window(targets: Floats, tips: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of the view: all targets, and the tips within the largest margin."""
    ends = _drop_unknown(np.concatenate([targets, *tips]))
    low, high = targets.min(axis=0), targets.max(axis=0)
    below = np.clip(low - ends.min(axis=0) + 0.5, _MARGIN, _FAR)
    above = np.clip(ends.max(axis=0) - high + 0.5, _MARGIN, _FAR)
    low, high = low - below, high + above
    wide, tall = (high - low).tolist()
    extra = np.array([max(0.0, 0.5 * (tall - wide)), 0.0])  # a panel is not taller than wide
    return low - extra, high + extra


def _with_close_up(panel: Panel[TipPositions], ratio: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with an empty map and, beside it, the tips relative to their targets."""
    height = ratio * (width() - 1.2) / (1.0 + ratio) + 0.8
    figure, (ax, close) = sheet(height, columns=2, widths=(1.0, ratio))
    head(ax, panel, 2)
    ax.set_xlabel(panel.content.labels[0])
    ax.set_ylabel(panel.content.labels[1])
    _draw_close_up(close, panel.content.on_one, panel.color)
    return figure, [ax]


def _draw_close_up(ax: Axes, tips: TipPositions, color: str) -> None:
    known = _drop_unknown(tips.tips[tips.done])
    farthest = float(np.hypot(*known.T).max()) if len(known) else 1.0
    half = min(max(1.15 * farthest, 0.02), _FAR)
    sizes = [float(f"{digit}e{k}") for k in range(-3, 2) for digit in (1, 2, 5)]
    rings = [radius for radius in sizes if radius <= 0.95 * half][-2:]
    for radius in rings:
        edge: dict[str, Any] = {"edgecolor": TARGET if radius == 1.0 else FAINT, "linewidth": 1.0}
        ax.add_patch(Circle((0.0, 0.0), radius, facecolor="none", zorder=1, **edge))
    note = f"rings of {' and '.join(f'{radius:g}' for radius in rings)} mm radius"
    head(ax, Panel("all targets, magnified", note, QUIET, None), 3)
    _draw_tips(ax, tips, color, np.full(2, -half), np.full(2, half))
    ax.locator_params(nbins=5)
    ax.set_xlabel(tips.labels[0])


def _draw_map(ax: Axes, panel: Panel[TipPositions], low: Floats, high: Floats) -> None:
    targets = np.unique(panel.content.targets, axis=0)
    circles = PatchCollection([Circle((x, y), 1.0) for x, y in targets.tolist()], zorder=2, label=_CIRCLE)
    circles.set(facecolor="none", edgecolor=TARGET, linewidth=1.0)
    ax.add_collection(circles)
    ax.plot(*targets.T, "+", color=TARGET, markersize=5, markeredgewidth=0.7, zorder=2, label="target")
    _draw_tips(ax, panel.content, panel.color, low, high)
    for axis, (first, last) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        axis.set_major_locator(MultipleLocator(5.0 if last - first > 10.0 else 1.0))


def _draw_tips(ax: Axes, tips: TipPositions, color: str, low: Floats, high: Floats) -> None:
    """Draw the tips inside a window to scale, and write the number of those outside."""
    style = choose_dots(len(tips.tips))
    ax.scatter(*tips.tips[tips.done].T, color=color, zorder=3, label=_TIP, **style)
    if not tips.done.all():
        ax.plot(*tips.tips[~tips.done].T, "x", color=BAD, markersize=4, zorder=4, label=_CROSS)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    for side in ("top", "right"):
        ax.spines[side].set(visible=True, color=QUIET)
    known = _drop_unknown(tips.tips)
    outside = int(((known < low) | (known > high)).any(axis=1).sum())
    if outside:
        text = f"{outside} tip{'s' if outside > 1 else ''} outside"
        placed: dict[str, Any] = {"ha": "right", "va": "top", "transform": ax.transAxes, "zorder": 5}
        halo = withStroke(linewidth=2.0, foreground="white")  # readable over tips
        ax.text(0.99, 0.98, text, color=BAD, fontsize=8, path_effects=[halo], **placed)


def _drop_unknown(points: Floats) -> Floats:
    return points[~np.isnan(points).any(axis=1)]


def _handles() -> list[Line2D]:
    mark: dict[str, Any] = {"linestyle": "none"}
    circle: dict[str, Any] = {"markersize": 9, "markerfacecolor": "none", "markeredgecolor": TARGET}
    return [
        Line2D([], [], marker="o", label=_CIRCLE, **circle, **mark),
        Line2D([], [], color=QUIET, marker="o", markersize=3, label=_TIP, **mark),
        Line2D([], [], color=BAD, marker="x", markersize=4, label=_CROSS, **mark),
    ]
