"""Markups of 3D Slicer: point lists, lines, curves, boxes (ROI) and planes in `.mrk.json`, point lists in `.fcsv`."""

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from flexneedle.arguments import check_path, make_refusal, read_numbers
from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.frames import LPS, RAS, check_frame, check_rotation, swap_affine, to_ras
from flexneedle.lab.images.reading import choose_suffix, reading
from flexneedle.types import FARTHEST_MM, Floats, Point

POINTS, LINE, CURVE, CLOSED_CURVE, ROI, PLANE = "Fiducial", "Line", "Curve", "ClosedCurve", "ROI", "Plane"
KINDS = (POINTS, LINE, CURVE, CLOSED_CURVE, ROI, PLANE)
SUFFIXES = (".mrk.json", ".json", ".fcsv")
_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_KNOWN_SCHEMA = re.compile(r"markups-schema-v1\.\d+\.\d+\.json#*$", re.IGNORECASE)
_STATUS = ("defined", "undefined", "preview", "missing")
_ROI_TYPES = ("Box", "BoundingBox")
_UNITS = ("mm", ["mm", "UCUM", "millimeter"])
_FCSV_FRAMES = {"0": RAS, "1": LPS, RAS: RAS, LPS: LPS}
_FCSV_COLUMNS = "id,x,y,z,"
_FCSV_STATUS, _FCSV_DEFINED = 14, "2"  # a column without name, of newer files
_SAME = 1e-3  # largest difference of the normal of a plane from its third axis


@dataclass(frozen=True)
class ControlPoint:
    """A point of a markup. position: RAS (mm); None: not defined, such as a point that has not been placed."""

    label: str
    position: Point | None


@dataclass(frozen=True, eq=False)
class Markup:
    """A markup in RAS (mm).

    kind: one of `KINDS`; placement: map from the frame of a box or plane to RAS, its columns are the axes, the third
    one of a plane is its normal; size: full lengths (mm) of a box or plane along its axes. Raises InputError for a
    line without two points, and for a box without placement and size, or a plane without placement.
    """

    kind: str
    name: str
    points: tuple[ControlPoint, ...]
    placement: Rigid | None = None
    size: Point | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise make_refusal("type", self.kind, f"must be one of {', '.join(KINDS)}")
        if self.kind == LINE and len(self.points) != 2:
            raise make_refusal(
                "controlPoints", len(self.points), f"{self.name!r}, a line, must have 2 points"
            )
        if self.kind in (ROI, PLANE) and self.placement is None:
            raise InputError(f"{self.name!r}, type {self.kind}, must have center and orientation")
        if self.kind == ROI and (self.size is None or min(self.size) <= 0.0):
            raise make_refusal(
                "size", self.size, f"{self.name!r}, a box, must have three lengths above 0 (mm)"
            )

    @property
    def positions(self) -> Floats:
        """Positions (n, 3) of all points, RAS (mm). Raises InputError if one is not defined."""
        for point in self.points:
            if point.position is None:
                raise InputError(
                    f"point {point.label!r} of {self.name!r} is not defined: place it in 3D Slicer"
                )
        return np.array([point.position for point in self.points], dtype=float).reshape(-1, 3)


def read_markups(path: str | PathLike[str]) -> tuple[Markup, ...]:
    """Return the markups of a `.mrk.json` or `.fcsv` file, in RAS (mm); a markup without name has the file's.

    Raises InputError, one line, for a damaged file, a frame other than LPS or RAS, another unit than mm, a kind or
    status that is not known, or a position that is not finite.
    """
    with reading(path) as file:
        suffix = choose_suffix(file, SUFFIXES)
        name = file.name[: -len(suffix)]
        text = file.read_text(encoding="utf-8-sig")
        return (_read_fcsv(text, name),) if suffix == ".fcsv" else _read_json(text, name)


