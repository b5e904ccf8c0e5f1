"""Label maps in NRRD files, and segmentations of 3D Slicer (`.seg.nrrd`) with overlapping segments in layers."""

import gzip
import re
from collections.abc import Mapping
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import make_refusal
from flexneedle.errors import InputError
from flexneedle.lab.images.frames import LPS, RAS, swap_affine
from flexneedle.lab.images.label_map import LabelMap, Segment, with_named_labels
from flexneedle.types import Floats

_SPACES = {"left-posterior-superior": LPS, "lps": LPS, "right-anterior-superior": RAS, "ras": RAS}
_SOURCES = ("Segmentation_SourceRepresentation", "Segmentation_MasterRepresentation")  # new and old
_BINARY = "Binary labelmap"
_OFFSET = "Segmentation_ReferenceImageExtentOffset"
_FIELD = re.compile(r"Segment(\d+)_\w+")


def read_nrrd(path: Path) -> LabelMap:
    """Return the label map of an NRRD file. Raises InputError, and errors of pynrrd for a damaged file."""
    import nrrd

    values, header = nrrd.read(str(path))
    header = {**header, **_read_texts(path)}
    if values.ndim not in (3, 4):
        raise make_refusal("dimension", values.ndim, "must be 3, or 4 with a list axis first")
    affine = _read_affine(header, values.ndim)
    labels = values if values.ndim == 4 else values[None]
    numbers = {int(found[1]) for key in header if (found := _FIELD.fullmatch(key))}
    is_segmentation = bool(numbers) or path.name.lower().endswith(".seg.nrrd")
    if is_segmentation and labels[0].size == 1:
        labels = np.zeros_like(labels)  # 3D Slicer writes one voxel for a segmentation without any
    if not numbers and len(labels) > 1:
        raise make_refusal(
            "sizes", list(values.shape), "several layers need segments with names, Segment0_Name"
        )
    if not numbers:
        return with_named_labels(LabelMap(labels, affine, ()))
    _check_representation(header)
    _check_numbers(numbers)
    segments = tuple(_read_segment(header, number) for number in range(len(numbers)))
    image = LabelMap(labels, affine, segments)
    for number, segment in enumerate(segments):
        _check_extent(header, number, image.mask(segment))
    return image


def encode_nrrd(image: LabelMap) -> bytes:
    """Return the contents of a `.seg.nrrd` file in LPS, with gzip. Raises InputError for an unprintable name.

    Not by pynrrd, which refuses names beyond ASCII and writes the time.
    """
    is_small = image.labels.dtype.itemsize == 1
    lists = len(image.labels) > 1
    affine = swap_affine(image.affine)
    sizes = image.labels.shape if lists else image.labels.shape[1:]
    fields = {
        "type": "uchar" if is_small else "int",
        "dimension": len(sizes),
        "space": "left-posterior-superior",
        "sizes": " ".join(map(str, sizes)),
        "space directions": " ".join([*["none"] * lists, *map(_vector, affine[:3, :3].T)]),
        "kinds": " ".join([*["list"] * lists, "domain", "domain", "domain"]),
        "endian": "little",
        "encoding": "gzip",
        "space origin": _vector(affine[:3, 3]),
    }
    texts: dict[str, object] = {
        "Segmentation_ContainedRepresentationNames": f"{_BINARY}|",
        **dict.fromkeys(_SOURCES, _BINARY),
        _OFFSET: "0 0 0",
    }
    extent = " ".join(f"0 {size - 1}" for size in image.labels.shape[1:])
    for number, each in enumerate(image.segments):
        if not each.name.strip() == each.name != "" or not each.name.isprintable():
            raise make_refusal(
                "name of a segment", each.name, "must be printable, without blanks at its ends"
            )
        values = {
            "ID": f"Segment_{number + 1}",
            "Name": each.name,
            "LabelValue": each.label,
            "Layer": each.layer,
        }
        texts |= {f"Segment{number}_{key}": value for key, value in {**values, "Extent": extent}.items()}
    lines = [
        *(f"{key}: {value}" for key, value in fields.items()),
        *(f"{key}:={texts[key]}" for key in texts),
    ]
    voxels = image.labels.astype("u1" if is_small else "<i4")
    start = "\n".join(["NRRD0004", *lines, "\n"]).encode()
    return start + gzip.compress((voxels if lists else voxels[0]).tobytes(order="F"), mtime=0)


