"""Label maps: voxels with whole numbers, some of which are named segments."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import make_refusal
from flexneedle.errors import InputError
from flexneedle.lab.images.frames import check_matrix
from flexneedle.types import Flags, Floats

_LARGEST = 2**31 - 1  # label


@dataclass(frozen=True)
class Segment:
    """A segment: all voxels with a label (at least 1) in a layer of a label map."""

    layer: int
    label: int
    name: str


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels of voxels, and named segments.

    labels: whole numbers, 0 is background, (layers, i, j, k): segments of different layers may overlap; affine: map
    (4, 4) from voxels i, j, k to RAS (mm), integers at the centres of voxels; notes: what a reader assumed.
    Raises InputError for labels that are not whole numbers from 0 to 2³¹ − 1, an affine without inverse, a segment in
    no layer, or two with one label.
    """

    labels: NDArray[Any]
    affine: Floats
    segments: tuple[Segment, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", _check_labels(np.asarray(self.labels)))
        object.__setattr__(self, "affine", check_matrix("affine", self.affine))
        found: dict[tuple[int, int], str] = {}
        for each in self.segments:
            if not 0 <= each.layer < len(self.labels):
                rule = f"must be from 0 to {len(self.labels) - 1}, a layer of the file"
                raise make_refusal(f"layer of segment {each.name!r}", each.layer, rule)
            if not 1 <= each.label <= _LARGEST:
                raise make_refusal(f"label of segment {each.name!r}", each.label, "must be at least 1")
            other = found.setdefault((each.layer, each.label), each.name)
            if other is not each.name:
                rule = f"segment {other!r} has the same label in layer {each.layer}"
                raise make_refusal(f"label of segment {each.name!r}", each.label, rule)

    def find_segment(self, name: str) -> Segment:
        """Return the segment of a name. Raises InputError if there is none, or several."""
        found = [each for each in self.segments if each.name == name]
        if len(found) != 1:
            names = ", ".join(each.name for each in self.segments) or "none"
            rule = "several segments have this name" if found else f"no such segment (segments: {names})"
            raise make_refusal("segment", name, rule)
        return found[0]

    def mask(self, segment: Segment) -> Flags:
        """Return flags (i, j, k) of the voxels of a segment."""
        flags: Flags = self.labels[segment.layer] == segment.label
        return flags

    @property
    def corners(self) -> Floats:
        """Outer corners (8, 3) of the image, RAS (mm): half a voxel beyond the centres of the outermost voxels."""
        ends = [(-0.5, size - 0.5) for size in self.labels.shape[1:]]
        corners: Floats = np.array(list(product(*ends))) @ self.affine[:3, :3].T + self.affine[:3, 3]
        return corners


def with_named_labels(image: LabelMap) -> LabelMap:
    """Return the label map with a segment `Segment_N` for each label N in its one layer, as 3D Slicer names them."""
    labels = [int(label) for label in np.unique(image.labels) if label != 0]
    return replace(image, segments=tuple(Segment(0, label, f"Segment_{label}") for label in labels))


def _check_labels(values: NDArray[Any]) -> NDArray[Any]:
    """Return labels (layers, i, j, k) in the smallest unsigned type."""
    if values.ndim != 4 or 0 in values.shape:
        raise InputError(f"labels of shape {values.shape}: must have three axes i, j, k, and perhaps layers")
    if values.dtype.kind not in "iuf":
        raise InputError(f"voxels of type {values.dtype}: must be whole numbers, labels")
    if values.dtype.kind == "f" and not (values == np.rint(values)).all():
        raise InputError("voxels are not whole numbers: must be a label map, not an image or a distance map")
    least, largest = values.min(), values.max()
    if least < 0 or largest > _LARGEST:
        rule = f"must be from 0 to {_LARGEST}: is it an image, not a label map?"
        raise make_refusal("label", (least if least < 0 else largest).item(), rule)
    return values.astype(np.min_scalar_type(int(largest)))
