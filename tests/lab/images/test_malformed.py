"""Malformed and contradictory files: each is refused in one line with the file, the value and the rule."""

import gzip
import json
import re
import struct

import nibabel
import nrrd
import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.markups import ControlPoint, Markup, read_markups, write_markups
from flexneedle.lab.images.meshes import Mesh, read_mesh, write_mesh
from flexneedle.lab.images.transforms import read_transform, write_transform
from flexneedle.lab.images.volumes import read_label_map, write_label_map

pytestmark = pytest.mark.filterwarnings(
    "ignore:datetime.datetime.utcnow:DeprecationWarning"
)  # pynrrd's writer
CUBE = np.ones((2, 3, 4), np.uint8)
HEADER = {
    "space": "left-posterior-superior",
    "space directions": np.eye(3),
    "space origin": np.zeros(3),
    "kinds": ["domain"] * 3,
}
SKIN = {"Segment0_ID": "s", "Segment0_Name": "skin", "Segment0_LabelValue": "1", "Segment0_Layer": "0"}
LAYERS = {
    "space directions": np.vstack([np.full(3, np.nan), np.eye(3)]),
    "kinds": ["list", "domain", "domain", "domain"],
}
TWO = np.ones((2, 2, 3, 4), np.uint8)

NRRD = [
    (CUBE, {"space": None}, "space = None: must be left-posterior-superior or right-anterior-superior"),
    (CUBE, {"space": "left-anterior-superior"}, "space = 'left-anterior-superior': must be left-posterior"),
    (CUBE, {"space": "scanner-xyz"}, "space = 'scanner-xyz': must be"),
    (CUBE, {"space origin": None}, "no space origin: must be given"),
    (CUBE, {"space directions": None}, "no space directions: must be given"),
    (CUBE, {"space directions": None, "spacings": [1, 1, 1]}, "no space directions: must be given"),
    (CUBE, {"space directions": np.diag([1.0, 1.0, 0.0])}, "must have an inverse"),
    (CUBE, {"space directions": np.diag([1.0, 1.0, np.inf])}, "affine = .*: must be 4 × 4 finite numbers"),
    (CUBE, {"space origin": [0, 0, np.nan]}, "affine = .*: must be 4 × 4 finite numbers"),
    (CUBE, {"space units": ["cm", "cm", "cm"]}, r"space units = \['cm'\]: must be mm"),
    (CUBE, {"units": ["mm", "mm", "m"]}, r"units = \['m'\]: must be mm"),
    (CUBE[0], {"space directions": np.eye(3)[:2], "kinds": None}, "dimension = 2: must be 3, or 4"),
    (CUBE.astype(float) + 0.5, {}, "voxels are not whole numbers: must be a label map"),
    (CUBE.astype(np.int16) * -1000, {}, "label = -1000: must be from 0 to 2147483647: is it an image"),
    (CUBE.astype(float) * 1e10, {}, "label = 10000000000.0: must be from 0 to 2147483647"),
    (TWO, LAYERS, "several layers need segments with names, Segment0_Name"),
    (TWO, {**LAYERS, "space directions": np.vstack([np.eye(3), np.full(3, np.nan)])}, "first of four axes"),
    (TWO, {**SKIN, **LAYERS, "Segment0_Layer": "2"}, "layer of segment 'skin' = 2: must be from 0 to 1"),
    (CUBE, SKIN | {"Segment0_Layer": "-1"}, "layer of segment 'skin' = -1: must be from 0 to 0"),
    (CUBE, SKIN | {"Segment0_Layer": "first"}, "Segment0_Layer = 'first': must be 1 whole number"),
    (CUBE, SKIN | {"Segment0_LabelValue": "1.5"}, "Segment0_LabelValue = '1.5': must be 1 whole number"),
    (CUBE, SKIN | {"Segment0_LabelValue": "0"}, "label of segment 'skin' = 0: must be at least 1"),
    (CUBE, SKIN | {"Segment0_Extent": "0 1 0 2"}, "Segment0_Extent = '0 1 0 2': must be 6 whole numbers"),
    (CUBE, SKIN | {"Segment0_Extent": "0 1 0 2 0 2"}, "must contain all voxels of the segment, 0 1 0 2 0 3"),
    (CUBE, SKIN | {"Segment0_Extent": "0 -1 0 -1 0 -1"}, "must contain all voxels of the segment"),
    (CUBE, SKIN | {"Segment2_Name": "liver"}, "no Segment1_Name, but Segment2: segments must be numbered"),
    (CUBE, {"Segment1_Name": "liver"}, "no Segment0_Name, but Segment1: segments must be numbered"),
    (CUBE, {"Segment0_LabelValue": "1"}, "no Segment0_Name: each segment must have a name"),
    (CUBE, SKIN | {"Segmentation_MasterRepresentation": "Closed surface"}, "must be Binary labelmap"),
    (
        CUBE,
        SKIN | {"Segment1_Name": "liver", "Segment1_LabelValue": "1", "Segment1_Layer": "0"},
        "label of segment 'liver' = 1: segment 'skin' has the same label in layer 0",
    ),
    (
        CUBE,
        SKIN | {"Segment1_Name": "skin", "Segment1_LabelValue": "1", "Segment1_Layer": "0"},
        "label of segment 'skin' = 1: segment 'skin' has the same label in layer 0",
    ),
]

