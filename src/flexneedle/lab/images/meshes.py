"""Surfaces as triangles in STL, PLY and OBJ files, whose comment SPACE=LPS or SPACE=RAS names the frame."""

import re
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import check_path, make_refusal, require_extra
from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.images.frames import check_frame, swap_lps, to_ras
from flexneedle.lab.images.reading import choose_suffix, reading
from flexneedle.types import Floats

SUFFIXES = (".stl", ".ply", ".obj")
_COMMENT = "flexneedle SPACE=LPS"
_SPACE = re.compile(r"SPACE=([^\s;,\0]*)")
_SMALLEST, _LARGEST = 1.0, 1e4  # mm: diagonals of surfaces; others have another unit


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface: points (n, 3), RAS (mm), and triangles (m, 3), indices of their points.

    Raises InputError without triangles, for coordinates that are not finite, indices out of range, or a diagonal of the
    bounding box that is not from 1 mm to 10 m.
    """

    points: Floats
    triangles: NDArray[np.int64]

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or not len(self.triangles) or self.triangles.shape[1:] != (3,):
            raise InputError("has no triangles: must be a surface, not points or lines")
        if not np.isfinite(self.points).all():
            raise InputError("has coordinates that are not finite numbers")
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.points):
            raise InputError(f"has triangles with points that are not among its {len(self.points)}")
        size = float(np.linalg.norm(np.ptp(self.points[self.triangles.ravel()], axis=0)))
        if not _SMALLEST <= size <= _LARGEST:
            rule = f"must be from {_SMALLEST:g} to {_LARGEST:g} mm: is the file in mm?"
            raise make_refusal("diagonal of the surface", round(size, 6), rule)


def read_mesh(path: str | PathLike[str], frame: str | None = None) -> Mesh:
    """Return the surface of an STL, PLY or OBJ file in RAS (mm).

    frame: LPS or RAS, for a file whose comment does not name it. Raises InputError for a damaged file, a frame that
    neither comment nor argument names, or on which they differ.
    """
    require_extra("images", "trimesh")
    from trimesh import load_mesh

    with reading(path) as file:
        suffix = choose_suffix(file, SUFFIXES)
        data = file.read_bytes()
        chosen = _choose_frame(_read_comment(data, suffix), frame)
        content = _strip_obj(data) if suffix == ".obj" else data
        found: Any = load_mesh(BytesIO(content), file_type=suffix[1:], process=False, maintain_order=True)
        points, triangles = (np.array(getattr(found, name, ())) for name in ("vertices", "faces"))
        return Mesh(to_ras(points.astype(float).reshape(-1, 3), chosen), triangles.astype(np.int64))


def write_mesh(mesh: Mesh, path: str | PathLike[str]) -> None:
    """Write a surface to an STL, PLY or OBJ file in LPS (mm), with the comment SPACE=LPS, in one step.

    STL has single precision, the others decimal numbers. Raises InputError for another suffix, RecordError if the file
    cannot be written.
    """
    file = check_path("path", path)
    suffix, points = choose_suffix(file, SUFFIXES), swap_lps(mesh.points)
    encode = {".stl": _encode_stl, ".ply": _encode_ply, ".obj": _encode_obj}[suffix]
    replace_file(file, encode(points, mesh.triangles))


def _read_comment(data: bytes, suffix: str) -> str:
    """Return the text of a file that may name the frame."""
    if suffix == ".stl":
        is_binary = len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
        return (data[:80] if is_binary else data.partition(b"\n")[0]).decode(errors="replace")
    mark = b"comment" if suffix == ".ply" else b"#"
    header = data.partition(b"end_header")[0] if suffix == ".ply" else data
    lines = [line for line in header.splitlines() if line.strip().startswith(mark)]
    return b"\n".join(lines).decode(errors="replace")


def _choose_frame(comment: str, given: str | None) -> str:
    """Return LPS or RAS."""
    named = {check_frame("SPACE", name) for name in _SPACE.findall(comment)}
    if given is not None:
        named.add(check_frame("frame", given))
    if not named:
        raise InputError(
            "has no comment SPACE=LPS or SPACE=RAS: name the frame, LPS or RAS, by the key frame"
        )
    if len(named) > 1:
        raise InputError("has two frames, LPS and RAS, in its comments or as argument: must be one")
    return named.pop()


def _strip_obj(data: bytes) -> bytes:
    """Return only points and faces of an OBJ file, without textures and normals, which would split its points.

    Raises InputError for indices that are not of a point; trimesh would misread 0 and indices relative to a line.
    """
    lines = [line.strip() for line in data.splitlines()]
    points = [line for line in lines if line.startswith(b"v ")]
    faces = [re.sub(rb"/\S*", b"", line) for line in lines if line.startswith(b"f ")]
    for index in (int(index) for face in faces for index in face.split()[1:]):
        if not 1 <= index <= len(points):
            raise make_refusal("point of a face", index, f"must be from 1 to {len(points)}")
    return b"\n".join(points + faces)


def _encode_stl(points: Floats, triangles: NDArray[np.int64]) -> bytes:
    require_extra("images", "trimesh")
    from trimesh import Trimesh
    from trimesh.exchange.stl import export_stl

    data = export_stl(Trimesh(points, triangles, process=False))
    return _COMMENT.encode().ljust(80, b" ") + data[80:]


def _encode_ply(points: Floats, triangles: NDArray[np.int64]) -> bytes:
    header = (
        f"ply\nformat ascii 1.0\ncomment {_COMMENT}\nelement vertex {len(points)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + _rows("", points) + _rows("3 ", triangles)


def _encode_obj(points: Floats, triangles: NDArray[np.int64]) -> bytes:
    return f"# {_COMMENT}\n".encode() + _rows("v ", points) + _rows("f ", triangles + 1)


def _rows(start: str, rows: NDArray[Any]) -> bytes:
    return "".join(f"{start}{' '.join(map(repr, row))}\n" for row in rows.tolist()).encode()
