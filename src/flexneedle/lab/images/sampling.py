"""Segments of a label map at points, and where lines first meet them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.distances import invert
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.types import Flags, Floats


class Sampler:
    """The voxels of an image at points of the needle's frame; to_image: its map to RAS."""

    def __init__(self, image: LabelMap, to_image: Rigid) -> None:
        self._image, self._to_image, self._to_voxels = image, to_image, invert(image.affine)

    def among(self, segments: Sequence[Segment], points: Floats) -> Flags:
        """Return whether points (…, 3) are in voxels of one of the segments; outside of the image they are not."""
        voxels = self._to_image.apply(points) @ self._to_voxels[:3, :3].T + self._to_voxels[:3, 3]
        index = np.rint(voxels).astype(int)
        inside = np.asarray(((index >= 0) & (index < self._image.labels.shape[1:])).all(axis=-1))
        i, j, k = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
        found = np.zeros(inside.shape, bool)
        for each in segments:
            found |= self._image.labels[each.layer, i, j, k] == each.label
        flags: Flags = found & inside
        return flags

    def which(self, groups: Sequence[Sequence[Segment]], points: Floats) -> NDArray[np.int64]:
        """Return for points (…, 3) the index of the first group with a segment there, −1 if there is none."""
        found = np.full(points.shape[:-1], -1)
        for number in reversed(range(len(groups))):
            found[self.among(groups[number], points)] = number
        return found


def disc(radius: float, spacing: float) -> Floats:
    """Return points (n, 2) of a square grid in a disc around 0, mm."""
    steps = np.arange(-np.floor(radius / spacing), np.floor(radius / spacing) + 1.0) * spacing
    rows = np.array(np.meshgrid(steps, steps)).reshape(2, -1).T
    return np.asarray(rows[np.hypot(*rows.T) <= radius])


def rays(across: Floats, depths: Floats) -> Floats:
    """Return points (n, d, 3) at depths (d,) along x, at places y, z (n, 2)."""
    made = np.empty((len(across), len(depths), 3))
    made[..., 0], made[..., 1:] = depths, across[:, None]
    return made


def fit_plane(across: Floats, depths: Floats) -> tuple[Floats, Floats]:
    """Return offset at 0 and slopes (3,) of the plane nearest to depths (n,) at places (n, 2), and the rests (n,)."""
    columns = np.column_stack([np.ones(len(across)), across])
    plane: Floats = np.linalg.lstsq(columns, depths, rcond=None)[0].astype(float)
    return plane, np.asarray(depths - columns @ plane)
