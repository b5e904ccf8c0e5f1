"""The scene to scale: tissue, guide, needle, target, bevel rolls. The legend names the artists by their labels.

A view is the pair of coordinates that are drawn: depth and y, and in space depth and z, or z and y along the axis.
"""

from collections.abc import Iterable, Iterator, Sequence
from math import inf
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from flexneedle.figures.curves import Roll
from flexneedle.figures.layout import UPRIGHT
from flexneedle.figures.style import BAD, GUIDE, INK, NEEDLE, TARGET, format_signed, is_column, small
from flexneedle.results import TARGET_RADIUS_MM, Insertion, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import THETA, Floats, Point, X, Y, Z


class Strip(NamedTuple):
    """A layer in axes from the side: name, modulus and depths as text; its ends (mm) within the axes; its color."""

    name: str
    modulus: str
    depths: str
    top: float
    bottom: float
    color: str


View = tuple[int, int]
"""Columns of a point that are drawn to the right and upwards."""
SIDE: View = (X, Y)
ABOVE: View = (X, Z)
ALONG: View = (Z, Y)
"""Along the axis, in the direction of insertion."""

_TISSUES = ("#fbeee3", "#f3dcc8", "#e9c9ad", "#deb592")  # soft to stiff
SKIN, _BORDER = "#8c5a36", "#c9a27f"
_SHAPE = 0.2  # height of a scene by its width
_OPENING, _BLOCK, _WIDE = 0.7, 2.2, 1.1  # half opening, length and half width of the guide's jaws (mm)


def sections(scenario: Scenario) -> dict[str, View]:
    """Return the views from the side, by the end of the names of their axes."""
    return {"": SIDE} if scenario.setup.axes == 1 else {" y": SIDE, " z": ABOVE}


def moved_axes(scenario: Scenario) -> dict[str, int]:
    """Return the lateral axes in which guide or base move, by the end of the names of their lines."""
    setup, sides = scenario.setup, sections(scenario)
    count = setup.moved_guide_axes if setup.has_guide else setup.axes
    return {end: axis for end, (_, axis) in list(sides.items())[:count]}


def name_scenes(scenes: Sequence[Axes], title: str, color: str, size: float = 10.0) -> None:
    """Write the title over the first of scenes one above the other, and depths below the last."""
    scenes[0].set_title(title, color=color, fontsize=7.5 if is_column() else size)
    for ax in scenes[:-1]:
        ax.tick_params(labelbottom=False)
        ax.set_xlabel("")


def color_of(record: Plan | Insertion) -> str:
    """Return the color of a verdict: green for a hit, red beyond 1 mm, neutral between."""
    return TARGET if record.hit else INK if record.reached else BAD


def place(scenario: Scenario, target: Point) -> str:
    """Return a target as text."""
    depth, *lateral = (
        f"{format_signed(round(value, 2) + 0.0)} mm" for value in target[: 1 + scenario.setup.axes]
    )
    return f"{depth} deep, {' and '.join(lateral)} lateral"


def draw_tissue(ax: Axes, scenario: Scenario, paths: Iterable[Floats], view: View = SIDE) -> None:
    """Set up axes to scale around start, guide and paths (k, ≥ 3), with air, skin and layers.

    All views of the same paths have the same scale.
    """
    _frame(ax, scenario, np.concatenate([path[:, : 1 + scenario.setup.axes] for path in paths]), view)
    tint_layers(ax, scenario)
    ax.axvline(0.0, color=SKIN, linewidth=1.6, zorder=1)
    ax.set(xlabel="depth (mm)", ylabel=lateral_label(scenario, view[1]))


def guide_path(scenario: Scenario, travel: Floats) -> Floats:
    """Return the points (k, 3) of the guide's travel y, z (k, 2); none (0, 3) without a guide."""
    x = scenario.setup.guide_x
    return np.empty((0, 3)) if x is None else np.column_stack([np.full(len(travel), x), travel])


def lateral_label(scenario: Scenario, axis: int) -> str:
    """Return the label of a lateral axis."""
    if scenario.setup.axes == 1:
        return "lateral (mm)"
    return f"{'' if is_column() else 'lateral '}{'xyz'[axis]} (mm)"


