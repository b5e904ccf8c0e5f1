"""The figure of a map of entries: curves over the entry point in the plane, discs on the skin in space."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from flexneedle.figures import scene
from flexneedle.figures.layout import legend_of, mosaic, short
from flexneedle.figures.style import (
    BAD,
    BOX,
    ESTIMATE,
    INK,
    QUIET,
    ZONE,
    apply_style,
    halo,
    is_column,
    small,
)
from flexneedle.figures.zones import name_lost, named_margins
from flexneedle.planning.entry_map import EntryMap
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.zones import zones_of_record
from flexneedle.types import Flags, Floats, Y, Z

NUMBERED = 5
"""Number of the best entries that are marked."""
_COLORS = "viridis"
_SQUARE = {"clearance along": "Clearance (mm)", "offset along": "Tolerance (mm)"}  # in a column, side by side
_LAYERS, _CELLS = 40, 120  # of the silhouette of a zone
_SKIN_MM, _DEEP_MM = 0.01, 1e9
_EDGE = 0.15  # of the axes, without names
_CENTRAL = 0.1  # mm of depth in a zone for 1 mm nearer to the middle
_LONGEST = 16  # characters of a name
_ABOVE_MM = 0.2  # of the scale of clearances above the largest margin
_ROOM = 1.08  # of the disc of entries around it


class _Quantity(NamedTuple):
    """A value (E,) of the entries, its title, and the entries for which it is known."""

    title: str
    values: Floats
    known: Flags


def entries_figure(found: EntryMap) -> Figure:
    """Return the figure of a map of entries."""
    scenario, shown = found.scenario, _quantities(found)
    target = scene.place(scenario, scenario.target.position)
    clear = f"{found.clear.sum()} of {len(found.clear)} entries clear"
    title = f"{short(scenario.name, 40)}: {clear}, to {target}{name_lost(scenario)}"
    with apply_style():
        if scenario.setup.axes == 1:
            names = [name.partition(" ")[0] for name in shown]
            figure, axes = mosaic(title, 7.0, [[name] for name in names], [1.0] * len(names), [1.0])
            for ax, quantity in zip(axes.values(), shown.values(), strict=True):
                _draw_curve(ax, found, quantity)
            _name_entry(list(axes.values()))
        else:
            names = [name for name in shown if name in _SQUARE or not is_column()] or list(shown)
            rows = [names[k : k + 2] for k in range(0, len(names), 2)]
            figure, axes = mosaic(title, 4.1 * len(rows), rows, [1.0] * len(rows), [1.0] * len(rows[0]))
            for name in names:
                _draw_discs(axes[name], found, shown[name])
                if is_column() and name in _SQUARE:
                    axes[name].set_title(_SQUARE[name])
        legend_of(figure, axes.values())
    return figure


def _quantities(found: EntryMap) -> dict[str, _Quantity]:
    """Return the quantities that are known of any entry; the energy of clear ones if there are any."""
    loaded = found.clear if found.clear.any() else found.reached
    zoned = np.isfinite(found.clearance_mm)
    every = {
        "clearance along": _Quantity("Clearance from zones (mm)", found.clearance_mm, found.reached & zoned),
        "offset along": _Quantity("Tolerance of the entry point (mm)", found.offset_mm, found.clear & zoned),
        "angle": _Quantity("Tolerance of the angle (mrad)", found.angle_mrad, found.clear & zoned),
        "energy": _Quantity("Peak energy of the tissue (µJ)", found.peak_energy_uj, loaded),
    }
    some = {name: each for name, each in every.items() if each.known.any()}
    return some or {"clearance along": every["clearance along"]}


# ---- plane


def _draw_curve(ax: Axes, found: EntryMap, quantity: _Quantity) -> None:
    """Draw a quantity over y of the entry, shaded where the target is not reached, and where a margin is entered."""
    y = found.points[:, 0]
    half = 0.5 * float(y[1] - y[0])
    _shade(ax, y, half, ~found.reached, QUIET, "target not reached")
    _shade(ax, y, half, found.reached & ~found.clear, ZONE, "in the margin of a zone, or in a zone")
    values = np.where(quantity.known, quantity.values, np.nan)
    ax.plot(y, values, ".-", color=ESTIMATE, markersize=3, zorder=3)
    if quantity.title.startswith("Clearance"):
        for margin, name, style in named_margins(found.scenario):
            ax.axhline(margin, color=ZONE, linestyle=style, linewidth=1.0, label=name, zorder=2)
    for number, k in enumerate(found.best(NUMBERED)):
        how: dict[str, Any] = {"linewidth": 0.8, "linestyle": "--", "label": "next entries"}
        if not number:
            how = {"linewidth": 1.6, "label": "recommended entry"}
        ax.axvline(y[k], color=INK, zorder=2.5, **how)
    ax.set_title(quantity.title)
    ax.set_xlim(y[0] - half, y[-1] + half)


def _shade(ax: Axes, y: Floats, half: float, which: Flags, color: str, label: str) -> None:
    """Shade the entries, from half-way before each to half-way behind it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(int)))
    for first, after in edges.reshape(-1, 2):
        ax.axvspan(y[first] - half, y[after - 1] + half, color=color, alpha=0.16, linewidth=0.0, label=label)


