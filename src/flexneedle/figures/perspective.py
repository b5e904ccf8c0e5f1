"""The figure of an insertion in space in perspective: skin and layers, guide, needle, path of the tip, target.

Points are rows x, y, z (mm), drawn to the same scale; y points upwards, as in the view along the axis.
"""

from itertools import pairwise
from math import ceil
from textwrap import wrap
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Patch
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from flexneedle.figures import curves, scene
from flexneedle.figures.insertion import title_of
from flexneedle.figures.layout import ARROW, legend
from flexneedle.figures.space import APPLIED, SDS, prediction_label
from flexneedle.figures.style import (
    BAD,
    ESTIMATE,
    GUIDE,
    INK,
    NEEDLE,
    PLAN,
    QUIET,
    TARGET,
    TRUE,
    WIDTH,
    apply_style,
    format_signed,
    new_figure,
)
from flexneedle.results import Insertion
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, X, Y, Z

_HEIGHT = 3.9  # inches
_LINE = 100  # characters of a line of the verdict
_LEADING = 0.2  # inches between lines of the verdict
_ROOM = np.array(
    [[0.03, 0.22], [0.99, 0.86]]
)  # the part of the figure that the box fills below one line of verdict
_VIEW: Any = {"elev": 20.0, "azim": -72.0}
_BEHIND, _BEYOND, _AROUND = 6.0, 4.0, 4.0  # mm behind the guide, beyond the target, around all that is drawn
_ARROW = 5.0  # mm
_DEPTHS = 20  # mm between depths that are named
_LIGHT = LightSource(azdeg=205, altdeg=40)
_RING = 1.5  # mm; radius of the guide


def perspective_figure(scenario: Scenario, insertion: Insertion) -> Figure:
    """Return the figure of an insertion in space with at least one period, finished or not."""
    low, high = _box(scenario, insertion)
    with apply_style(), matplotlib.rc_context({"legend.fontsize": 9.0}):
        figure = new_figure(_HEIGHT)
        figure.set_layout_engine("none")
        figure.suptitle(title_of(scenario, insertion), x=0.01, ha="left", fontsize=11, weight="bold")
        color = TARGET if insertion.reached else BAD
        verdict: dict[str, Any] = {"color": color, "fontsize": 10, "weight": "bold", "va": "top"}
        lines = wrap(insertion.summary, _LINE)
        figure.text(0.01, 1.0 - 0.36 / _HEIGHT, "\n".join(lines), **verdict)
        square = (0.0, 0.0, 1.0, WIDTH / _HEIGHT)  # into which Matplotlib draws space
        ax: Any = figure.add_axes(square, projection="3d", computed_zorder=False, facecolor="none")
        ax.set_label("perspective")
        _set_up(ax, low, high)
        room = _ROOM - [[0.0, 0.0], [0.0, (len(lines) - 1) * _LEADING / _HEIGHT]]
        _fit(figure, ax, np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3), room)
        _draw_tissue(ax, scenario, low, high)
        _draw_shadows(ax, insertion, low)
        _draw_guide(ax, scenario, insertion)
        _draw_prediction(ax, insertion, low)
        _draw_needle(ax, scenario, insertion, low)
        _draw_paths(ax, insertion)
        _draw_rolls(ax, insertion)
        _draw_target(ax, insertion)
        legend(figure, [], _marks(insertion))
    return figure


def _box(scenario: Scenario, insertion: Insertion) -> tuple[Floats, Floats]:
    """Return corners (3,) of the box that is drawn: as wide as it is high."""
    paths = [insertion.plan.tips, curves.true_path(insertion), curves.estimated_path(insertion)]
    points = np.concatenate([*(path[:, :3] for path in paths), [insertion.target]])
    guide = np.array([[0.0, *period.guide] for period in insertion.periods])
    across = np.concatenate([points, guide])[:, [Y, Z]]
    middle = 0.5 * (across.min(axis=0) + across.max(axis=0))
    half = 0.5 * float(np.ptp(across, axis=0).max()) + _AROUND
    start = scenario.setup.start_tip_x if scenario.setup.guide_x is None else scenario.setup.guide_x
    low = np.array([start - _BEHIND, *(middle - half)])
    return low, np.array([points[:, X].max() + _BEYOND, *(middle + half)])


