"""Zones to avoid in the scene: sections, silhouettes, margins, and the line to the nearest zone.

A section from the side is through the needle: at each depth the coordinate that is not drawn is the needle's own, so
that the needle is in a zone, or in its margin, where its curve is. A silhouette is the whole zone.
"""

from collections.abc import Iterable
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from contourpy import FillType, contour_generator
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from flexneedle.figures.layout import MOVABLE, short
from flexneedle.figures.panels import DepthPanel, Line
from flexneedle.figures.scene import ALONG, View
from flexneedle.figures.style import BAD, BOX, INK, ZONE, format_signed, is_column, small
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.zones import ZoneMap, workspace_corners, zones_of_record
from flexneedle.types import Floats, X

_CELLS, _COARSE = 360, 120  # of the raster of a section, and of a silhouette, to the right
_LAYERS = 60  # of a silhouette, in depth
_EDGE = 0.1  # no name has room in this share of axes, beside their edges
_LONGEST = 16  # characters of a name
_STYLES = (":", "-.", "--")  # of lines of margins
_DEEPEST = -1e9  # mm, below all distances


class _Raster(NamedTuple):
    """Coordinates to the right and upwards of points in axes, mm."""

    right: Floats
    up: Floats


def draw_zones(ax: Axes, scenario: Scenario, shape: Floats, view: View, *, named: bool = True) -> None:
    """Draw the zones in axes with their limits: silhouettes in space, sections through a shape (n, ≥ 3), names.

    Along the axis only silhouettes, of zones that are not deeper than the tip.
    """
    zones = zones_of_record(scenario)
    if not zones:
        return
    if scenario.setup.axes == 2:
        _draw_silhouettes(ax, zones, scenario, shape, view)
    if view != ALONG:
        _draw_sections(ax, zones, shape, view, named=named)


def _draw_silhouettes(ax: Axes, zones: ZoneMap, scenario: Scenario, shape: Floats, view: View) -> None:
    raster, out = _raster(ax, view, _COARSE), 3 - sum(view)
    low, high = (corner[out] for corner in workspace_corners(scenario))
    layers = np.linspace(low, float(shape[-1, X]) if view == ALONG else high, _LAYERS)
    for distances in zones.distances(_points(raster, view, layers[:, None, None])).min(axis=1):
        _fill(ax, raster, distances, alpha=0.14, label="zone, silhouette")


def _draw_sections(ax: Axes, zones: ZoneMap, shape: Floats, view: View, *, named: bool) -> None:
    raster = _raster(ax, view, _CELLS)
    through = np.interp(raster.right, shape[:, X], shape[:, 3 - sum(view)])
    found = zones.distances(_points(raster, view, through))
    for name, distances, margin in zip(zones.names, found, zones.kept, strict=True):
        _fill(ax, raster, distances, alpha=0.45, label="zone to avoid")
        _outline(ax, raster, distances, 0.0, "-", "_zone")
        _outline(ax, raster, distances, float(margin), "--", "margin of zones")
        if named and not is_column():
            _name(ax, raster, distances, float(margin), name)