def _name_entry(axes: list[Axes]) -> None:
    for ax in axes[:-1]:
        ax.tick_params(labelbottom=False)
    axes[-1].set_xlabel("lateral position of the entry point (mm)")


# ---- space


def _draw_discs(ax: Axes, found: EntryMap, quantity: _Quantity) -> None:
    """Draw a quantity as discs at the entry points, seen along the axis, over the silhouettes of the zones."""
    _set_up(ax, found.scenario, quantity.title)
    _draw_zones(ax, found.scenario)
    other = found.reached & ~quantity.known
    _add_discs(ax, found, ~found.reached, 0.2, color=QUIET, label="target not reached")
    inside = other & ~found.clear
    _add_discs(ax, found, inside, 0.4, color=BAD, label="in the margin of a zone, or in a zone")
    if (away := other & found.clear).any():
        _add_discs(ax, found, away, 0.4, color=ESTIMATE, label="no zone in reach")
    margins = [margin for margin, *_ in named_margins(found.scenario)]
    several = quantity.title.startswith("Clearance") and len(margins) > 1
    discs = _add_discs(ax, found, quantity.known, 0.92, cmap=_COLORS)
    if several:  # the colour alone does not show which margin is kept
        inside = quantity.known & ~found.clear
        _add_discs(ax, found, inside, 0.25, color=BAD, label="in the margin of a zone, or in a zone")
    if quantity.known.any():
        values = quantity.values[quantity.known]
        top = max(values.max(), margins[-1] + _ABOVE_MM) if several else _highest(values)
        discs.set_array(values)
        discs.set_clim(values.min(), top)
        figure: Any = ax.figure
        extend = "max" if values.max() > top else "neither"
        bar = figure.colorbar(discs, ax=ax, shrink=0.8, pad=0.02, extend=extend)
        bar.outline.set_visible(False)
        if quantity.title.startswith("Clearance"):
            _mark_margins(bar.ax, found.scenario)
    scene.draw_target(ax, found.scenario.target.position, scene.ALONG)
    for number, k in enumerate(found.best(1 if is_column() else NUMBERED), 1):
        _mark(ax, found.points[k], number)


def _highest(values: Floats) -> float:
    """Return the largest value that is no outlier: at most 3 quartile distances above the upper quartile."""
    lower, upper = np.percentile(values, [25.0, 75.0])
    return float(values[values <= upper + 3.0 * (upper - lower)].max())


def _mark_margins(bar: Axes, scenario: Scenario) -> None:
    """Mark the margins in the colour bar that it covers."""
    low, high = bar.get_ylim()
    for margin, name, _ in named_margins(scenario):
        if low < margin < high:
            bar.axhline(margin, color=INK, linewidth=1.6)
            how: dict[str, Any] = {
                "xytext": (-3, 0),
                "textcoords": "offset points",
                "ha": "right",
                "va": "center",
            }
            place = bar.get_yaxis_transform()
            bar.annotate(name, (0.0, margin), xycoords=place, fontsize=small(), **how)


def _set_up(ax: Axes, scenario: Scenario, title: str) -> None:
    entry, half = scenario.entry, _ROOM * scenario.entry.free_radius_mm
    y, z = entry.lateral_mm, entry.lateral_z_mm
    ax.set(xlim=(z - half, z + half), ylim=(y - half, y + half), aspect="equal")
    ax.set(xlabel=scene.lateral_label(scenario, Z), ylabel=scene.lateral_label(scenario, Y))
    ax.set_title(title)
    ax.locator_params(nbins=4 if is_column() else 6)


