"""Figures of a needle in space: directions of the bevel, the predicted shape, the view along the axis."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Annulus

from flexneedle.figures import scene
from flexneedle.figures.curves import Roll, planned_rolls, start_roll
from flexneedle.figures.layout import ARROW
from flexneedle.figures.scene import ALONG, View
from flexneedle.figures.style import BOX, ESTIMATE, GUIDE, PLAN, QUIET, TRUE, format_signed, is_column, small
from flexneedle.results import Period, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, X, Y, Z

COLUMNS: tuple[float, ...] = (4.2, 0.2, 2.4)
"""Widths of the columns of a figure: the middle one is the end of a section, not of a panel."""

_SDS = 2.0  # half width of the band about a predicted shape, in standard deviations
_DEPTHS = LinearSegmentedColormap.from_list(
    "depth", ("#f8c9a4", TRUE, "#5c2600")
)  # from the start to the end
_RING = 0.9  # mm; radius of the guide along the axis
_SCALE = (0.1, -0.33, 0.8, 0.035)  # the scale of depths, in shares of the axes
_SCALE_IN_COLUMN = (0.0, -0.58, 1.0, 0.035)
_ROOM = 1.4  # mm around all that is drawn in the view along the axis


def draw_bevels(
    ax: Axes, rolls: Sequence[Roll], view: View, length: float, color: str, *, solid: bool, label: str
) -> None:
    """Draw the bevel's directions after rolls as arrows from the tip, `length` mm long in space; solid or hollow."""
    if not rolls:
        return
    start = np.array([roll.point for roll in rolls])[:, view]
    arrow = length * np.array([roll.direction for roll in rolls])[:, view]
    how: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1.0,
        "units": "inches",
        "width": 0.018,
    }
    how |= {"headwidth": 4.5, "headlength": 5.0, "headaxislength": 4.5, "minlength": 0.5}
    how |= {"facecolor": color if solid else "white", "edgecolor": color, "linewidth": 0.0 if solid else 0.7}
    arrows = ax.quiver(*start.T, *arrow.T, zorder=7 + solid, label=label, **how)
    arrows.set_gid(ARROW)


def draw_planned(ax: Axes, scenario: Scenario, plan: Plan, view: View, length: float) -> None:
    """Draw the bevel at the start and after planned rolls: its side in the plane, its direction in space."""
    planned = planned_rolls(plan)
    if scenario.setup.axes == 1:
        scene.draw_rolls(ax, [start_roll(plan)], QUIET, solid=True, label="bevel at the start")
        scene.draw_rolls(ax, planned, PLAN, solid=False, label="bevel roll, planned")
    else:
        start = [start_roll(plan)]
        draw_bevels(ax, start, view, length, QUIET, solid=True, label="bevel at the start")
        draw_bevels(ax, planned, view, length, PLAN, solid=False, label="bevel after a roll, planned")


def draw_prediction(ax: Axes, period: Period, view: View) -> None:
    """Draw the band about the predicted shape of a period, in the view from the side."""
    if period.predicted is not None:
        (x, y), half = period.predicted.nodes[:, view].T, _SDS * period.predicted.sd[:, view[1] - Y]
        label = f"final shape ± {_SDS:g} sd, predicted at {format_signed(period.estimate.x, '.0f')} mm"
        how: dict[str, Any] = {"color": ESTIMATE, "alpha": 0.2, "linewidth": 0.0, "zorder": 2.2}
        ax.fill_between(x, y - half, y + half, label=label, **how)


def set_up_along(ax: Axes, scenario: Scenario, paths: Sequence[Floats]) -> None:
    """Set up axes along the axis, to scale around paths (k, ≥ 3) of tip and guide."""
    points = np.concatenate([path[:, [Z, Y]] for path in paths])
    low, high = points.min(axis=0), points.max(axis=0)
    half, middle = 0.58 * float(np.max(high - low)) + _ROOM, 0.5 * (low + high)
    (left, bottom), (right, top) = middle - half, middle + half
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", anchor="N")
    ax.set(xlabel=scene.lateral_label(scenario, Z), ylabel=scene.lateral_label(scenario, Y))
    ax.set_title("View along the axis")
    ax.locator_params(nbins=4 if is_column() else 6)
    ax.grid(color="#e4e4e4", linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)


def arrow_along(ax: Axes) -> float:
    """Return the length (mm) of arrows along the axis."""
    return 0.15 * float(np.ptp(ax.get_xlim()))


def draw_along(ax: Axes, path: Floats, planned: Floats | None = None, *, scale: bool = True) -> None:
    """Draw along the axis the path of the tip (k, ≥ 3), coloured by depth (with its scale), and the planned one."""
    if planned is not None:
        ax.plot(*planned[:, ALONG].T, "--", color=PLAN, linewidth=1.0, zorder=5)
    if len(path) > 1:
        _draw_depths(ax, path, scale=scale)
    ax.plot(*path[-1, ALONG], "o", color=TRUE, markersize=5, markeredgecolor="white", zorder=9)


def _draw_depths(ax: Axes, path: Floats, *, scale: bool) -> None:
    points = path[:, ALONG]
    how: dict[str, Any] = {"cmap": _DEPTHS, "linewidth": 2.2, "zorder": 4, "capstyle": "round"}
    line = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), **how)
    line.set_array(0.5 * (path[:-1, X] + path[1:, X]))
    line.set_gid("path by depth")
    ax.add_collection(line, autolim=False)
    if not scale:
        return
    figure: Any = ax.figure
    bar = figure.colorbar(
        line, cax=ax.inset_axes(_SCALE_IN_COLUMN if is_column() else _SCALE), orientation="horizontal"
    )
    bar.set_label("depth of the tip (mm)")
    bar.outline.set_visible(False)


def draw_guide_along(ax: Axes, travel: Floats) -> None:
    """Draw the guide's path y, z (k, 2) along the axis, and the guide at its end, named towards the middle."""
    y, z = travel.T
    ax.plot(z, y, color=GUIDE, linewidth=1.0, zorder=3)
    ring = Annulus((z[-1], y[-1]), _RING, 0.25, facecolor=GUIDE, alpha=0.6, edgecolor="none", zorder=2)
    ring.set_gid("guide")
    ax.add_patch(ring)
    side = -1 if z[-1] > np.mean(ax.get_xlim()) else 1
    beside: dict[str, Any] = {"ha": "left" if side > 0 else "right", "va": "center", "fontsize": small()}
    beside |= {"xytext": (3 * side, 0), "textcoords": "offset points", "color": GUIDE, "bbox": BOX}
    ax.annotate("guide", (z[-1] + side * _RING, y[-1]), **beside)