def write_markups(markups: Sequence[Markup], path: str | PathLike[str]) -> None:
    """Write markups to a `.mrk.json` file in LPS (mm), in one step.

    Raises InputError for another suffix, RecordError if the file cannot be written.
    """
    file = check_path("path", path)
    choose_suffix(file, SUFFIXES[:1])
    content = {"@schema": _SCHEMA, "markups": [_encode(markup) for markup in markups]}
    replace_file(file, json.dumps(content, indent=1, allow_nan=False).encode())


def _read_json(text: str, name: str) -> tuple[Markup, ...]:
    content = json.loads(text, object_pairs_hook=_unique)
    if not isinstance(content, dict):
        raise InputError("must be an object with @schema and markups")
    schema = content.get("@schema")
    if not isinstance(schema, str) or not _KNOWN_SCHEMA.search(schema):
        raise make_refusal("@schema", schema, "must end in markups-schema-v1.N.N.json")
    given = content.get("markups")
    if not isinstance(given, list) or not given or not all(isinstance(each, dict) for each in given):
        raise make_refusal("markups", given, "must be a list of at least one markup")
    return tuple(_read_markup(each, name) for each in given)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object; 3D Slicer takes the first of two equal keys, Python the last."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise InputError(f"key {next(key for key in keys if keys.count(key) > 1)!r} is given twice")
    return found


def _read_markup(given: Mapping[str, Any], name: str) -> Markup:
    frame = check_frame("coordinateSystem", given.get("coordinateSystem", LPS))
    if (unit := given.get("coordinateUnits", "mm")) not in _UNITS:
        raise make_refusal("coordinateUnits", unit, "must be mm")
    points = given.get("controlPoints", [])
    if not isinstance(points, list) or not all(isinstance(each, dict) for each in points):
        raise make_refusal("controlPoints", points, "must be a list of points")
    kind, called = given.get("type"), str(given.get("name") or name)
    found = tuple(_read_point(each, number, frame) for number, each in enumerate(points, 1))
    if kind not in (ROI, PLANE):
        return Markup(str(kind), called, found)
    if (shape := given.get("roiType", "Box")) not in _ROI_TYPES or given.get("insideOut", False) is not False:
        shape = shape if shape not in _ROI_TYPES else "inside out"
        raise make_refusal("roiType", shape, f"must be {' or '.join(_ROI_TYPES)}, not inside out")
    size = None if "size" not in given else _read_vector("size", given["size"], 3)
    placement = _read_placement(given, frame)
    if placement is None and kind == PLANE:
        placement = _place_on_points(Markup(POINTS, called, found).positions)
    return Markup(kind, called, found, placement, None if size is None else _point(size))


def _read_point(given: Mapping[str, Any], number: int, frame: str) -> ControlPoint:
    """Return a point; 3D Slicer writes "" as the position of a point that is not placed."""
    label, status = str(given.get("label", number)), given.get("positionStatus", "defined")
    if status not in _STATUS:
        raise make_refusal(f"positionStatus of point {label!r}", status, f"must be {', '.join(_STATUS)}")
    position = given.get("position")
    if position is None or position == "" or status != "defined":
        return ControlPoint(label, None)
    return ControlPoint(
        label, _point(to_ras(_read_vector(f"position of point {label!r}", position, 3), frame))
    )


def _read_placement(given: Mapping[str, Any], frame: str) -> Rigid | None:
    """Return the placement of a box or plane, None in files that do not have it."""
    if "center" not in given or "orientation" not in given:
        return None
    center = to_ras(_read_vector("center", given["center"], 3), frame)
    axes = to_ras(_read_vector("orientation", given["orientation"], 9).reshape(3, 3).T, frame).T
    if "normal" in given:
        normal = to_ras(_read_vector("normal", given["normal"], 3), frame)
        if not np.abs(normal - axes[:, 2]).max() <= _SAME:
            raise make_refusal("normal", given["normal"], "must be the third axis of orientation")
    return Rigid(check_rotation("orientation", axes), center)


