"""Distances from a zone in a file: a segment of a label map, or a closed surface, on a grid of the needle's frame."""

import math
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import make_refusal
from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.mesh_voxels import voxelise
from flexneedle.lab.images.meshes import SUFFIXES, read_mesh
from flexneedle.lab.images.volumes import read_label_map
from flexneedle.lab.images.voxels import Voxels
from flexneedle.scenario.sections.zones import ZoneFile
from flexneedle.simulator.zones import DistanceGrid, FileZone, Workspace, ZoneImage
from flexneedle.types import Flags, Floats

_FINEST_MM, _MOST_CELLS = 0.5, 1_000_000  # of the grid; the kernels keep 8 numbers a cell
_EDGES_MM, _MOST_VOXELS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0), 4_000_000  # of the distance transform
_SQUARE = 1e-4  # largest cosine of two axes of an image


class _Box(NamedTuple):
    """An axis-aligned box between two corners (3,)."""

    low: Floats
    high: Floats

    def corners(self) -> Floats:
        """Return the corners (8, 3)."""
        return np.array(list(product(*zip(self.low, self.high, strict=True))))

    def grow(self, by: Floats | float) -> "_Box":
        """Return the box with each face moved outwards."""
        return _Box(self.low - by, self.high + by)

    def within(self, other: "_Box") -> "_Box":
        """Return what is common to two boxes, which may be empty."""
        return _Box(np.maximum(self.low, other.low), np.minimum(self.high, other.high))


def distances(zone: ZoneFile, to_needle: Rigid, workspace: Workspace) -> FileZone:
    """Return the distances from a zone in a file, None if it is not near the workspace, and its image.

    to_needle: map from RAS to the needle's frame. Raises InputError, one line, for a file that cannot be used.
    """
    try:
        voxels, image = _read_voxels(zone, to_needle)
        return FileZone(_grid(voxels, workspace), image)
    except InputError as error:
        raise InputError(f"zone {zone.name}: {error}") from None


def _read_voxels(zone: ZoneFile, to_needle: Rigid) -> tuple[Voxels, ZoneImage | None]:
    """Return the voxels of a zone in the needle's frame, and its image."""
    path = Path(zone.file)
    if path.name.lower().endswith(SUFFIXES):
        if zone.segment is not None or zone.label is not None:
            raise InputError(f"{path}: a surface has neither segment nor label: leave them out")
        return voxelise(path, read_mesh(path, zone.frame), to_needle), None
    if zone.frame is not None:
        raise make_refusal("frame", zone.frame, f"leave it out: {path} names its frame itself")
    image = load_label_map(path)
    found = _choose_segment(image, zone, path)
    voxels = Voxels(image.labels[found.layer], found.label, matrix(to_needle) @ image.affine)
    return voxels, find_extent(path, image, to_needle)


def find_extent(path: Path, image: LabelMap, to_needle: Rigid) -> ZoneImage:
    """Return the box of an image in the needle's frame. Raises InputError if its axes are not perpendicular."""
    sizes, corners = check_square(image.affine), to_needle.apply(image.corners)
    axes = (to_needle.rotation @ image.affine[:3, :3] / sizes).T
    half = 0.5 * sizes * image.labels.shape[1:]
    return ZoneImage(path.name, corners.mean(axis=0), half, axes, image.notes)


def load_label_map(path: Path) -> LabelMap:
    """Return a label map; the last one is kept in memory as long as its file is unchanged."""
    try:
        found = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return _load(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=1)
def _load(path: Path, _time: int, _size: int) -> LabelMap:
    return read_label_map(path)


def _choose_segment(image: LabelMap, zone: ZoneFile, path: Path) -> Segment:
    """Return the segment of a zone, by its name or label. Raises InputError if it has no voxels."""
    try:
        if zone.segment is not None:
            found = image.find_segment(zone.segment)
        elif zone.label is not None:
            found = Segment(0, zone.label, f"label {zone.label}")
        else:
            names = ", ".join(each.name for each in image.segments) or "none"
            raise InputError(f"a label map has segments: name one with segment (segments: {names})")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not (image.labels[found.layer] == found.label).any():
        raise InputError(f"{path}: {found.name}: has no voxels")
    return found