NIFTI = [
    (CUBE, lambda head: (head.set_sform(None, 0), head.set_qform(None, 0)), "sform_code = qform_code = 0"),
    (CUBE, lambda head: head.__setitem__("qoffset_x", 0.02), "sform and qform differ by 0.02 mm"),
    (CUBE, lambda head: head.set_sform(np.diag([-1, 1, 1, 1]), 1), "sform and qform differ by 2 mm"),
    (CUBE, lambda head: head.set_xyzt_units("meter"), "xyzt_units = 'meter': must be mm"),
    (CUBE, lambda head: head.set_xyzt_units("micron"), "xyzt_units = 'micron': must be mm"),
    (CUBE, lambda head: head.__setitem__("srow_x", [0, 0, 0, 1]), "sform = .*: must have an inverse"),
    (CUBE, lambda head: head.__setitem__("srow_x", [np.nan] * 4), "sform = .*: must be 4 × 4 finite"),
    (CUBE, lambda head: head.__setitem__("quatern_b", 2.0), "cannot be read: ValueError"),
    (CUBE.astype(np.float32) / 2, lambda _: None, "voxels are not whole numbers"),
    (CUBE.astype(np.int16) - 2, lambda _: None, "label = -1: must be from 0"),
    (CUBE.astype(np.complex64), lambda _: None, "voxels of type complex64: must be whole numbers"),
    (CUBE[0], lambda _: None, r"dim = \(3, 4\): must be three axes"),
    (TWO, lambda _: None, r"dim = \(2, 2, 3, 4\): must be three axes"),
]

