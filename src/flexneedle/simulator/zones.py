"""The zones of a scenario as arrays of the kernels, with what is added to their margins.

A zone is larger here than in the scenario by what is not known or not computed: 2.33 times the standard deviation of
the image's registration, the error of a grid of distances, and the sag of the path between two contacts. So a clearance
is a bound. A zone whose margin exceeds the least one is larger by the difference, too: each clearance is compared with
the least margin.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.mechanics import zones as kernels
from flexneedle.plugins import load_part
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections import zones as sections
from flexneedle.scenario.zone_files import find_lost, stamp_of
from flexneedle.simulator.state import State
from flexneedle.types import Floats

GROUP = "flexneedle.images"
"""Entry points of readers of images: `distances` maps a `ZoneFile`, the map of its image to the insertion frame and a
`Workspace` to a `FileZone`."""
_SMALL_MM = 1e-4  # for slopes of distances
_BEYOND_MM = 1.0  # beyond margin and allowance, up to which distances are computed
_STEEP = 0.05  # by which the distance of two contacts may exceed their spacing
BESIDE_MM = 10.0
"""Largest deflection of the needle beyond target and entry, of its workspace."""


class Workspace(NamedTuple):
    """The region of the insertion frame that the needle may reach: its corners (3,), mm.

    far: distance (mm) up to which distances in it are wanted; near: the least distance (mm) of the needle's axis from a
    zone that is wanted in a plan, from which on distances must not be too large.
    """

    low: Floats
    high: Floats
    far: float
    near: float


class DistanceGrid(NamedTuple):
    """Distances (a, b, c), mm, from a zone, negative inside, on a grid from its first corner (3,) with a spacing (mm).

    bound: largest distance (mm) by which a value, or an interpolated one, may exceed the true distance at `near` (mm)
    or more from the zone.
    """

    values: Floats
    first: Floats
    spacing: float
    bound: float


class ZoneImage(NamedTuple):
    """An image with zones, a box beyond which zones are unknown.

    name: of its file; center (3,) and half (3,): half the lengths of its edges, mm; axes (3, 3): their
    directions, rows; notes: what its reader assumed.
    """

    name: str
    center: Floats
    half: Floats
    axes: Floats
    notes: tuple[str, ...] = ()

    def beyond(self, points: Floats) -> Floats:
        """Return the distances (…), mm, of points (…, 3) from the image, 0 inside."""
        outside = np.maximum(np.abs((points - self.center) @ self.axes.T) - self.half, 0.0)
        found: Floats = np.linalg.norm(outside, axis=-1)
        return found


class FileZone(NamedTuple):
    """A zone in a file: its distances, None where it is out of reach, and its image, None for a surface."""

    grid: DistanceGrid | None
    image: ZoneImage | None


class Nearest(NamedTuple):
    """Place where a needle is nearest to a zone, or deepest in its margin.

    zone: its name; clearance and margin: mm; needle, surface (3,): points of axis and zone.
    """

    zone: str
    clearance: float
    margin: float
    needle: Floats
    surface: Floats


@dataclass(frozen=True, eq=False)
class ZoneMap:
    """Zones of a scenario, z of them.

    Attributes:
        names: Names of the zones.
        margin: The least margin (mm).
        margins: Margin of each zone (z,), mm.
        added: What is added to each margin (z,), mm.
        packed: The zones for searches, larger by what is added and by the difference of their margins.
        exact: The zones for results, larger by what is added, with distances at any distance.
        radius: Radius of the needle (mm).
        spacing: Largest distance (mm) between two points of the needle for which clearances are bounds.
        out_of_reach: Names of the zones that the needle cannot reach; distances from them are infinite.
        images: Images of the zones, each once.
        lost: Of zones whose file cannot be used, by number, the reason; distances from them are infinite.
    """

    names: tuple[str, ...]
    margin: float
    margins: Floats
    added: Floats
    packed: kernels.Zones
    exact: kernels.Zones
    radius: float
    spacing: float
    out_of_reach: tuple[str, ...] = ()
    images: tuple[ZoneImage, ...] = ()
    lost: Mapping[int, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.names)

    @property
    def kept(self) -> Floats:
        """Distances (z,), mm, from the zones that the axis of the needle keeps with the margins."""
        return self.margins + self.added + self.radius

    @property
    def lost_zones(self) -> str:
        """Line that names the lost zones, "" without any."""
        names = ", ".join(self.names[number] for number in self.lost)
        return f"zone not drawn, since its file is missing or has changed: {names}" if names else ""

    def clearances(self, points: Floats) -> Floats:
        """Return the clearances (z, …), mm, of the needle's surface at points (…, 3) of its axis; they are bounds.

        Points before the skin are clear: infinite.
        """
        return np.where(points[..., 0] <= 0.0, np.inf, self._bounds(points) - self.radius)

    def shape_clearances(self, shapes: Floats) -> Floats:
        """Return the least clearance (…), mm, of each shape (…, n, ≥ 3) of the needle; it is a bound."""
        found: Floats = self.clearances(self._refine(shapes)).min(axis=(0, -1), initial=np.inf)
        return found

    def _refine(self, shapes: Floats) -> Floats:
        """Return points (…, m, 3) of shapes (…, n, ≥ 3), as near to each other as the bound on their sag assumes."""
        nodes = shapes[..., :3]
        steps = np.diff(nodes, axis=-2)[..., None, :]
        parts = max(1, math.ceil(np.linalg.norm(steps, axis=-1).max(initial=0.0) / self.spacing - _STEEP))
        between = nodes[..., :-1, None, :] + np.arange(parts)[:, None] / parts * steps
        return np.concatenate([between.reshape(*nodes.shape[:-2], -1, 3), nodes[..., -1:, :]], axis=-2)

    def distances(self, points: Floats) -> Floats:
        """Return the distances (z, …), mm, of points (…, 3) from the zones as in the scenario, negative inside."""
        return self._bounds(points) + self.added.reshape(-1, *(1 for _ in points.shape[:-1]))

    def _bounds(self, points: Floats) -> Floats:
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        found = np.empty((len(self.names), len(flat)))
        kernels.fill_distances(self.exact, flat, found)
        return found.reshape(len(self.names), *points.shape[:-1])

    def least_clearances(self, points: Floats) -> Floats:
        """Return the least clearances (…), mm, at points (…, 3) of the needle's axis, as a search compares them."""
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        found = np.empty(len(flat))
        kernels.fill_least_distances(self.packed, flat, found)
        return found.reshape(points.shape[:-1]) - self.radius

    def slopes(self, points: Floats) -> Floats:
        """Return the derivatives (n, 3) of `least_clearances` at points (n, 3); 0 where these are far from zones."""
        moved = points[:, None, None] + _SMALL_MM * np.array([1.0, -1.0])[:, None] * np.eye(3)[:, None]
        found = self.least_clearances(moved)
        slopes: Floats = (found[..., 0] - found[..., 1]) / (2.0 * _SMALL_MM)
        return slopes

    def clearance_of(self, state: State) -> float:
        """Return the least clearance (mm) of a state; infinite before the skin."""
        return float(self.clearances(state.body).min(initial=np.inf)) if self else np.inf

    def nearest(self, points: Floats) -> "Nearest":
        """Return where points (n, 3) of the needle's axis, of which one at least is in tissue, are nearest to a zone.

        Zones are compared by clearance less margin.
        """
        found = self.clearances(points)
        zone, at = np.unravel_index(int((found - self.margins[:, None]).argmin()), found.shape)
        return self._nearest(int(zone), points[at], float(found[zone, at]))

    def closest(self, shapes: Floats, recorded: float = math.inf) -> "Nearest | None":
        """Return where shapes (…, n, ≥ 3) of the needle have their least clearance; None if none is in tissue.

        None, too, if a zone is lost, since it may be the nearest.

        recorded: clearance (mm) of the result, known from the contacts, which are finer than shapes.
        """
        if self.lost:
            return None
        points = self._refine(shapes).reshape(-1, 3)
        found = self.clearances(points)
        if not np.isfinite(found).any():
            return None
        zone, at = np.unravel_index(int(found.argmin()), found.shape)
        near = self._nearest(int(zone), points[at], float(found[zone, at]))
        return near._replace(clearance=recorded) if math.isfinite(recorded) else near

    def _nearest(self, zone: int, here: Floats, clearance: float) -> "Nearest":
        """Return a point (3,) of the axis, its clearance (mm) from a zone, and the point of the zone."""
        ends = here + _SMALL_MM * np.concatenate([np.eye(3), -np.eye(3)])
        around = np.empty((len(self.names), 6))
        kernels.fill_distances(self.exact, ends, around)
        slope = (around[zone, :3] - around[zone, 3:]) / (2.0 * _SMALL_MM)
        touched = here - (clearance + self.added[zone] + self.radius) * slope
        return Nearest(self.names[zone], clearance, float(self.margins[zone]), here, touched)