def _place_on_points(positions: Floats) -> Rigid:
    """Return the placement of a plane by three points: its origin, its x axis, a point on its side y > 0."""
    if len(positions) != 3:
        raise make_refusal(
            "controlPoints", len(positions), "a plane must have center and orientation, or 3 points"
        )
    x, across = positions[1] - positions[0], positions[2] - positions[0]
    z = np.cross(x, across)
    if not np.linalg.norm(z) > 1e-6 * np.linalg.norm(x) * np.linalg.norm(across):
        raise InputError("the 3 points of a plane are on one line: must be apart")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return Rigid(np.stack([x, np.cross(z, x), z], axis=1), positions[0])


def _read_vector(name: str, value: Any, size: int) -> Floats:
    numbers = read_numbers(value, size) if isinstance(value, list) else None
    if numbers is None or not all(abs(number) <= FARTHEST_MM for number in numbers):
        raise make_refusal(name, value, f"must be {size} numbers within 10 m")
    return np.array(numbers)


def _point(values: Floats) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def _read_fcsv(text: str, name: str) -> Markup:
    """Return the points of an `.fcsv` file: LPS since 3D Slicer 4.11, RAS before, by its header."""
    lines = [line for line in text.splitlines() if line.strip()]
    comments = (line[1:].partition("=") for line in lines if line[:1] == "#")
    header = {key.strip(): value.strip() for key, _, value in comments}
    frame = _FCSV_FRAMES.get(header.get("CoordinateSystem", ""))
    if frame is None:
        rule = f"must be {LPS} or {RAS}, or in old files 1 or 0"
        raise make_refusal("CoordinateSystem", header.get("CoordinateSystem"), rule)
    columns = header.get("columns", "")
    if not columns.replace(" ", "").startswith(_FCSV_COLUMNS):
        raise make_refusal("columns", columns, f"must begin with {_FCSV_COLUMNS}")
    rows = csv.reader(line for line in lines if line[:1] != "#")
    return Markup(POINTS, name, tuple(_read_row(row, frame) for row in rows))


def _read_row(row: Sequence[str], frame: str) -> ControlPoint:
    try:
        position = np.array([float(field) for field in row[1:4]])
    except ValueError:
        position = np.empty(0)
    if position.shape != (3,) or not (np.abs(position) <= FARTHEST_MM).all():
        raise make_refusal("point", ",".join(row), "must have x, y, z, numbers within 10 m, after its id")
    label = row[11] if len(row) > 11 and row[11] else row[0]
    is_defined = len(row) <= _FCSV_STATUS or row[_FCSV_STATUS] == _FCSV_DEFINED
    return ControlPoint(label, _point(to_ras(position, frame)) if is_defined else None)


def _encode(markup: Markup) -> dict[str, Any]:
    """Return the object of a markup, LPS."""
    encoded: dict[str, Any] = {
        "type": markup.kind,
        "name": markup.name,
        "coordinateSystem": LPS,
        "coordinateUnits": "mm",
        "controlPoints": [_encode_point(point, number) for number, point in enumerate(markup.points, 1)],
    }
    if markup.placement is None:
        return encoded
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = markup.placement.rotation, markup.placement.translation
    matrix = swap_affine(matrix)
    encoded |= {"center": matrix[:3, 3].tolist(), "orientation": matrix[:3, :3].ravel().tolist()}
    if markup.kind == PLANE:
        # 3D Slicer places a plane by these two matrices, and ignores center and orientation.
        encoded |= {"planeType": "pointNormal", "normal": matrix[:3, 2].tolist()}
        encoded |= {
            "objectToBase": swap_affine(np.eye(4)).ravel().tolist(),
            "baseToNode": matrix.ravel().tolist(),
        }
    else:
        encoded["roiType"] = "Box"
    if markup.size is not None:
        encoded |= {"size": list(markup.size), **({"sizeMode": "absolute"} if markup.kind == PLANE else {})}
    return encoded


def _encode_point(point: ControlPoint, number: int) -> dict[str, Any]:
    is_defined = point.position is not None
    return {
        "id": str(number),
        "label": point.label,
        "position": to_ras(np.array(point.position), LPS).tolist() if is_defined else "",
        "positionStatus": "defined" if is_defined else "undefined",
    }
