"""Voxels that contain a closed surface and what it encloses."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.meshes import Mesh
from flexneedle.lab.images.voxels import Voxels
from flexneedle.types import Flags, Floats

_FINEST_MM, _MOST_VOXELS = 0.5, 4_000_000


def voxelise(path: Path, mesh: Mesh, to_needle: Rigid) -> Voxels:
    """Return voxels along the axes of the needle's frame: each that a closed surface meets, or that it encloses.

    They contain the surface, so a distance from them is never above that from it, and below it by a diagonal at most.
    Raises InputError for a surface that is not closed.
    """
    surface = _check_closed(path, mesh)
    points = to_needle.apply(np.asarray(surface.vertices))
    low, high = points.min(axis=0), points.max(axis=0)
    edge = max(_FINEST_MM, float(np.prod(high - low + 2.0) / _MOST_VOXELS) ** (1.0 / 3.0))
    first = low - edge  # centre of the first voxel
    shell = _shell(_sample(points, np.asarray(surface.faces), edge), first, high, edge)
    affine = np.diag([edge, edge, edge, 1.0])
    affine[:3, 3] = first
    return Voxels(_fill(shell), 1, affine)


def _check_closed(path: Path, mesh: Mesh) -> Any:
    from trimesh import Trimesh

    surface = Trimesh(mesh.points, mesh.triangles, process=True)
    edges = surface.edges_sorted[surface.edges_sorted[:, 0] != surface.edges_sorted[:, 1]]
    # Where two parts of a surface touch, an edge has four triangles: they enclose a volume, too.
    if (np.unique(edges, axis=0, return_counts=True)[1] % 2).any():
        raise InputError(f"{path}: the surface is not closed: fill its holes, or use a label map")
    return surface


def _sample(points: Floats, triangles: NDArray[np.int64], edge: float) -> Floats:
    """Return points (n, 3) of triangles, of which one is within half an edge of each point of a triangle."""
    from trimesh.remesh import subdivide_to_size

    # A point of a triangle is within 1/√3 of the longest edge of a corner.
    found: Floats = subdivide_to_size(points, triangles, 0.85 * edge, max_iter=30)[0]
    return found


def _shell(samples: Floats, first: Floats, high: Floats, edge: float) -> Flags:
    """Return the mask of all voxels that a surface meets.

    A cube of one edge around a sample contains all points of the surface that are near it, and has its corners in all
    voxels that it meets.
    """
    shape = np.ceil((high - first) / edge).astype(int) + 2
    shell = np.zeros(shape, bool)
    for corner in np.ndindex(2, 2, 2):
        at = np.floor((samples + (np.array(corner) - 0.5) * edge - first) / edge + 0.5).astype(int)
        shell[tuple(at.T)] = True
    return shell


def _fill(shell: Flags) -> Flags:
    from scipy.ndimage import binary_fill_holes

    filled: Flags = binary_fill_holes(shell)
    return filled
