"""The scene to scale: tissue, guide, needle, target, rolls of the bevel."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from flexneedle.figures.curves import Roll
from flexneedle.figures.style import GUIDE, NEEDLE, QUIET, TARGET
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.tissue import Layer
from flexneedle.types import Floats, Plan

_AIR = "#ffffff"
_TISSUES = ("#fbeee3", "#f3dcc8", "#e9c9ad", "#deb592")  # soft to stiff
_OPENING, _BLOCK, _WIDE = 0.7, 2.2, 1.1  # half opening, length and half width of the guide's jaws (mm)
_CHARACTER = 0.062  # width of a character of 8 points (inches)
AXES = 8.2  # width of the axes of a scene, about (inches)


@dataclass(frozen=True)
class View:
    """A window on the scene (mm)."""

    left: float
    right: float
    low: float
    high: float

    @property
    def ratio(self) -> float:
        """Height by width."""
        return (self.high - self.low) / (self.right - self.left)


def view_of(scenario: Scenario, depth: float, paths: Iterable[Floats]) -> View:
    """Return the window on guide (or start), tissue down to `depth` and paths (k, ≥ 2), y in column 1."""
    guide_x = scenario.setup.guide_x
    left = min(scenario.setup.start_tip_x - 8.0, 0.0 if guide_x is None else guide_x - 6.0)
    lateral = np.concatenate([path[:, 1] for path in paths] or [np.zeros(1)])
    low, high = min(0.0, float(lateral.min())) - 5.0, max(0.0, float(lateral.max())) + 4.0
    right = depth + 11.0
    missing = max(0.0, 0.18 * (right - left) - (high - low)) / 2
    return View(left, right, low - missing, high + missing)


def draw_tissue(ax: Axes, scenario: Scenario, view: View) -> None:
    """Set up axes to scale with air, skin and named layers."""
    ax.set_xlim(view.left, view.right)
    ax.set_ylim(view.low, view.high)
    ax.set_aspect("equal", anchor="N")
    ax.set_xlabel("depth (mm)", labelpad=1.0)
    ax.set_ylabel("lateral (mm)")
    tint_layers(ax, scenario, view.right)
    ax.axvline(0.0, color="#8c5a36", linewidth=1.6, zorder=1, label="skin")
    foot = view.low + 0.5
    ax.text(view.left + 1.0, foot, "air", color=QUIET, fontsize=8)
    ax.text(-0.7, view.high - 0.4, "skin", color="#8c5a36", fontsize=8, ha="right", va="top")
    inches = AXES / (view.right - view.left)
    for layer, top, bottom in _layers(scenario, view.right):
        _name_layer(ax, layer, top, (bottom - top) * inches, foot)


def tint_layers(ax: Axes, scenario: Scenario, right: float) -> None:
    """Colour the layers down to depth `right`, the stiffer the darker."""
    stiffness = sorted({layer.shear_modulus_kpa for layer in scenario.tissue})
    for layer, top, bottom in _layers(scenario, right):
        rank = stiffness.index(layer.shear_modulus_kpa) / max(1, len(stiffness) - 1)
        shade = _TISSUES[round(rank * (min(len(stiffness), len(_TISSUES)) - 1))]
        ax.axvspan(top, bottom, facecolor=shade, edgecolor="none", zorder=0)
        if top > 0.0:
            ax.axvline(top, color="#c9a27f", linewidth=0.8, zorder=0.5)


def _layers(scenario: Scenario, right: float) -> list[tuple[Layer, float, float]]:
    tops = scenario.layer_tops
    found = zip(scenario.tissue, tops, (*tops[1:], right), strict=True)
    return [(layer, top, min(bottom, right)) for layer, top, bottom in found if top < right]


def _name_layer(ax: Axes, layer: Layer, top: float, inches: float, foot: float) -> None:
    """Write the name and μ of a layer as far as they fit."""
    modulus = f"μ {layer.shear_modulus_kpa:g} kPa"
    one, two = f"{layer.name}, {modulus}", f"{layer.name}\n{modulus}"
    for text in (one, two, modulus):
        if max(len(line) for line in text.split("\n")) * _CHARACTER < inches - 0.1:
            ax.text(top + 0.8, foot, text, color="#6d4526", fontsize=8, va="bottom", linespacing=1.15)
            return


def draw_guide(ax: Axes, x: float, travel: Floats, y: float) -> None:
    """Draw the guide at its last position y, and its travel (k,) (mm)."""
    for low in (y + _OPENING, y - _OPENING - _BLOCK):
        jaw = Rectangle((x - _WIDE, low), 2 * _WIDE, _BLOCK, facecolor=GUIDE, edgecolor="none", zorder=4)
        jaw.set_gid("guide")
        ax.add_patch(jaw)
    beside = x - _WIDE - 1.3
    ends = [travel.min(), travel.max()]
    ax.plot([beside, beside], ends, color=GUIDE, linewidth=1.0, marker="_", label="guide travel")
    ax.plot([beside], [y], color=GUIDE, marker=">", markersize=4, linestyle="none")
    ax.text(x, y + _OPENING + _BLOCK + 0.4, "guide", color=GUIDE, fontsize=8, ha="center", va="bottom")


def draw_needle(ax: Axes, shape: Floats, before: Sequence[Floats], diameter: float) -> None:
    """Draw the needle (n, 3) to scale, and faded its earlier shapes."""
    faded: dict[str, Any] = {"facecolor": NEEDLE, "edgecolor": "none", "alpha": 0.45, "zorder": 2}
    for old in before:
        ax.add_patch(Polygon(outline(old, 0.4 * diameter), label="needle before", **faded))
        ax.add_patch(Circle((old[-1, 0], old[-1, 1]), 0.45 * diameter, **faded))
    drawn: dict[str, Any] = {**faded, "alpha": 0.75, "zorder": 2.5}
    ax.add_patch(Polygon(outline(shape, diameter), label="needle", **drawn))


def needle_handle(name: str) -> Line2D:
    """Return the entry of the needle in a legend."""
    return Line2D([], [], color=NEEDLE, alpha=0.75, linewidth=4.0, label=name)


def outline(shape: Floats, width: float) -> Floats:
    """Return the outline (2n, 2) of a needle of shape (n, 3): x, y (mm), slope (rad)."""
    across = 0.5 * width * np.column_stack([-np.sin(shape[:, 2]), np.cos(shape[:, 2])])
    edges: Floats = np.concatenate([shape[:, :2] + across, (shape[:, :2] - across)[::-1]])
    return edges


def draw_target(ax: Axes, target: tuple[float, float]) -> None:
    """Draw the target with the circle of 1 mm within which it counts as reached."""
    circle = Circle(target, 1.0, facecolor="none", edgecolor=TARGET, linewidth=1.4, zorder=6)
    circle.set_gid("target")
    ax.add_patch(circle)
    cross: dict[str, Any] = {"marker": "+", "markersize": 6, "markeredgewidth": 1.2}
    ax.plot(*target, color=TARGET, zorder=6, label="target", **cross)


def name_target(ax: Axes, target: tuple[float, float]) -> None:
    """Write the meaning of the circle beside the target."""
    x, y = target
    ax.text(x + 1.6, y, "target,\n1 mm circle", color=TARGET, fontsize=8, va="center", linespacing=1.15)


def name_bevel(ax: Axes, plan: Plan) -> None:
    """Show below the start of the tip the side of the bevel at the start, above the names of the layers."""
    x, foot = float(plan.tips[0, 0]), ax.get_ylim()[0] + 2.4
    marker = "^" if plan.bevel > 0 else "v"
    ax.plot(x, foot + 0.6, marker=marker, markersize=5, color=QUIET, label="bevel at the start")
    ax.text(x + 1.0, foot, "bevel at the start", color=QUIET, fontsize=8)


def draw_rolls(ax: Axes, rolls: Sequence[Roll], color: str, *, solid: bool, label: str) -> None:
    """Mark rolls of the bevel beside the path, on the side to which the bevel rolls and pointing there."""
    how = roll_style(color, solid=solid)
    for roll in rolls:
        shape = "^" if roll.side > 0 else "v"
        ax.plot(roll.x, roll.y + 1.5 * roll.side, marker=shape, zorder=7 + solid, label=label, **how)


def roll_style(color: str, *, solid: bool) -> dict[str, Any]:
    """Return the style of a roll's mark: small and solid, or large and hollow, so that both are visible."""
    common: dict[str, Any] = {"linestyle": "none", "markeredgecolor": color}
    if solid:
        return {**common, "markersize": 5.5, "markerfacecolor": color, "markeredgewidth": 0.0}
    return {**common, "markersize": 9.0, "markerfacecolor": "none", "markeredgewidth": 1.1}