def _raster(ax: Axes, view: View, cells: int) -> _Raster:
    """Return points in axes, in tissue only."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    step = (right - left) / cells
    first = max(left, 0.0) if view[0] == X else left
    return _Raster(np.arange(first, right + step, step), np.arange(low, high + step, step))


def _points(raster: _Raster, view: View, through: Floats) -> Floats:
    """Return points (…, up, right, 3) of a raster; through: their coordinates that are not drawn, mm."""
    right, up = np.meshgrid(*raster)
    parts = dict(zip((*view, 3 - sum(view)), np.broadcast_arrays(right, up, through), strict=True))
    return np.stack([parts[axis] for axis in range(3)], axis=-1)


def _fill(ax: Axes, raster: _Raster, distances: Floats, *, alpha: float, label: str) -> None:
    """Fill the points inside a zone."""
    made = contour_generator(*raster, distances, fill_type=FillType.OuterCode)
    found: Any = made.filled(_DEEPEST, 0.0)
    for area, code in zip(*found, strict=True):
        how: dict[str, Any] = {"facecolor": ZONE, "alpha": alpha, "linewidth": 0.0, "zorder": 1.5}
        ax.add_patch(PathPatch(Path(area, code), label=label, **how))


def _outline(ax: Axes, raster: _Raster, distances: Floats, level: float, style: str, label: str) -> None:
    how: dict[str, Any] = {"color": ZONE, "linewidth": 0.9, "zorder": 2.1, "scalex": False, "scaley": False}
    for line in contour_generator(*raster, distances).lines(level):
        ax.plot(*np.asarray(line).T, style, label=label, **how)


def _name(ax: Axes, raster: _Raster, distances: Floats, margin: float, name: str) -> None:
    """Write the name of a zone at its deepest point in the axes, or in its margin (mm), if it is in them."""
    edge = round(_EDGE * len(raster.up))
    inner = distances[edge:-edge, edge : -round(_EDGE * len(raster.right))]
    row, column = np.unravel_index(int(inner.argmin()), inner.shape)
    if inner[row, column] < margin:
        where = float(raster.right[edge + column]), float(raster.up[edge + row])
        how: dict[str, Any] = {"ha": "center", "va": "center", "color": INK, "fontsize": small()}
        ax.text(*where, short(name, _LONGEST), clip_on=True, zorder=8, bbox=BOX, **how).set_in_layout(False)


def draw_nearest(
    ax: Axes, scenario: Scenario, shapes: Iterable[Floats], clearance: float, view: View
) -> None:
    """Draw a line from shapes (n, ≥ 3) of the needle to the nearest zone, with the clearance (mm)."""
    near = zones_of_record(scenario).closest(np.stack(list(shapes)), clearance)
    if near is None:
        return
    ends = np.array([near.needle, near.surface])[:, view]
    how: dict[str, Any] = {"color": BAD if near.clearance < near.margin else INK, "zorder": 8}
    ax.plot(*ends.T, linewidth=0.9, marker=".", markersize=4, label="least clearance", **how)
    if is_column():
        return
    up = np.sign(ends[0, 1] - ends[1, 1]) or 1.0  # away from the zone
    beside: dict[str, Any] = {"xytext": (0, 9 * up), "textcoords": "offset points", "gid": MOVABLE}
    beside |= {"ha": "center", "va": "center", "bbox": BOX}
    text = f"{format_signed(near.clearance, '.2f')} mm"
    ax.annotate(text, ends[0], fontsize=small(), **beside, **how).set_in_layout(False)


def clearance_panel(scenario: Scenario, lines: Iterable[Line]) -> DepthPanel:
    """Return the panel of lines of clearances over depth, with the margins."""
    shown = [
        Line(one.name, one.x, np.where(np.isfinite(one.y), one.y, np.nan), one.color, one.style)
        for one in lines
    ]
    depths = np.concatenate([line.x[np.isfinite(line.y)] for line in shown])
    ends = np.array([depths.min(), depths.max()])
    margins = [
        Line(name, ends, np.full(2, margin), BAD, style) for margin, name, style in named_margins(scenario)
    ]
    return DepthPanel("Clearance from zones (mm)", [*shown, *margins], 1.0)


def named_margins(scenario: Scenario) -> list[tuple[float, str, str]]:
    """Return the margins (mm) of zones, each with its name, of which zones if they differ, and its style of line."""
    zones = zones_of_record(scenario)
    found: dict[float, list[str]] = {}
    for margin, name in sorted(zip(zones.margins.tolist(), zones.names, strict=True)):
        found.setdefault(margin, []).append(name)
    if len(found) < 2:
        return [(margin, "margin", _STYLES[0]) for margin in found]
    return [
        (margin, f"margin of {short(', '.join(names), _LONGEST)}", style)
        for (margin, names), style in zip(found.items(), cycle(_STYLES), strict=False)
    ]


def name_lost(scenario: Scenario) -> str:
    """Return the end of a title that names the zones that are not drawn, "" for none."""
    line = zones_of_record(scenario).lost_zones
    return f"; {line}" if line else ""


def has_clearance(clearances: Floats) -> bool:
    """Return whether a needle came near enough to zones for its clearances (mm) to be finite."""
    return bool(np.isfinite(clearances).any())