def zones_of(scenario: Scenario) -> ZoneMap:
    """Return the zones of a scenario. Raises InputError for a file that cannot be used."""
    return _make_zones(scenario, {})


def zones_of_record(scenario: Scenario) -> ZoneMap:
    """Return the zones of a recorded scenario, for views: those whose file is missing or has changed are `lost`."""
    return _make_zones(scenario, find_lost(scenario))


def _make_zones(scenario: Scenario, lost: Mapping[int, str]) -> ZoneMap:
    if not scenario.zone:
        return NO_ZONES
    files = tuple(stamp_of(zone) for number, zone in enumerate(scenario.zone) if number not in lost)
    workspace, spacing = workspace_corners(scenario), scenario.contact.spacing_mm
    return _zones_of(
        scenario.zone,
        scenario.zones,
        scenario.image.model_copy(update={"doubts": None}),
        scenario.needle.outer_diameter,
        spacing,
        workspace,
        tuple(lost.items()),
        files,
    )


@lru_cache(maxsize=8)
def _zones_of(
    zones: tuple[sections.Zone, ...],
    settings: sections.ZoneSettings,
    image: sections.ImageSettings,
    diameter: float,
    spacing: float,
    corners: tuple[tuple[float, ...], tuple[float, ...]],
    without: tuple[tuple[int, str], ...],
    _files: tuple[tuple[int, int] | None, ...],
) -> ZoneMap:
    """Return the map of zones.

    corners: of the workspace; without: numbers of lost zones, and reasons; _files: time and size of the files, of which
    it is made.
    """
    margins = np.array([settings.margin_mm if zone.margin_mm is None else zone.margin_mm for zone in zones])
    least, radius = float(margins.min()), 0.5 * diameter
    always = sections.REGISTRATION_SDS * image.sd_mm + sag(spacing, least + radius)
    far = float(margins.max()) + always + radius + _BEYOND_MM
    low, high = map(np.array, corners)
    workspace = Workspace(low, high, far, least + radius)
    lost = dict(without)
    made = [
        _Made(_NOWHERE) if number in lost else _SHAPES[type(zone)](zone, image, workspace)
        for number, zone in enumerate(zones)
    ]
    shapes, added = [one.shape for one in made], np.array([always + one.bound for one in made])
    packed = kernels.pack(shapes, least + radius + _BEYOND_MM, added + margins - least)
    exact = kernels.Zones(kernels.pack(shapes, np.inf, added).rows, packed.fields, np.inf)
    names = tuple(zone.name for zone in zones)
    away = tuple(
        name for number, name in enumerate(names) if made[number].shape is _NOWHERE and number not in lost
    )
    images = tuple({one.image.name: one.image for one in made if one.image}.values())
    return ZoneMap(names, least, margins, added, packed, exact, radius, spacing, away, images, lost)