def _add_discs(ax: Axes, found: EntryMap, which: Flags, share: float, **how: Any) -> EllipseCollection:
    """Add discs with a diameter that is a share of the distance between neighbours."""
    apart = float(np.linalg.norm(found.points[1:] - found.points[0], axis=1).min())
    size, label = np.full(int(which.sum()), share * apart), how.pop("label", "_disc")
    discs = EllipseCollection(
        size, size, np.zeros(len(size)), units="xy", offsets=found.points[which, ::-1], zorder=3,
        offset_transform=ax.transData, linewidths=0.0, **how
    )  # fmt: skip
    ax.add_collection(discs, autolim=False)
    if len(size):
        ax.plot([], [], "o", color=how.get("color", INK), markersize=4, linestyle="none", label=label)
    return discs


def _mark(ax: Axes, point: Floats, number: int) -> None:
    """Mark one of the best entries, with its number where there is room."""
    size, width = (5 if is_column() else 8), (1.6 if number == 1 else 0.8)
    how: dict[str, Any] = {"markersize": size, "markerfacecolor": "none", "markeredgewidth": width}
    how["path_effects"] = halo(width + 2.0)
    label = "recommended entry" if is_column() else "recommended entry (1), and the next"
    ax.plot(*point[::-1], "o", markeredgecolor=INK, zorder=6, label=label, **how)
    if not is_column():
        beside: dict[str, Any] = {"xytext": (6, 5), "textcoords": "offset points", "fontsize": small()}
        ax.annotate(
            str(number), (point[1], point[0]), path_effects=halo(2.0), weight="bold", zorder=7, **beside
        )


def _draw_zones(ax: Axes, scenario: Scenario) -> None:
    """Draw the silhouettes of the zones down to the target, darker where they cross the skin."""
    zones = zones_of_record(scenario)
    if not zones:
        return
    z, y = (np.linspace(*limits, _CELLS) for limits in (ax.get_xlim(), ax.get_ylim()))
    x = np.linspace(_SKIN_MM, scenario.target.depth_mm, _LAYERS)
    depth, up, right = np.meshgrid(x, y, z, indexing="ij")
    clearances = zones.clearances(np.stack([depth, up, right], axis=-1))
    distances = clearances + zones.radius + zones.added[:, None, None, None]
    flat = distances.min(axis=1)
    for name, each in zip(zones.names, distances, strict=True):
        for layers, alpha in ((each, 0.16), (each[:1], 0.3)):
            least = layers.min(axis=0)
            if least.min() < 0.0:
                ax.contourf(z, y, least, [-_DEEP_MM, 0.0], colors=[ZONE], alpha=alpha, zorder=1)
                ax.contour(z, y, least, [0.0], colors=[ZONE], linewidths=0.8, zorder=4)
        if each.min() < 0.0:
            ax.fill([], [], color=ZONE, alpha=0.16, label="zone, silhouette (darker at the skin)")
            if not is_column():
                others = np.delete(flat, zones.names.index(name), axis=0).min(axis=0, initial=np.inf)
                _name(ax, z, y, each.min(axis=0), others, name)


def _name(ax: Axes, z: Floats, y: Floats, distances: Floats, others: Floats, name: str) -> None:
    """Write the name of a zone where it is deep, away from others, near the middle; not at the edge, which cuts it."""
    edge = round(_EDGE * len(z))
    right, up = np.meshgrid(z[edge:-edge], y[edge:-edge])
    inner, covered = (each[edge:-edge, edge:-edge] for each in (distances, np.maximum(-others, 0.0)))
    away = np.hypot(right - z.mean(), up - y.mean())
    k = int(np.where(inner < 0.0, inner + covered + _CENTRAL * away, np.inf).argmin())
    if inner.flat[k] >= 0.0:
        return
    where = float(right.flat[k]), float(up.flat[k])
    how: dict[str, Any] = {"color": ZONE, "fontsize": small(), "ha": "center", "va": "center"}
    ax.text(*where, short(name, _LONGEST), bbox=BOX, zorder=5, clip_on=True, **how)
