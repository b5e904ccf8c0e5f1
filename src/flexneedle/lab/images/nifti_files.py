"""Label maps in NIfTI files."""

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.arguments import make_refusal
from flexneedle.errors import InputError
from flexneedle.lab.images.frames import check_matrix
from flexneedle.lab.images.label_map import LabelMap, with_named_labels
from flexneedle.types import Floats

_SAME_MM = 0.01


def read_nifti(path: Path) -> LabelMap:
    """Return the label map of a NIfTI file. Raises InputError, and errors of nibabel for a damaged file."""
    import nibabel

    image: Any = nibabel.load(path)
    unit = image.header.get_xyzt_units()[0]
    if unit not in ("mm", "unknown"):
        raise make_refusal("xyzt_units", unit, "must be mm")
    shape = image.shape
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise make_refusal("dim", shape, "must be three axes")
    affine = _read_affine(image, shape[:3])
    labels = np.asanyarray(image.dataobj).reshape((1, *shape[:3]))
    notes = () if unit == "mm" else ("unit not stated, mm assumed",)
    return with_named_labels(LabelMap(labels, affine, (), notes))


def encode_nifti(image: LabelMap, *, zipped: bool) -> bytes:
    """Return the contents of a NIfTI-1 file, whose affine has single precision; names of segments are not written.

    The qform is written unless the affine is sheared. Raises InputError for several layers.
    """
    import nibabel

    if len(image.labels) > 1:
        raise make_refusal("layers", len(image.labels), "NIfTI has one layer: write .seg.nrrd")
    labels = image.labels[0] if image.labels.dtype.itemsize == 1 else image.labels[0].astype(np.int32)
    made: Any = nibabel.Nifti1Image(labels, image.affine)
    made.set_sform(image.affine, code=1)
    made.set_qform(image.affine, code=1, strip_shears=True)
    if _distance(made.get_sform(), made.get_qform(), labels.shape) > _SAME_MM:
        made.set_qform(None, code=0)
    made.header.set_xyzt_units("mm")
    data: bytes = made.to_bytes()
    return gzip.compress(data, mtime=0) if zipped else data


def _read_affine(image: Any, shape: tuple[int, ...]) -> Floats:
    """Return the map (4, 4) from voxels to RAS, mm: the sform, the qform, or both if they are equal."""
    found = [
        check_matrix(name, form)
        for name, (form, code) in (
            ("sform", image.get_sform(coded=True)),
            ("qform", image.get_qform(coded=True)),
        )
        if code > 0
    ]
    if not found:
        raise InputError(
            "sform_code = qform_code = 0: one must be at least 1, with the position of the image"
        )
    if (apart := _distance(found[0], found[-1], shape)) > _SAME_MM:
        raise InputError(
            f"sform and qform differ by {apart:.3g} mm at a corner, must be at most {_SAME_MM:g} mm: "
            "delete the wrong one"
        )
    return found[0]


def _distance(first: Floats, second: Floats, shape: tuple[int, ...]) -> float:
    """Return the largest distance (mm) of the corners of an image by two affines (4, 4)."""
    corners = np.array([[*np.multiply(each, np.subtract(shape, 1)), 1] for each in np.ndindex(2, 2, 2)])
    return float(np.linalg.norm(corners @ (first - second).T, axis=1).max())