def _frame(ax: Axes, scenario: Scenario, points: Floats, view: View) -> None:
    """Set limits around points (k, 1 + axes), always of the same shape."""
    still = np.zeros(scenario.setup.axes)
    before, after = np.array([0.0, *(still + 4.0)]), np.array([6.0, *(still + 4.0)])
    guide_x = scenario.setup.guide_x
    left = min(scenario.setup.start_tip_x - 8.0, 0.0 if guide_x is None else guide_x - 6.0)
    low = np.minimum([left, *still], points.min(axis=0)) - before
    high = np.maximum([0.0, *still], points.max(axis=0)) + after
    width = max(high[0] - low[0], (high - low)[1:].max() / _SHAPE)
    half, middle = 0.5 * width * np.array([1.0, _SHAPE]), 0.5 * (low + high)[list(view)]
    (left, bottom), (right, top) = middle - half, middle + half
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", anchor="W")


def tint_layers(ax: Axes, scenario: Scenario) -> None:
    """Colour the layers as far as the axes reach, the stiffer the darker."""
    for strip in strips(ax, scenario):
        ax.axvspan(strip.top, strip.bottom, facecolor=strip.color, edgecolor="none", zorder=0)
        if strip.top > 0.0:
            ax.axvline(strip.top, color=_BORDER, linewidth=0.8, zorder=0.5)


def strips(ax: Axes, scenario: Scenario) -> Iterator[Strip]:
    """Yield the layers as far as the axes reach."""
    stiffness = sorted({layer.shear_modulus_kpa for layer in scenario.tissue})
    right, tops = ax.get_xlim()[1], scenario.layer_tops
    for layer, top, bottom in zip(scenario.tissue, tops, (*tops[1:], inf), strict=True):
        rank = stiffness.index(layer.shear_modulus_kpa) / max(1, len(stiffness) - 1)
        color = _TISSUES[round(rank * (min(len(stiffness), len(_TISSUES)) - 1))]
        depths = f"from {top:g} mm" if bottom == inf else f"{top:g} to {bottom:g} mm"
        modulus = f"μ {layer.shear_modulus_kpa:g} kPa"
        if top < right:
            yield Strip(layer.name, modulus, depths, top, min(bottom, right), color)


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
    jaw_side, how = (x + _WIDE, y + _OPENING + 0.5 * _BLOCK), {"color": GUIDE, "fontsize": small()}
    ax.annotate("guide", jaw_side, xytext=(3, 0), textcoords="offset points", va="center", **how)


def draw_needle(
    ax: Axes, shape: Floats, before: Sequence[Floats], diameter: float, label: str, view: View = SIDE
) -> None:
    """Draw the needle (n, 5) to scale, and faded the middle lines of its earlier shapes, from the side."""
    slope = shape[:, THETA - Y + view[1]]
    across = 0.5 * diameter * np.column_stack([-np.sin(slope), np.cos(slope)])
    outline = np.concatenate([shape[:, view] + across, (shape[:, view] - across)[::-1]])
    ax.fill(*outline.T, color=NEEDLE, alpha=0.75, linewidth=0.0, zorder=2.5, label=label)
    faded: dict[str, Any] = {"color": NEEDLE, "alpha": 0.45, "linewidth": 1.6, "zorder": 2}
    for old in before:
        ax.plot(*old[:, view].T, marker="o", markevery=[-1], markersize=4, label="earlier shapes", **faded)


def draw_target(ax: Axes, target: Point, view: View = SIDE) -> None:
    """Draw the target with the circle of 1 mm outside of which it counts as missed."""
    centre = target[view[0]], target[view[1]]
    circle = Circle(centre, TARGET_RADIUS_MM, facecolor="none", edgecolor=TARGET, linewidth=1.4, zorder=6)
    circle.set_gid("target")
    ax.add_patch(circle)
    cross: dict[str, Any] = {"marker": "+", "markersize": 6, "markeredgewidth": 1.2, "linestyle": "none"}
    ax.plot(*centre, color=TARGET, zorder=6, label="target, circle of 1 mm radius", **cross)


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
        x, y, _ = roll.point
        ax.plot(x, y + 1.5 * roll.side, marker=shape, markerfacecolor=fill, label=label, **how)