def _to_view(points: Any) -> Floats:
    """Return columns of points (…, 3) as Matplotlib draws them (3, …): z towards the viewer, y upwards."""
    x, y, z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
    return np.stack([x, -z, y])


def _set_up(ax: Any, low: Floats, high: Floats) -> None:
    ends = np.sort(_to_view([low, high]))
    ax.set(**{f"{name}lim": tuple(pair) for name, pair in zip("xyz", ends, strict=True)})
    ax.set_box_aspect(np.ptp(ends, axis=1))
    ax.set_proj_type("persp", focal_length=0.6)
    ax.view_init(**_VIEW)
    ax.set_axis_off()


def _fit(figure: Figure, ax: Any, corners: Floats, room: Floats) -> None:
    """Place the axes so that the corners of the box (8, 3) fill `room` (2, 2), corners of a part of the figure."""
    x, y, _ = proj3d.proj_transform(*_to_view(corners), ax.get_proj())
    ends = figure.transFigure.inverted().transform(ax.transData.transform(np.column_stack([x, y])))
    scale = float(np.min(np.ptp(room, axis=0) / np.ptp(ends, axis=0)))
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    place = ax.get_position(original=True)
    corner = room.mean(axis=0) + scale * (place.p0 - middle)
    ax.set_position((*corner, scale * place.width, scale * place.height))


def _face(ax: Any, corners: Any, color: str, alpha: float, **how: Any) -> None:
    ax.add_collection3d(Poly3DCollection([_to_view(corners).T], facecolor=color, alpha=alpha, **how))


def _line(ax: Any, points: Any, *style: str, **how: Any) -> None:
    ax.plot(*_to_view(points), *style, **how)


def _name(ax: Any, point: Any, text: str, color: str, above: bool = True, side: str = "center") -> None:
    how: dict[str, Any] = {"fontsize": 10, "zorder": 9, "ha": side, "va": "bottom" if above else "top"}
    ax.text(*_to_view(point), text, color=color, **how)


def _draw_tissue(ax: Any, scenario: Scenario, low: Floats, high: Floats) -> None:
    """Draw floor and back wall, air and layers, and translucent the planes of the skin and of the layers' tops."""
    (left, bottom, back), (right, top, front) = low.tolist(), high.tolist()
    tops = [depth for depth in scenario.layer_tops if depth < right]
    colors = ["#f3f3f3", *(scene.tissue_color(scenario, layer) for layer in scenario.tissue)]
    for color, (begin, end) in zip(colors, pairwise([left, *tops, right]), strict=False):
        floor = [(begin, bottom, back), (end, bottom, back), (end, bottom, front), (begin, bottom, front)]
        wall = [(begin, bottom, back), (end, bottom, back), (end, top, back), (begin, top, back)]
        _face(ax, floor, color, 1.0, linewidth=0.0, zorder=0)
        _face(ax, wall, color, 0.6, linewidth=0.0, zorder=0)
    for depth in tops:
        color = scene.BORDER if depth else scene.SKIN
        plane = [(depth, bottom, back), (depth, top, back), (depth, top, front), (depth, bottom, front)]
        _face(ax, plane, color, 0.2, edgecolor=color, linewidth=1.2, zorder=2)
    for layer, (begin, end) in zip(scenario.tissue, pairwise([*tops, right]), strict=False):
        _name(ax, (0.5 * (begin + end), top, back), layer.name, scene.NAME)
    _name(ax, (0.0, top, back), "skin ", scene.SKIN, side="right")
    _name_depths(ax, low, high)
    _name_axes(ax, low, high)


