"""A synthetic abdomen: skin, fat, muscle, ribs, liver with vessels and two lesions, drawn from a seed.

The right side of a trunk, RAS (mm), its axis along z. Depths are below the skin, towards that axis. Layer 0 of the
label map has the tissues, layer 1 ribs, vessels and lesions, which overlap them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.markups import POINTS, ControlPoint, Markup
from flexneedle.types import Flags, Floats

TISSUES = ("skin", "fat", "muscle", "liver", "other organs")
STRUCTURES = ("ribs", "vessels", "lesion 1", "lesion 2")
SEGMENTS = tuple(
    Segment(layer, label, name)
    for layer, names in enumerate((TISSUES, STRUCTURES))
    for label, name in enumerate(names, 1)
)
_LOW, _HIGH = np.array([-30.0, -125.0, -75.0]), np.array([170.0, 125.0, 75.0])  # of the image
_ENTRIES, _LINES = 10, 80  # tried for a lesion
_FREE_MM, _FREE_RAD, _CLEAR_MM, _TOUCHED_MM = 12.0, 0.18, 3.5, 1.0  # of lines
_LARGEST_TILT = 0.1  # rad


class Abdomen(NamedTuple):
    """An abdomen: a label map, and for each lesion its point "target N" and an entry "entry N" on the skin."""

    image: LabelMap
    points: Markup


@dataclass(frozen=True)
class _Body:
    """Sizes (mm) and angles (rad) of an anatomy."""

    half_width: float
    half_depth: float
    fat: float
    fat_change: float  # relative, along the circumference
    fat_turn: float
    muscle: float
    rib_pitch: float
    rib_start: float
    rib_drop: float  # mm for each rad towards the front
    taper: float  # relative, for each 100 mm along z

    skin: float = 2.0

    def radius(self, angle: Floats, z: Floats) -> Floats:
        """Return the distance of the skin from the trunk's axis."""
        ellipse = np.hypot(np.cos(angle) / self.half_width, np.sin(angle) / self.half_depth)
        radius: Floats = (1.0 + 0.01 * self.taper * z) / ellipse
        return radius

    def fat_end(self, angle: Floats) -> Floats:
        """Return the depth at which the fat ends."""
        end: Floats = self.skin + self.fat * (1.0 + self.fat_change * np.cos(angle - self.fat_turn))
        return end

    def rib(self, angle: Floats, z: Floats, depth: Floats) -> Flags:
        """Return whether points are in a rib: 7 mm thick and 11 mm high, in the middle of the muscle."""
        off = (z - self.rib_start + self.rib_drop * angle) / self.rib_pitch
        beside = (off - np.rint(off)) * self.rib_pitch
        middle = self.fat_end(angle) + 0.5 * self.muscle
        flags: Flags = ((depth - middle) / 3.5) ** 2 + (beside / 5.5) ** 2 <= 1.0
        return flags

    def skin_point(self, angle: float, z: float) -> Floats:
        """Return a point (3,) of the skin."""
        radius = float(self.radius(np.array(angle), np.array(z)))
        return np.array([radius * np.cos(angle), radius * np.sin(angle), z])

    def inward(self, angle: float, z: float) -> Floats:
        """Return the unit vector (3,) into the body at a point of the skin."""
        small = 1e-3
        along = self.skin_point(angle + small, z) - self.skin_point(angle - small, z)
        up = self.skin_point(angle, z + small) - self.skin_point(angle, z - small)
        normal = np.cross(up, along)
        inward: Floats = normal / np.linalg.norm(normal)
        return inward