POINT = {"label": "a", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"}
POINTS = {"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [POINT]}
BOX = {"type": "ROI", "center": [0, 0, 0], "orientation": [-1, 0, 0, 0, -1, 0, 0, 0, 1], "size": [1, 2, 3]}
PLANE = BOX | {"type": "Plane", "normal": [0, 0, 1]}
FLAT = [POINT | {"position": [x, 0, 0]} for x in (0, 1, 2)]

MARKUPS = [
    (POINTS | {"coordinateSystem": "lps"}, "coordinateSystem = 'lps': must be LPS or RAS, in capitals"),
    (POINTS | {"coordinateSystem": "0"}, "coordinateSystem = '0': must be LPS or RAS"),
    (POINTS | {"coordinateSystem": None}, "coordinateSystem = None: must be LPS or RAS"),
    (POINTS | {"coordinateSystem": "LAS"}, "coordinateSystem = 'LAS': must be LPS or RAS"),
    (POINTS | {"coordinateUnits": "cm"}, "coordinateUnits = 'cm': must be mm"),
    (POINTS | {"coordinateUnits": ["m", "UCUM", "meter"]}, "coordinateUnits = .*: must be mm"),
    (POINTS | {"controlPoints": {}}, "controlPoints = {}: must be a list of points"),
    (POINTS | {"controlPoints": [[1, 2, 3]]}, "must be a list of points"),
    (
        POINTS | {"controlPoints": [POINT | {"position": [1, 2]}]},
        "position of point 'a' = .*: must be 3 numbers",
    ),
    (POINTS | {"controlPoints": [POINT | {"position": [1, 2, "3"]}]}, "must be 3 numbers within 10 m"),
    (POINTS | {"controlPoints": [POINT | {"position": "1 2 3"}]}, "must be 3 numbers within 10 m"),
    (POINTS | {"controlPoints": [POINT | {"position": [1, 2, 1e5]}]}, "must be 3 numbers within 10 m"),
    (
        POINTS | {"controlPoints": [POINT | {"position": [1, 2, float("nan")]}]},
        "must be 3 numbers within 10 m",
    ),
    (
        POINTS | {"controlPoints": [POINT | {"positionStatus": "done"}]},
        "positionStatus of point 'a' = 'done'",
    ),
    (
        POINTS | {"type": "Angle"},
        "type = 'Angle': must be one of Fiducial, Line, Curve, ClosedCurve, ROI, Plane",
    ),
    (POINTS | {"type": None}, "type = 'None': must be one of"),
    (POINTS | {"type": "Line"}, "controlPoints = 1: 'file', a line, must have 2 points"),
    (BOX | {"size": [1, 0, 3]}, "'file', a box, must have three lengths above 0"),
    (BOX | {"size": [1, 2]}, "size = .*: must be 3 numbers"),
    (BOX | {"orientation": [1, 0, 0, 0, -1, 0, 0, 0, 1]}, "orientation: must be a rotation, but is mirrored"),
    (BOX | {"orientation": [-1, 0, 0, 0, -1, 0, 0, 0, 2]}, "orientation: must be a rotation, but is scaled"),
    (BOX | {"roiType": "Sphere"}, "roiType = 'Sphere': must be Box or BoundingBox, not inside out"),
    (BOX | {"insideOut": True}, "roiType = 'inside out': must be Box or BoundingBox, not inside out"),
    ({"type": "ROI", "size": [1, 2, 3]}, "'file', type ROI, must have center and orientation"),
    (PLANE | {"normal": [0, 1, 0]}, "normal = .*: must be the third axis of orientation"),
    (
        {"type": "Plane", "controlPoints": [POINT]},
        "controlPoints = 1: a plane must have center and orientation",
    ),
    ({"type": "Plane", "controlPoints": FLAT}, "the 3 points of a plane are on one line"),
]

SCHEMA = '{"@schema": "markups-schema-v1.0.3.json#", '
JSON = [
    ("", "cannot be read: JSONDecodeError"),
    ("[]", "must be an object with @schema and markups"),
    ('{"markups": []}', "@schema = None: must end in markups-schema-v1"),
    (
        '{"@schema": "markups-schema-v2.0.0.json#", "markups": []}',
        "@schema = .*: must end in markups-schema-v1",
    ),
    (SCHEMA + '"markups": []}', r"markups = \[\]: must be a list of at least one markup"),
    (SCHEMA + '"markups": [1]}', "must be a list of at least one markup"),
    (SCHEMA + '"markups": [{"type": "Fiducial", "type": "Line"}]}', "key 'type' is given twice"),
    ("[" * 10**5, "cannot be read: RecursionError"),
]

COLUMNS = "# CoordinateSystem = LPS\n# columns = id,x,y,z,ow\n"
FCSV = [
    (
        "# columns = id,x,y,z\n1,1,2,3\n",
        "CoordinateSystem = None: must be LPS or RAS, or in old files 1 or 0",
    ),
    (
        "# CoordinateSystem = 2\n# columns = id,x,y,z,\n1,1,2,3\n",
        "CoordinateSystem = '2': must be LPS or RAS",
    ),
    ("# CoordinateSystem = lps\n# columns = id,x,y,z,\n1,1,2,3\n", "CoordinateSystem = 'lps': must be"),
    ("# CoordinateSystem = LPS\n1,1,2,3\n", "columns = '': must begin with id,x,y,z,"),
    ("# CoordinateSystem = LPS\n# columns = label,x,y,z,\na,1,2,3\n", "columns = 'label,x,y,z,': must begin"),
    (COLUMNS + "1,1,2\n", "point = '1,1,2': must have x, y, z"),
    (COLUMNS + "1,1,2,z\n", "point = '1,1,2,z': must have x, y, z"),
    (COLUMNS + "1,1,2,inf\n", "point = '1,1,2,inf': must have x, y, z, numbers within 10 m"),
]

STL = (
    "solid {}\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex {} 0 0\nvertex 0 {} 0\n"
    "endloop\nendfacet\nendsolid\n"
)
OBJ = "# SPACE=LPS\nv 0 0 0\nv 10 0 0\nv 0 10 0\n"
PLY = (
    "ply\nformat ascii 1.0\ncomment SPACE=LPS\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n10 0 0\n"
)
MESHES = [
    ("a.stl", "", "has no comment SPACE=LPS or SPACE=RAS: name the frame"),
    ("a.stl", STL.format("", 10, 10), "has no comment SPACE=LPS or SPACE=RAS: name the frame"),
    ("a.stl", STL.format("SPACE=LAS", 10, 10), "SPACE = 'LAS': must be LPS or RAS"),
    ("a.stl", STL.format("SPACE=lps", 10, 10), "SPACE = 'lps': must be LPS or RAS, in capitals"),
    ("a.stl", STL.format("SPACE=LPS SPACE=RAS", 10, 10), "has two frames, LPS and RAS"),
    ("a.stl", STL.format("SPACE=LPS", 0.1, 0.2), "diagonal of the surface = 0.223607: .* is the file in mm"),
    ("a.stl", STL.format("SPACE=LPS", 1e5, 1), "must be from 1 to 10000 mm: is the file in mm"),
    ("a.stl", STL.format("SPACE=LPS", "nan", 1), "has coordinates that are not finite numbers"),
    ("a.stl", STL.format("SPACE=LPS", "one", 1), "cannot be read: ValueError"),
    ("a.stl", "SPACE=LPS".ljust(80).encode() + struct.pack("<I", 2) + b"\0" * 50, "has no triangles"),
    ("a.stl", "SPACE=LPS".ljust(80).encode() + struct.pack("<I", 0), "has no triangles"),
    ("a.obj", OBJ, "has no triangles: must be a surface, not points or lines"),
    ("a.obj", OBJ + "f 1 2 4\n", "point of a face = 4: must be from 1 to 3"),
    ("a.obj", OBJ + "f 0 1 2\n", "point of a face = 0: must be from 1 to 3"),
    ("a.obj", OBJ + "f -3 -2 -1\n", "point of a face = -3: must be from 1 to 3"),
    ("a.obj", OBJ + "f a b c\n", "cannot be read: ValueError"),
    ("a.ply", PLY + "0 10 0\n3 0 1 3\n", "has triangles with points that are not among its 3"),
    ("a.ply", PLY + "0 10 inf\n3 0 1 2\n", "has coordinates that are not finite numbers"),
    ("a.ply", PLY, "has no triangles"),
    ("a.ply", "SPACE=LPS", "has no comment"),
    ("a.ply", "comment SPACE=LPS", "cannot be read: ValueError: Not a ply file!"),
    ("a.vtk", "", r"a.vtk must end in .stl, .ply, .obj"),
]

ITK = "#Insight Transform File V1.0\n#Transform 0\n"
AFFINE = "Transform: AffineTransform_double_3_3\nParameters: 1 0 0 0 1 0 0 0 1 0 0 0\n"
TRANSFORMS = [
    ("", "must begin with #Insight Transform File V1.0"),
    (ITK, "must have one Transform with Parameters and FixedParameters"),
    (ITK + AFFINE, "must have one Transform with Parameters and FixedParameters"),
    (ITK + (AFFINE + "FixedParameters: 0 0 0\n") * 2, "must have one Transform"),
    (ITK + AFFINE + "FixedParameters: 0 0\n", "FixedParameters = '0 0': must be 3 finite numbers"),
    (ITK + AFFINE.replace("1 0 0 0\n", "1 0 0\n") + "FixedParameters: 0 0 0\n", "must be 12 finite numbers"),
    (
        ITK + AFFINE.replace("1 0 0 0\n", "1 0 0 nan\n") + "FixedParameters: 0 0 0\n",
        "must be 12 finite numbers",
    ),
    (
        ITK + AFFINE.replace("1 0 0 0\n", "1 0 0 x\n") + "FixedParameters: 0 0 0\n",
        "must be 12 finite numbers",
    ),
    (
        ITK + AFFINE.replace(": 1", ": 0") + "FixedParameters: 0 0 0\n",
        "Parameters = .*: must have an inverse",
    ),
    (
        ITK + AFFINE.replace("Affine", "Euler3D") + "FixedParameters: 0 0 0\n",
        "Transform = 'Euler3DTransform_dou",
    ),
    (
        ITK + AFFINE.replace("3_3", "2_2") + "FixedParameters: 0 0 0\n",
        "must be AffineTransform or MatrixOffset",
    ),
]


def refuse(read, path, problem):
    with pytest.raises(InputError, match=problem) as refused:
        read(path)
    line = str(refused.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    assert len(line) < 400


@pytest.mark.parametrize(("values", "fields", "problem"), NRRD)
def test_nrrd(tmp_path, values, fields, problem):
    path = tmp_path / "file.seg.nrrd"
    header = {key: value for key, value in (HEADER | fields).items() if value is not None}
    if "kinds" in header and len(header["kinds"]) != values.ndim:
        del header["kinds"]
    nrrd.write(str(path), values, header)
    refuse(read_label_map, path, problem)


@pytest.mark.parametrize(("values", "change", "problem"), NIFTI)
def test_nifti(tmp_path, values, change, problem):
    made = nibabel.Nifti1Image(values, np.eye(4))
    made.set_sform(np.eye(4), 1)
    made.set_qform(np.eye(4), 1)
    data = made.to_bytes()
    header = nibabel.Nifti1Header(data[:348])
    change(header)
    (tmp_path / "file.nii.gz").write_bytes(gzip.compress(header.binaryblock + data[348:]))
    refuse(read_label_map, tmp_path / "file.nii.gz", problem)


@pytest.mark.parametrize(("markup", "problem"), MARKUPS)
def test_markup(tmp_path, markup, problem):
    path = tmp_path / "file.mrk.json"
    path.write_text(json.dumps({"@schema": "markups-schema-v1.0.3.json#", "markups": [markup]}))
    refuse(read_markups, path, problem)


@pytest.mark.parametrize(("text", "problem"), JSON)
def test_json(tmp_path, text, problem):
    (tmp_path / "file.mrk.json").write_text(text)
    refuse(read_markups, tmp_path / "file.mrk.json", problem)


@pytest.mark.parametrize(("text", "problem"), FCSV)
def test_fcsv(tmp_path, text, problem):
    (tmp_path / "file.fcsv").write_text(text)
    refuse(read_markups, tmp_path / "file.fcsv", problem)


@pytest.mark.parametrize(("name", "content", "problem"), MESHES)
def test_mesh(tmp_path, name, content, problem):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    refuse(read_mesh, tmp_path / name, problem)


@pytest.mark.parametrize(("text", "problem"), TRANSFORMS)
def test_transform(tmp_path, text, problem):
    (tmp_path / "file.tfm").write_text(text)
    refuse(read_transform, tmp_path / "file.tfm", problem)


READERS = [
    (read_label_map, "file.seg.nrrd"),
    (read_label_map, "file.nii"),
    (read_label_map, "file.nii.gz"),
    (read_markups, "file.mrk.json"),
    (read_markups, "file.fcsv"),
    (read_mesh, "file.stl"),
    (read_mesh, "file.ply"),
    (read_mesh, "file.obj"),
    (read_transform, "file.tfm"),
]


@pytest.mark.parametrize(("read", "name"), READERS)
def test_missing_empty_and_random_files(tmp_path, read, name):
    path = tmp_path / name
    refuse(read, path, "no such file")
    for content in (b"", b"\0" * 400, bytes(range(256)) * 4):
        path.write_bytes(content)
        refuse(read, path, re.escape(name))


@pytest.mark.parametrize(("read", "name"), READERS)
def test_a_damaged_file_is_read_or_refused_in_one_line(tmp_path, read, name):
    """Bytes of a valid file are changed or cut off at random."""
    path, rng = tmp_path / name, np.random.default_rng(0)
    if read is read_label_map:
        write_label_map(LabelMap(CUBE[None], np.eye(4), (Segment(0, 1, "skin"),)), path)
    elif read is read_mesh:
        write_mesh(Mesh(np.eye(3) * 10.0, np.array([[0, 1, 2]])), path)
    elif read is read_transform:
        write_transform(np.eye(4), path)
    elif name == "file.fcsv":
        path.write_text(COLUMNS + "1,1,2,3\n2,3,4,5\n")
    else:
        write_markups([Markup("Fiducial", "a", (ControlPoint("a", (1.0, 2.0, 3.0)),))], path)
    read(path)
    valid, lines = path.read_bytes(), []
    for _ in range(60):
        damaged = np.frombuffer(valid, np.uint8).copy()
        damaged[rng.integers(0, len(damaged), 3)] = rng.integers(0, 256, 3)
        path.write_bytes(damaged[: rng.integers(len(valid) // 2, 2 * len(valid))].tobytes())
        try:
            read(path)
        except InputError as error:
            lines.append(str(error))
    assert len(lines) > 5
    assert [line for line in lines if len(line.splitlines()) != 1] == []