def _name_depths(ax: Any, low: Floats, high: Floats) -> None:
    """Name depths along the front of the floor."""
    (left, bottom, _), (right, _, front) = low.tolist(), high.tolist()
    how: dict[str, Any] = {"color": QUIET, "linewidth": 0.8, "zorder": 1}
    _line(ax, [(left, bottom, front), (right, bottom, front)], **how)
    for x in range(_DEPTHS * ceil(left / _DEPTHS), ceil(right), _DEPTHS):
        _line(ax, [(x, bottom, front), (x, bottom, front + 0.8)], **how)
        _name(ax, (x, bottom, front + 1.2), format_signed(x), INK, above=False)
    between = _DEPTHS * (0.5 * (left + right) // _DEPTHS + 0.5)
    _name(ax, (between, bottom, front + 1.2), "depth (mm)", INK, above=False)


def _name_axes(ax: Any, low: Floats, high: Floats) -> None:
    """Show the directions of y and z at the front of the floor, by arrows as long as the arrows of the bevel."""
    corner = np.array([low[X], low[Y], high[Z]])
    _, up, out = _ARROW * np.eye(3)
    top, behind = corner + up, corner - out
    _arrow(ax, corner, top, QUIET, gid="axis")
    _arrow(ax, behind, corner, QUIET, gid="axis")
    _name(ax, top, "y", INK)
    _name(ax, corner, "z ", INK, side="right")


def _draw_shadows(ax: Any, insertion: Insertion, low: Floats) -> None:
    """Draw the needle's projections on the floor and on the back wall."""
    nodes = _inside(insertion.periods[-1].shape[:, :3], low)
    for axis in (Y, Z):
        shadow = nodes.copy()
        shadow[:, axis] = low[axis]
        _line(ax, shadow, color=INK, alpha=0.2, linewidth=2.2, zorder=1)


def _inside(nodes: Floats, low: Floats) -> Floats:
    """Return the part of nodes (n, k) inside the box, with its end there interpolated."""
    first = np.array([np.interp(low[X], nodes[:, X], column) for column in nodes.T])
    return np.vstack([first, nodes[nodes[:, X] > low[X]]])


def _draw_guide(ax: Any, scenario: Scenario, insertion: Insertion) -> None:
    """Draw the guide as a short tube, and its path."""
    x = scenario.setup.guide_x
    if x is None:
        return
    places = [insertion.plan.guide[0], *(period.guide for period in insertion.periods)]
    travel = np.array([(x, *place) for place in places])
    _line(ax, travel, color=GUIDE, linewidth=1.2, zorder=6)
    ends = travel[-1] + [[-1.5, 0.0, 0.0], [1.5, 0.0, 0.0]]
    _surface(ax, _tube(ends, np.full((2, 2), _RING)), GUIDE, 0.4, zorder=5.5, gid="guide")
    _name(ax, travel[-1] + [0.0, 1.3 * _RING, 0.0], "guide", GUIDE)


def _draw_prediction(ax: Any, insertion: Insertion, low: Floats) -> None:
    """Draw the predicted shape as a translucent tube, as wide as its uncertainty."""
    period = curves.prediction(insertion)
    if period is not None and (predicted := period.predicted) is not None:
        rows = _inside(np.column_stack([predicted.nodes[:, :3], predicted.sd]), low)
        _surface(ax, _tube(rows[:, :3], SDS * rows[:, 3:]), ESTIMATE, 0.18, zorder=4, gid="prediction")


def _draw_needle(ax: Any, scenario: Scenario, insertion: Insertion, low: Floats) -> None:
    nodes = _inside(insertion.periods[-1].shape[:, :3], low)
    radii = np.full((len(nodes), 2), 0.5 * scenario.needle.outer_diameter)
    _surface(ax, _tube(nodes, radii), NEEDLE, 1.0, zorder=5, gid="needle")


def _tube(centre: Floats, radii: Floats) -> Floats:
    """Return the surface (n, 33, 3) of a tube about a line (n, 3) close to the axis, with radii (n, 2) in y and z."""
    x, y, z = centre.T[:, :, None]
    around = np.linspace(0.0, 2.0 * np.pi, 33)
    return np.stack(
        [x + 0.0 * around, y + radii[:, :1] * np.cos(around), z + radii[:, 1:] * np.sin(around)], axis=-1
    )


def _surface(ax: Any, points: Floats, color: str, alpha: float, *, zorder: float, gid: str) -> None:
    """Draw a lit surface (n, m, 3), as an image inside the SVG."""
    how: dict[str, Any] = {"rstride": 1, "cstride": 1, "linewidth": 0.0, "antialiased": alpha < 1.0}
    made = ax.plot_surface(
        *_to_view(points), color=color, alpha=alpha, shade=True, lightsource=_LIGHT, zorder=zorder, **how
    )
    made.set(gid=gid, rasterized=True, edgecolor="none")


def _draw_paths(ax: Any, insertion: Insertion) -> None:
    true = curves.true_path(insertion)
    _line(ax, insertion.plan.tips[:, :3], "--", color=PLAN, linewidth=1.2, zorder=6, label="planned path")
    if len(true):
        _line(ax, true, color=TRUE, linewidth=2.0, zorder=6.5, label="true path")


class _Arrow3D(FancyArrowPatch):
    """An arrow between two points (2, 3) in space."""

    def __init__(self, points: Floats, **how: Any) -> None:
        super().__init__((0.0, 0.0), (0.0, 0.0), shrinkA=0.0, shrinkB=0.0, **how)
        self.points = points

    def do_3d_projection(self) -> float:
        """Place the arrow in the figure; return its distance from the viewer."""
        axes: Any = self.axes
        x, y, depth = proj3d.proj_transform(*_to_view(self.points), axes.M)
        self.set_positions((x[0], y[0]), (x[1], y[1]))
        return float(np.min(depth))


def _arrow(ax: Any, begin: Floats, end: Floats, color: str, gid: str) -> None:
    style = "Simple,tail_width=1.8,head_width=7,head_length=8"
    how: dict[str, Any] = {"arrowstyle": style, "color": color, "linewidth": 0.0, "zorder": 8}
    ax.add_artist(_Arrow3D(np.stack([begin, end]), gid=gid, **how))


def _draw_rolls(ax: Any, insertion: Insertion) -> None:
    """Draw the directions of the bevel at the start and after rolls."""
    rolls = [(roll, ESTIMATE) for roll in curves.applied_rolls(insertion)]
    for roll, color in [(curves.start_roll(insertion.plan), QUIET), *rolls]:
        foot = np.array(roll.point)
        _arrow(ax, foot, foot + _ARROW * np.array(roll.direction), color, gid="bevel")


def _draw_target(ax: Any, insertion: Insertion) -> None:
    """Draw the sphere of 1 mm within which the target counts as reached."""
    angles = np.linspace(0.0, np.pi, 25)
    centre = np.array(insertion.target) + np.outer(np.cos(angles), [1.0, 0.0, 0.0])
    ball = _tube(centre, np.column_stack([np.sin(angles)] * 2))
    _surface(ax, ball, TARGET, 0.4, zorder=7, gid="target")


def _marks(insertion: Insertion) -> list[Artist]:
    """Return the marks of the legend."""
    marks: list[Artist] = [
        Patch(color=NEEDLE, label="estimated needle"),
        Line2D([], [], color=PLAN, linestyle="--", linewidth=1.2, label="planned path"),
    ]
    if len(curves.true_path(insertion)):
        marks.append(Line2D([], [], color=TRUE, linewidth=2.0, label="true path"))
    marks.append(Patch(facecolor=QUIET, gid=ARROW, label="bevel at the start"))
    if curves.applied_rolls(insertion):
        marks.append(Patch(facecolor=ESTIMATE, gid=ARROW, label=APPLIED))
    period = curves.prediction(insertion)
    if period is not None:
        marks.append(Patch(color=ESTIMATE, alpha=0.3, linewidth=0.0, label=prediction_label(period)))
    return [*marks, Patch(color=TARGET, alpha=0.5, linewidth=0.0, label="target, sphere of 1 mm radius")]
