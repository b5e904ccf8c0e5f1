"""Where the tips ended: targets with their circles of 1 mm and true tips, as in the paper's figure."""

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

from flexneedle.plot.layout import FAINT, Floats, Look, Panels, head, legend, panels, scattered
from flexneedle.plot.style import BAD, QUIET, TARGET, WIDTH, axes, new_figure, styled

_MOST_TARGETS = 40  # more, and they are laid on one another
_MARGIN, _FAR = 2.0, 6.0  # mm around the targets that are always, and that are at most shown
_LEFT, _RIGHT, _BETWEEN, _TOP, _FOOT = 0.62, 0.15, 0.75, 0.44, 0.75  # inches


@dataclass(frozen=True, eq=False)
class TargetPanel:
    """Targets and true tips (n, 2) of n insertions, mm, NaN where unknown; done (n,): whether they finished.

    note, alarm: what stands above the panel at the left, and in a warning colour at the right.
    """

    title: str
    note: str
    alarm: str
    look: Look
    targets: Floats
    tips: Floats
    done: NDArray[np.bool_]


def targeting_figure(shown: Sequence[TargetPanel]) -> Figure:
    """Return the figure: a panel each, all to the same scale; beside a single one all targets magnified."""
    targets = np.unique(np.concatenate([panel.targets for panel in shown]), axis=0)
    together = len(targets) > _MOST_TARGETS
    if together:
        shown = [_on_one(panel) for panel in shown]
        targets = np.zeros((1, 2))
    low, high = _window(targets, [panel.tips for panel in shown])
    width, height = (high - low).tolist()
    with styled():
        if len(shown) == 1:
            made = _with_close_up(_on_one(shown[0]), height / width)
        else:
            made = panels(len(shown), height / width)
        for ax, panel in zip(made.axes, shown, strict=True):
            _draw_map(ax, panel, low, high)
        _label(made, together)
        legend(made.figure, _handles(any(not panel.done.all() for panel in shown)))
    return made.figure


def _on_one(panel: TargetPanel) -> TargetPanel:
    return replace(panel, targets=np.zeros_like(panel.targets), tips=panel.tips - panel.targets)


