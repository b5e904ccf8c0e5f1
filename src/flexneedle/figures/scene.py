"""The scene to scale: tissue, guide, needle, target, bevel flips. The legend names the artists by their labels."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from flexneedle.figures.curves import Roll
from flexneedle.figures.layout import UPRIGHT
from flexneedle.figures.style import GUIDE, NEEDLE, QUIET, TARGET
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import Layer
from flexneedle.types import Floats, Plan

_TISSUES = ("#fbeee3", "#f3dcc8", "#e9c9ad", "#deb592")  # soft to stiff
_SKIN, _BORDER, _NAME = "#8c5a36", "#c9a27f", "#6d4526"
_SHAPE = 0.2  # height of a scene by its width
_OPENING, _BLOCK, _WIDE = 0.7, 2.2, 1.1  # half opening, length and half width of the guide's jaws (mm)
_SMALL: Any = {"textcoords": "offset points", "fontsize": 8}


def draw_tissue(ax: Axes, scenario: Scenario, paths: Iterable[Floats]) -> None:
    """Set up axes to scale around start, guide and paths (k, ≥ 2), with air, skin and layers."""
    _frame(ax, scenario, np.concatenate([path[:, :2] for path in paths]))
    tint_layers(ax, scenario)
    ax.axvline(0.0, color=_SKIN, linewidth=1.6, zorder=1)
    ax.annotate("air", (0, 0), (4, 4), "axes fraction", color=QUIET, **_SMALL)
    above: dict[str, Any] = {"xycoords": ax.get_xaxis_transform(), "ha": "right", "va": "top"}
    ax.annotate("skin", (0, 1), (-4, -3), color=_SKIN, **above, **_SMALL)
    ax.set(xlabel="depth (mm)", ylabel="lateral (mm)")


def _frame(ax: Axes, scenario: Scenario, points: Floats) -> None:
    """Set limits around points (k, 2), always of the same shape."""
    guide_x = scenario.setup.guide_x
    left = min(scenario.setup.start_tip_x - 8.0, 0.0 if guide_x is None else guide_x - 6.0)
    low = np.minimum(np.array([left, 0.0]), points.min(axis=0)) - np.array([0.0, 4.0])
    high = np.maximum(np.zeros(2), points.max(axis=0)) + np.array([6.0, 4.0])
    width = max(high[0] - low[0], (high[1] - low[1]) / _SHAPE)
    half, middle = 0.5 * width * np.array([1.0, _SHAPE]), 0.5 * (low + high)
    (left, bottom), (right, top) = middle - half, middle + half
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", anchor="W")


def tint_layers(ax: Axes, scenario: Scenario) -> None:
    """Colour the layers as far as the axes reach, the stiffer the darker."""
    stiffness = sorted({layer.shear_modulus_kpa for layer in scenario.tissue})
    for layer, top, bottom in _layers(ax, scenario):
        rank = stiffness.index(layer.shear_modulus_kpa) / max(1, len(stiffness) - 1)
        shade = _TISSUES[round(rank * (min(len(stiffness), len(_TISSUES)) - 1))]
        ax.axvspan(top, bottom, facecolor=shade, edgecolor="none", zorder=0)
        if top > 0.0:
            ax.axvline(top, color=_BORDER, linewidth=0.8, zorder=0.5)


def _layers(ax: Axes, scenario: Scenario) -> Iterator[tuple[Layer, float, float]]:
    right = ax.get_xlim()[1]
    tops = scenario.layer_tops
    for layer, top, bottom in zip(scenario.tissue, tops, (*tops[1:], right), strict=True):
        if top < right:
            yield layer, top, min(bottom, right)


def name_layers(ax: Axes, scenario: Scenario) -> None:
    """Write name and μ of each layer as far as they fit into it. The layout of the figure must be final."""
    for layer, top, bottom in _layers(ax, scenario):
        right = ax.transData.transform((bottom, 0.0))[0]
        modulus = f"μ {layer.shear_modulus_kpa:g} kPa"
        name = ax.annotate("", (top, 0), (4, 4), ax.get_xaxis_transform(), color=_NAME, **_SMALL)
        for text in (f"{layer.name}, {modulus}", f"{layer.name}\n{modulus}", modulus, ""):
            name.set_text(text)
            if name.get_window_extent().x1 < right or not text:
                break


def draw_guide(ax: Axes, x: float, travel: Floats, y: float) -> None:
    """Draw the guide at its last position y, and its travel (k,) (mm)."""
    for low in (y + _OPENING, y - _OPENING - _BLOCK):
        jaw = Rectangle((x - _WIDE, low), 2 * _WIDE, _BLOCK, facecolor=GUIDE, edgecolor="none", zorder=4)
        jaw.set_gid("guide")
        ax.add_patch(jaw)
    beside = x - _WIDE - 1.3
    if np.ptp(travel) > 0.0:
        ends = [travel.min(), travel.max()]
        how: dict[str, Any] = {"color": GUIDE, "linewidth": 1.0, "marker": "_", "gid": UPRIGHT}
        ax.plot([beside, beside], ends, label="guide travel", **how)
    ax.plot([beside], [y], color=GUIDE, marker=">", markersize=4, linestyle="none")
    above: dict[str, Any] = {"xytext": (0, 3), "ha": "center", "va": "bottom"}
    ax.annotate("guide", (x, y + _OPENING + _BLOCK), color=GUIDE, **above, **_SMALL)


def draw_needle(ax: Axes, shape: Floats, before: Sequence[Floats], diameter: float, label: str) -> None:
    """Draw the needle (n, 3) to scale, and faded the middle lines of its earlier shapes."""
    across = 0.5 * diameter * np.column_stack([-np.sin(shape[:, 2]), np.cos(shape[:, 2])])
    outline = np.concatenate([shape[:, :2] + across, (shape[:, :2] - across)[::-1]])
    ax.fill(*outline.T, color=NEEDLE, alpha=0.75, linewidth=0.0, zorder=2.5, label=label)
    faded: dict[str, Any] = {"color": NEEDLE, "alpha": 0.45, "linewidth": 1.6, "zorder": 2}
    for old in before:
        ax.plot(*old[:, :2].T, marker="o", markevery=[-1], markersize=4, label="earlier shapes", **faded)


def draw_target(ax: Axes, target: tuple[float, float]) -> None:
    """Draw the target with the circle of 1 mm within which it counts as reached."""
    circle = Circle(target, 1.0, facecolor="none", edgecolor=TARGET, linewidth=1.4, zorder=6)
    circle.set_gid("target")
    ax.add_patch(circle)
    cross: dict[str, Any] = {"marker": "+", "markersize": 6, "markeredgewidth": 1.2, "linestyle": "none"}
    ax.plot(*target, color=TARGET, zorder=6, label="target, circle of 1 mm radius", **cross)


def draw_start(ax: Axes, plan: Plan) -> None:
    """Show beside the start of the tip the side of the bevel at the start."""
    x, y = plan.tips[0, :2].tolist()
    draw_rolls(ax, [Roll(x, y, plan.bevel)], QUIET, solid=True, label="bevel at the start")


def draw_rolls(ax: Axes, rolls: Sequence[Roll], color: str, *, solid: bool, label: str) -> None:
    """Mark rolls of the bevel beside the path, on the side to which the bevel rolls and pointing there.

    The marks are small and solid, or large and hollow, so that both are visible.
    """
    how: dict[str, Any] = {"linestyle": "none", "markeredgecolor": color, "zorder": 7 + solid}
    how |= (
        {"markersize": 5.5, "markeredgewidth": 0.0} if solid else {"markersize": 9.0, "markeredgewidth": 1.1}
    )
    for roll in rolls:
        shape = "^" if roll.side > 0 else "v"
        fill = color if solid else "none"
        ax.plot(roll.x, roll.y + 1.5 * roll.side, marker=shape, markerfacecolor=fill, label=label, **how)