def target_intrusion(scenario: Scenario) -> str:
    """Return which zone's margin the target is in, "" for none. Raises InputError for a file that cannot be used."""
    if not scenario.zone:
        return ""
    zones, target = zones_of(scenario), np.array(scenario.target.position)
    for name, distance, kept in zip(zones.names, zones.distances(target), zones.kept, strict=True):
        if distance < kept:
            return (
                f"target: {distance:.2f} mm from zone {name}, within its margin: must be at least {kept:.2f} mm "
                "(margin, what is added to it, and radius of the needle)"
            )
    return ""


def sag(spacing: float, distance: float) -> float:
    """Return by how much the middle of two points may be nearer to a point at this distance from both (mm)."""
    half = min(0.5 * spacing, distance)
    return distance - math.sqrt(distance**2 - half**2)


def workspace_corners(scenario: Scenario) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the corners of what the needle may reach below the skin."""
    entry, setup, depth = scenario.entry, scenario.setup, scenario.setup.max_depth
    steep = abs(entry.slope) + 1e-3 * entry.free_slope_mrad
    reach = entry.free_radius_mm + steep * depth + setup.max_lateral + BESIDE_MM
    low, high = (
        (x, entry.lateral_mm + side * reach, entry.lateral_z_mm + side * reach)
        for x, side in ((0.0, -1.0), (depth, 1.0))
    )
    return low, high


# ---- shapes, each with a bound (mm) of the error of its distances


class _Made(NamedTuple):
    shape: kernels.Zone
    bound: float = 0.0
    image: ZoneImage | None = None


_NOWHERE = kernels.half_space((-np.inf, 0.0, 0.0), (1.0, 0.0, 0.0))


def _sphere(zone: sections.Sphere, _image: object, _workspace: object) -> _Made:
    return _Made(kernels.capsule(zone.center_mm, zone.center_mm, zone.radius_mm))


def _capsule(zone: sections.Capsule, _image: object, _workspace: object) -> _Made:
    return _Made(kernels.capsule(zone.from_mm, zone.to_mm, zone.radius_mm))


def _box(zone: sections.Box, _image: object, _workspace: object) -> _Made:
    axes = to_matrix(np.array(zone.rotation)).T
    return _Made(kernels.box(zone.center_mm, 0.5 * np.array(zone.size_mm), axes))


def _half_space(zone: sections.HalfSpace, _image: object, _workspace: object) -> _Made:
    return _Made(kernels.half_space(zone.point_mm, zone.normal))


def _file(zone: sections.ZoneFile, image: sections.ImageSettings, workspace: Workspace) -> _Made:
    reader = load_part("distances", (), GROUP)
    to_needle = Rigid(to_matrix(np.array(image.rotation)), np.array(image.translation_mm))
    found: FileZone = reader(zone, to_needle, workspace)
    if found.grid is None:
        return _Made(_NOWHERE, image=found.image)
    values, first, spacing, bound = found.grid
    return _Made(kernels.grid(values, first, np.full(3, spacing)), bound, found.image)


_SHAPES: dict[type[sections.Zone], Callable[..., _Made]] = {
    sections.Sphere: _sphere,
    sections.Capsule: _capsule,
    sections.Box: _box,
    sections.HalfSpace: _half_space,
    sections.ZoneFile: _file,
}

NO_ZONES = ZoneMap((), 0.0, np.empty(0), np.empty(0), kernels.NO_ZONES, kernels.NO_ZONES, 0.0, 1.0)
"""The map of a scenario without zones."""