def matrix(rigid: Rigid) -> Floats:
    """Return a rigid map as a matrix (4, 4)."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rigid.rotation, rigid.translation
    return made


def invert(affine: Floats) -> Floats:
    """Return the inverse of an affine (4, 4)."""
    inverse: Floats = np.linalg.inv(affine).astype(float)
    return inverse


def _map(affine: Floats, points: Floats) -> Floats:
    mapped: Floats = points @ affine[:3, :3].T + affine[:3, 3]
    return mapped


def _box_of(points: Floats) -> _Box:
    return _Box(points.min(axis=0), points.max(axis=0))


def check_square(affine: Floats) -> Floats:
    """Return the lengths (3,) of voxels, mm. Raises InputError for an image whose axes are not perpendicular."""
    columns = affine[:3, :3]
    sizes: Floats = np.linalg.norm(columns, axis=0).astype(float)
    cosines = np.abs((columns / sizes).T @ (columns / sizes) - np.eye(3))
    if not cosines.max() <= _SQUARE:
        angle = math.degrees(math.asin(min(1.0, float(cosines.max()))))
        raise make_refusal(
            "angle between two axes of the image",
            round(90.0 - angle, 3),
            "must be 90 degrees: resample the sheared image",
        )
    return sizes


def _grid(voxels: Voxels, workspace: Workspace) -> DistanceGrid | None:
    """Return the distances from voxels on a grid of the needle's frame.

    The grid is the zone's box larger by `far`, or where that is smaller the workspace larger by `far`: at a face that
    is not the workspace's, and beyond it, distances are at least `far`.
    """
    sizes, far = check_square(voxels.affine), workspace.far
    reach = _Box(workspace.low, workspace.high)
    near = _crop(voxels, reach.grow(2.0 * far))
    if near is None:
        return None
    mask, affine, sizes = _resample(*near, sizes, far)
    pad = np.ceil(far / sizes).astype(int) + 1
    ends = _Box(np.full(3, -0.5), np.array(mask.shape) - 0.5)
    box = _box_of(_map(affine, ends.corners())).grow(far).within(reach.grow(far))
    box = _Box(np.maximum(box.low, [workspace.low[0], -np.inf, -np.inf]), box.high)
    if (box.low >= box.high).any():
        return None
    field = _signed_distances(np.pad(mask, [(each, each) for each in pad]), sizes)
    to_field = invert(affine)
    to_field[:3, 3] += pad
    spacing, cells = _choose_spacing(box)
    values = _interpolate(field, to_field, box.low, spacing, cells)
    return DistanceGrid(values, box.low, spacing, error_bound(sizes, spacing, workspace.near))


def _crop(voxels: Voxels, reach: _Box) -> tuple[Flags, Floats] | None:
    """Return the mask of the voxels in a box of the needle's frame, without empty margins, and its affine; or None."""
    around = _box_of(_map(invert(voxels.affine), reach.corners()))
    first = np.maximum(np.floor(around.low).astype(int), 0)
    last = np.minimum(np.ceil(around.high).astype(int) + 1, voxels.labels.shape)
    if (first >= last).any():
        return None
    mask = voxels.labels[tuple(map(slice, first, last))] == voxels.label
    filled = [np.flatnonzero(mask.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    if not len(filled[0]):
        return None
    inside = [(int(each[0]), int(each[-1]) + 1) for each in filled]
    affine = voxels.affine.copy()
    affine[:3, 3] = _map(voxels.affine, first + [start for start, _ in inside])
    return mask[tuple(slice(*each) for each in inside)], affine


def _resample(mask: Flags, affine: Floats, sizes: Floats, far: float) -> tuple[Flags, Floats, Floats]:
    """Return a mask with smaller or larger voxels of about equal edges, the smallest for which few remain.

    A larger voxel is of the zone if one of its parts is.
    """
    for edge in _EDGES_MM:
        parts = np.maximum(np.ceil(sizes / edge - 1e-6), 1.0).astype(int)
        blocks = np.maximum(np.floor(edge / sizes + 1e-6), 1.0).astype(int)
        factor = blocks / parts
        if np.prod(np.array(mask.shape) / factor + 2.0 * far / (sizes * factor) + 2.0) <= _MOST_VOXELS:
            break
    made = _enlarge(mask, blocks)
    for axis, count in enumerate(parts):
        made = np.repeat(made, count, axis=axis)
    changed = affine.copy()
    changed[:3, :3] *= factor
    changed[:3, 3] = _map(affine, 0.5 * factor - 0.5)
    return made, changed, sizes * factor


def _enlarge(mask: Flags, blocks: NDArray[np.int64]) -> Flags:
    """Return the mask of blocks of voxels that have one of the mask."""
    if (blocks == 1).all():
        return mask
    padded = np.pad(mask, [(0, int(-size % block)) for size, block in zip(mask.shape, blocks, strict=True)])
    shape = [
        part for size, block in zip(padded.shape, blocks, strict=True) for part in (size // block, block)
    ]
    return np.asarray(padded.reshape(shape).any(axis=(1, 3, 5)))


def _signed_distances(mask: Flags, sizes: Floats) -> Floats:
    """Return distances (mm) at the centres of voxels from the faces of a mask, negative inside, never too small.

    The nearest face is nearer than the centre behind it by at least half the shortest edge.
    """
    from scipy.ndimage import distance_transform_edt

    half = 0.5 * sizes.min()
    field: Floats = distance_transform_edt(~mask, sampling=sizes) - half
    filled = np.flatnonzero(mask.any(axis=(1, 2)))
    part = slice(max(filled[0] - 1, 0), filled[-1] + 2)
    inside = distance_transform_edt(mask[part], sampling=sizes)
    field[part][mask[part]] = half - inside[mask[part]]
    return field


def _choose_spacing(box: _Box) -> tuple[float, NDArray[np.int64]]:
    """Return the spacing (mm) of a grid in a box, and its cells on each axis."""
    size = box.high - box.low
    spacing = max(_FINEST_MM, float(np.prod(size) / _MOST_CELLS) ** (1.0 / 3.0))
    while np.prod(cells := np.ceil(size / spacing).astype(int)) > _MOST_CELLS:
        spacing *= 1.01
    return spacing, cells


def _interpolate(
    field: Floats, to_field: Floats, first: Floats, spacing: float, cells: NDArray[np.int64]
) -> Floats:
    """Return the values of a field at the points of a grid; beyond the field, at its face: not farther from a zone."""
    from scipy.ndimage import affine_transform

    values: Floats = affine_transform(
        field,
        to_field[:3, :3] * spacing,
        offset=_map(to_field, first),
        output_shape=tuple((cells + 1).tolist()),
        order=1,
        mode="nearest",
    )
    return values


def error_bound(sizes: Floats, spacing: float, near: float) -> float:
    """Return by how much (mm) an interpolated distance may exceed the true one at `near` (mm) or more from the zone.

    The field at a centre is the distance r from the nearest centre c of a voxel of the zone, less half the shortest
    edge. Twice it is interpolated linearly, in the voxels and in the grid: the result is at most the mean of |X − c|
    over corners X with the mean x, so at most √(|x − c|² + Σ var X), and a coordinate's variance between two points h
    apart is at most h²/4. The c behind the nearest point of the zone is half a diagonal from it at most:
    √((near + diagonal/2)² + (Σ h² + 3 spacing²)/4) − h_min/2 − near, which falls with `near`; the distance that it
    makes of `near` rises with `near`.
    """
    square = float(sizes @ sizes)
    beyond = near + 0.5 * math.sqrt(square)
    return math.hypot(beyond, 0.5 * math.sqrt(square + 3.0 * spacing**2)) - 0.5 * float(sizes.min()) - near