def _window(targets: Floats, tips: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of what is shown: all targets, and tips that are not too far away."""
    ends = _known(np.concatenate([targets, *tips]))
    low, high = targets.min(axis=0), targets.max(axis=0)
    below = np.clip(low - ends.min(axis=0) + 0.5, _MARGIN, _FAR)
    above = np.clip(ends.max(axis=0) - high + 0.5, _MARGIN, _FAR)
    return low - below, high + above


def _with_close_up(panel: TargetPanel, ratio: float) -> Panels:
    """Return a figure with an empty map, and beside it the tips around their targets, all in one place."""
    width = (WIDTH - _LEFT - _RIGHT - _BETWEEN) / (1.0 + ratio)
    height = ratio * width
    figure = new_figure(_TOP + height + _FOOT)
    made = Panels(figure, [axes(figure, _LEFT, _TOP, width, height)], 1)
    ax = axes(figure, WIDTH - _RIGHT - height, _TOP, height, height)
    _draw_close_up(ax, panel)
    _frame(ax)
    return made


def _draw_close_up(ax: Axes, panel: TargetPanel) -> None:
    known = _known(panel.tips[panel.done])
    farthest = float(np.hypot(*known.T).max()) if len(known) else 1.0
    half = min(max(1.15 * farthest, 0.02), _FAR)
    corner = np.full(2, half)
    ax.set_aspect("equal")
    ax.set_xlim(-half, half)
    ax.set_ylim(-half, half)
    for radius in _rings(half):
        edge = (
            {"edgecolor": TARGET, "linewidth": 1.2}
            if radius == 1.0
            else {"edgecolor": FAINT, "linewidth": 0.9}
        )
        ax.add_patch(Circle((0.0, 0.0), radius, facecolor="none", zorder=1, **edge))
    _draw_tips(ax, panel)
    _count_outside(ax, panel.tips, -corner, corner)
    rings = " and ".join(f"{radius:g}" for radius in _rings(half))
    head(ax, "all targets, magnified", f"rings of {rings} mm radius", QUIET)
    ax.locator_params(nbins=5)
    ax.set_xlabel("too deep (mm)", labelpad=1.0)


def _rings(half: float) -> list[float]:
    """Return the radii of one or two rings that fit into half a window."""
    sizes = [float(f"{digit}e{k}") for k in range(-3, 2) for digit in (1, 2, 5)]
    return [radius for radius in sizes if radius <= 0.95 * half][-2:]


def _draw_map(ax: Axes, panel: TargetPanel, low: Floats, high: Floats) -> None:
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    head(ax, panel.title, panel.note, panel.look.color, panel.alarm)
    targets = np.unique(panel.targets, axis=0)
    circles = PatchCollection([Circle((x, y), 1.0) for x, y in targets.tolist()], zorder=2)
    circles.set(facecolor="none", edgecolor=TARGET, linewidth=1.0)
    circles.set_gid("targets")
    ax.add_collection(circles)
    ax.plot(*targets.T, "+", color=TARGET, markersize=5, markeredgewidth=0.7, zorder=2, label="target")
    _draw_tips(ax, panel)
    _count_outside(ax, panel.tips, low, high)


def _draw_tips(ax: Axes, panel: TargetPanel) -> None:
    tips, style = panel.tips, scattered(len(panel.tips))
    ax.scatter(*tips[panel.done].T, color=panel.look.color, zorder=3, label="true tip", **style)
    ax.plot(*tips[~panel.done].T, "x", color=BAD, markersize=4, zorder=4, label="not finished")


def _count_outside(ax: Axes, tips: Floats, low: Floats, high: Floats) -> None:
    known = _known(tips)
    outside = int(((known < low) | (known > high)).any(axis=1).sum())
    if outside:
        text = f"{outside} tip{'s' if outside > 1 else ''} outside"
        placed: dict[str, Any] = {"ha": "right", "va": "top", "transform": ax.transAxes, "zorder": 5}
        halo = withStroke(linewidth=2.0, foreground="white")  # readable over tips
        ax.text(0.99, 0.98, text, color=BAD, fontsize=8, path_effects=[halo], **placed)


def _known(points: Floats) -> Floats:
    return points[~np.isnan(points).any(axis=1)]


def _label(made: Panels, together: bool) -> None:
    depth = "too deep (mm)" if together else "depth (mm)"
    for ax in made.axes:
        ax.tick_params(labelleft=ax in made.leftmost, labelbottom=ax in made.lowest)
        _frame(ax)
        for axis in (ax.xaxis, ax.yaxis):
            low, high = axis.get_view_interval()
            axis.set_major_locator(MultipleLocator(5.0 if high - low > 10.0 else 1.0))
    for ax in made.lowest:
        ax.set_xlabel(depth, labelpad=1.0)
    for ax in made.leftmost:
        ax.set_ylabel("aside (mm)")


def _frame(ax: Axes) -> None:
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
        ax.spines[side].set_color(QUIET)


def _handles(unfinished: bool) -> list[Line2D]:
    circle: dict[str, Any] = {
        "marker": "o",
        "markersize": 9,
        "markerfacecolor": "none",
        "markeredgecolor": TARGET,
    }
    handles = [
        Line2D([], [], linestyle="none", label="target, circle of 1 mm radius", **circle),
        Line2D([], [], linestyle="none", color=QUIET, marker="o", markersize=3, label="true tip at the end"),
    ]
    if unfinished:
        cross: dict[str, Any] = {"marker": "x", "markersize": 4, "color": BAD}
        handles.append(Line2D([], [], linestyle="none", label="tip of an insertion not finished", **cross))
    return handles