def _vector(row: Floats) -> str:
    return f"({','.join(map(repr, row.tolist()))})"


def _read_texts(path: Path) -> dict[str, str]:
    """Return the keys and values of a header, which pynrrd reads without characters beyond ASCII."""
    with path.open("rb") as file:
        lines = list(takewhile(bytes.strip, file))
    pairs = (line.decode(errors="replace").partition(":=") for line in lines if line[:1] != b"#")
    return {key.strip(): value.strip() for key, mark, value in pairs if mark}


def _read_affine(header: Mapping[str, Any], dimension: int) -> Floats:
    """Return the map (4, 4) from voxels to RAS, mm."""
    space = header.get("space")
    if str(space).lower() not in _SPACES:
        raise make_refusal("space", space, f"must be {' or '.join(name for name in _SPACES if '-' in name)}")
    for field in ("space units", "units"):
        if units := {*header.get(field, ())} - {"mm", ""}:
            raise make_refusal(field, sorted(units), "must be mm")
    for field in ("space directions", "space origin"):
        if field not in header:
            raise InputError(f"no {field}: must be given, for each axis")
    directions = np.array(header["space directions"], dtype=float)
    origin = np.array(header["space origin"], dtype=float)
    if directions.shape != (dimension, 3) or origin.shape != (3,):
        raise make_refusal(
            "space directions", directions.tolist(), f"must be {dimension} vectors of 3 numbers"
        )
    if dimension == 4 and not np.isnan(directions[0]).all():
        raise make_refusal(
            "space directions", directions.tolist(), "the first of four axes must be the list, none"
        )
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = directions[-3:].T, origin
    return swap_affine(affine) if _SPACES[str(space).lower()] == LPS else affine


def _check_representation(header: Mapping[str, Any]) -> None:
    """Raise InputError unless the segments are voxels with labels; the key has an old and a new name."""
    for key in _SOURCES:
        if header.get(key, _BINARY) != _BINARY:
            raise make_refusal(key, header[key], f"must be {_BINARY}: convert it in 3D Slicer")


def _check_numbers(numbers: set[int]) -> None:
    """Raise InputError for a gap, since 3D Slicer reads segments up to the first one."""
    gap = next(number for number in count() if number not in numbers)
    if gap < len(numbers):
        raise InputError(f"no Segment{gap}_Name, but Segment{max(numbers)}: segments must be numbered from 0")


def _read_segment(header: Mapping[str, Any], number: int) -> Segment:
    """Return a segment. Files before layers have one for each segment, with the label 1."""
    start = f"Segment{number}_"
    name = header.get(f"{start}Name") or header.get(f"{start}ID")
    if not name:
        raise InputError(f"no {start}Name: each segment must have a name")
    (layer,) = _read_integers(header, f"{start}Layer", 1, str(number))
    (label,) = _read_integers(header, f"{start}LabelValue", 1, "1")
    return Segment(layer, label, str(name))


def _read_integers(header: Mapping[str, Any], key: str, size: int, default: str) -> list[int]:
    text = str(header.get(key, default))
    if not re.fullmatch(r"\s*-?\d+" + r"\s+-?\d+" * (size - 1) + r"\s*", text):
        raise make_refusal(key, text, f"must be {size} whole number{'s' if size > 1 else ''}")
    return list(map(int, text.split()))


def _check_extent(header: Mapping[str, Any], number: int, mask: NDArray[np.bool_]) -> None:
    """Raise InputError for voxels outside the extent of their segment, which 3D Slicer would ignore.

    Extents are voxels of the file, or in old files voxels of the reference image.
    """
    key = f"Segment{number}_Extent"
    if key not in header or not mask.any():
        return
    extent = np.array(_read_integers(header, key, 6, "")).reshape(3, 2)
    offset = np.array(_read_integers(header, _OFFSET, 3, "0 0 0"))
    inside = [np.flatnonzero(mask.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    least, most = (np.array([indices[end] for indices in inside]) for end in (0, -1))
    if not any(
        (shifted[:, 0] <= least).all() and (most <= shifted[:, 1]).all()
        for shifted in (extent, extent - offset[:, None])
    ):
        bounds = " ".join(f"{low} {high}" for low, high in zip(least, most, strict=True))
        raise make_refusal(key, header[key], f"must contain all voxels of the segment, {bounds}")