def make_abdomen(seed: int, spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Abdomen:
    """Return the abdomen of a seed with voxels of these sizes (mm) along x, y, z: the same anatomy at any size.

    The straight line from each entry to its target runs into a vessel, the first one into a rib, too. From within 12 mm
    of each entry and 0.18 rad of its line another straight line is clear by 3.5 mm.
    """
    rng = np.random.default_rng(seed)
    body = _draw_body(rng)
    tubes = _draw_vessels(rng)
    lesions: list[_Lesion] = []
    while len(lesions) < 2:
        found = _draw_lesion(rng, body, tubes, lesions)
        if found is not None:
            lesions.append(found)
            tubes.append(found.vessel)
    points = []
    for number, each in enumerate(lesions, 1):
        points += [_point(f"entry {number}", each.entry), _point(f"target {number}", each.centre)]
    return Abdomen(_voxels(body, tubes, lesions, spacing), Markup(POINTS, "points", tuple(points)))


def _point(label: str, position: Floats) -> ControlPoint:
    x, y, z = np.round(position, 3).tolist()
    return ControlPoint(label, (x, y, z))


def _draw_body(rng: np.random.Generator) -> _Body:
    return _Body(
        half_width=rng.uniform(140.0, 160.0),
        half_depth=rng.uniform(95.0, 115.0),
        fat=rng.uniform(6.0, 13.0),
        fat_change=rng.uniform(0.0, 0.25),
        fat_turn=rng.uniform(-np.pi, np.pi),
        muscle=rng.uniform(9.0, 12.0),
        rib_pitch=rng.uniform(27.0, 33.0),
        rib_start=rng.uniform(0.0, 30.0),
        rib_drop=rng.uniform(10.0, 25.0),
        taper=rng.uniform(-0.05, 0.05),
    )


Tube = tuple[Floats, Floats]
"""Points (n, 3) of a vessel's middle and its radii (n,), mm."""


def _draw_vessels(rng: np.random.Generator) -> list[Tube]:
    """Return the branches of a portal vein from the liver's hilum: curved, each divided in two."""
    tubes: list[Tube] = []
    tips = [(np.array([15.0, -10.0, -15.0]), np.array([1.0, 0.1, 0.2]), 6.0)]
    for _generation in range(5):
        grown = []
        for start, direction, radius in tips:
            line = _draw_line(rng, start, direction, length=rng.uniform(20.0, 34.0))
            end = radius * 0.85
            tubes.append((line, np.linspace(radius, end, len(line))))
            heading = line[-1] - line[-2]
            for side in (-1.0, 1.0):
                turned = heading / np.linalg.norm(heading) + side * 0.55 * _unit(rng) + 0.15 * _unit(rng)
                grown.append((line[-1], turned, end * 0.78))
        tips = grown
    return tubes


def _draw_line(rng: np.random.Generator, start: Floats, direction: Floats, length: float) -> Floats:
    """Return points (n, 3), 1 mm apart, of a line that bends with a radius of about 40 mm."""
    heading, bend = direction / np.linalg.norm(direction), _unit(rng) / 40.0
    points = [start]
    for _ in range(int(length)):
        heading = heading + bend
        heading = heading / np.linalg.norm(heading)
        points.append(points[-1] + heading)
    return np.array(points)


def _unit(rng: np.random.Generator) -> Floats:
    vector = rng.normal(size=3)
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


class _Lesion(NamedTuple):
    """A lesion: its centre (3,) and radius, mm, the entry (3,) to it, and the vessel before it."""

    centre: Floats
    radius: float
    entry: Floats
    vessel: Tube


def _draw_lesion(
    rng: np.random.Generator, body: _Body, tubes: list[Tube], others: list[_Lesion]
) -> _Lesion | None:
    """Return a lesion with its entry, None if the drawn place is not suitable."""
    angle, z, radius = rng.uniform(-0.3, 0.7), rng.uniform(-35.0, 35.0), rng.uniform(5.0, 9.0)
    centre = body.skin_point(angle, z) + rng.uniform(48.0, 62.0) * body.inward(angle, z)
    if any(np.linalg.norm(centre - other.centre) < 40.0 for other in others):
        return None
    for _ in range(_ENTRIES):
        turned, height = angle + rng.normal(0.0, 0.1), z + rng.normal(0.0, 5.0)
        entry = body.skin_point(turned, height)
        way = centre - entry
        depth = float(np.linalg.norm(way))
        if way @ body.inward(turned, height) < depth * np.cos(_LARGEST_TILT):
            continue
        if not others and not _rib_distances(body, entry[None], centre)[0] < _TOUCHED_MM:
            continue
        across = np.cross(way, rng.normal(size=(_LINES, 3)))
        across /= np.linalg.norm(across, axis=1)[:, None]
        off = rng.uniform(0.0, min(_FREE_MM, _FREE_RAD * depth), (_LINES, 1)) * across
        below = float(body.fat_end(np.array(turned))) + body.muscle + rng.uniform(5.0, 8.0)
        vessel = _draw_vessel_before(rng, tubes[0][0][-1], entry, way, below)
        if _has_clear_line(body, [*tubes, vessel], entry + off, centre):
            return _Lesion(centre, radius, entry, vessel)
    return None


def _draw_vessel_before(
    rng: np.random.Generator, start: Floats, entry: Floats, way: Floats, depth: float
) -> Tube:
    """Return a vessel, 4 to 6 mm thick, that starts at a point (3,) and crosses the way from an entry to a target.

    depth: of the crossing below the entry (mm).
    """
    crossed = entry + depth * _unit_of(way)
    along = _unit_of(np.cross(way, rng.normal(size=3)))
    beside = _unit_of(np.cross(way, along))
    crossed = crossed + rng.uniform(1.5, 2.0) * beside
    ends = crossed - 25.0 * along + 8.0 * _unit_of(way), crossed + 20.0 * along + 4.0 * _unit_of(way)
    share = np.linspace(0.0, 1.0, 120)[:, None]
    control = ends[0] - 20.0 * along + 25.0 * _unit_of(way)
    to_it = (1 - share) ** 2 * start + 2 * share * (1 - share) * control + share**2 * ends[0]
    # A parabola through the crossed point.
    across_it = (
        (1 - share) * (1 - 2 * share) * ends[0]
        + 4 * share * (1 - share) * crossed
        - share * (1 - 2 * share) * ends[1]
    )
    line = np.concatenate([to_it, across_it])
    return line, np.linspace(2.8, rng.uniform(1.7, 2.0), len(line))


def _voxels(
    body: _Body, tubes: list[Tube], lesions: list[_Lesion], spacing: tuple[float, float, float]
) -> LabelMap:
    """Return the label map; its first axis goes to the left and its second to the back, as of computed tomography."""
    sizes = np.array(spacing, dtype=float)
    shape = np.floor((_HIGH - _LOW) / sizes).astype(int)
    affine = np.diag([-sizes[0], -sizes[1], sizes[2], 1.0])
    affine[:3, 3] = [_HIGH[0] - 0.5 * sizes[0], _HIGH[1] - 0.5 * sizes[1], _LOW[2] + 0.5 * sizes[2]]
    x, y, z = (affine[k, k] * np.arange(shape[k]) + affine[k, 3] for k in range(3))
    labels = np.zeros((2, *shape), np.uint8)
    angle, off = np.arctan2(y[None, :], x[:, None]), np.hypot(x[:, None], y[None, :])
    for k, height in enumerate(z):
        labels[0, :, :, k], labels[1, :, :, k] = _slice(body, x, y, height, angle, off)
    liver = labels[0] == TISSUES.index("liver") + 1
    for line, radii in tubes:
        for point, radius in zip(line, radii, strict=True):
            _draw_ball(labels[1], liver, affine, point, radius, STRUCTURES.index("vessels") + 1)
    for number, each in enumerate(lesions, 1):
        _draw_ball(
            labels[1], liver, affine, each.centre, each.radius, STRUCTURES.index(f"lesion {number}") + 1
        )
    return LabelMap(labels, affine, SEGMENTS)


def _slice(
    body: _Body, x: Floats, y: Floats, z: float, angle: Floats, off: Floats
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the labels of tissues and of ribs of a slice."""
    height = np.array(z)
    depth = body.radius(angle, height) - off
    fat_end = body.fat_end(angle)
    cavity = depth - fat_end - body.muscle
    in_liver = ((x[:, None] - 75.0) / 85.0) ** 2 + ((y[None, :] - 5.0) / 95.0) ** 2 + (z / 80.0) ** 2 <= 1.0
    choices = [depth < 0.0, depth < body.skin, depth < fat_end, cavity < 0.0, in_liver & (cavity > 1.5)]
    tissues = np.select(choices, [0, 1, 2, 3, 4], 5).astype(np.uint8)
    return tissues, body.rib(angle, height, depth).astype(np.uint8)


def _draw_ball(
    labels: NDArray[np.uint8], within: Flags, affine: Floats, centre: Floats, radius: float, label: int
) -> None:
    """Set a label at the voxels of a mask whose centres are in a ball."""
    sizes, at = np.abs(np.diag(affine)[:3]), (centre - affine[:3, 3]) / np.diag(affine)[:3]
    first = np.maximum(np.ceil(at - radius / sizes), 0).astype(int)
    last = np.minimum(np.floor(at + radius / sizes) + 1, labels.shape).astype(int)
    if (first >= last).any():
        return
    window = tuple(map(slice, first, last))
    axes = [
        (np.arange(low, high) - middle) * size
        for low, high, middle, size in zip(first, last, at, sizes, strict=True)
    ]
    square = axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2
    labels[window][(square <= radius**2) & within[window]] = label


# ---- lines from an entry to a target


def _has_clear_line(body: _Body, tubes: list[Tube], entries: Floats, end: Floats) -> bool:
    """Return whether a line from one of the entries (n, 3) to an end is clear of ribs and vessels."""
    beside_ribs = entries[_rib_distances(body, entries, end) >= _CLEAR_MM]
    if not len(beside_ribs):
        return False
    centres, radii = (np.concatenate([tube[k][::2] for tube in tubes]) for k in range(2))
    lines = _lines(beside_ribs, end)
    near = np.linalg.norm(centres - lines.mean(axis=(0, 1)), axis=1) < 50.0
    apart = np.linalg.norm(lines[..., None, :] - centres[near], axis=-1) - radii[near]
    return bool(apart.min(axis=(1, 2)).max() >= _CLEAR_MM)


def _rib_distances(body: _Body, entries: Floats, end: Floats) -> Floats:
    """Return about the least distances (n,), mm, of lines from entries (n, 3) to an end from ribs; at most 5."""
    points = _lines(entries, end)
    z, found = points[..., 2], np.full(len(points), 5.0)
    angle, off = np.arctan2(points[..., 1], points[..., 0]), np.hypot(points[..., 0], points[..., 1])
    depth = body.radius(angle, z) - off
    for beside in np.linspace(-4.0, 4.0, 9):
        touched = body.rib(angle, z + beside, depth).any(axis=1)
        found[touched] = np.minimum(found[touched], abs(beside))
    return found


def _lines(entries: Floats, end: Floats) -> Floats:
    """Return points (n, 50, 3) of lines."""
    share = np.linspace(0.0, 1.0, 50)[:, None]
    points: Floats = entries[:, None] + share * (end - entries[:, None])
    return points


def _unit_of(vector: Floats) -> Floats:
    unit: Floats = vector / np.linalg.norm(vector)
    return unit
