"""A case by an image of flat layers, whose geometry is known in closed form."""

import json

import numpy as np

from flexneedle.geometry.quaternion import from_vector, to_matrix
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.markups import LINE, POINTS, ControlPoint, Markup, write_markups
from flexneedle.lab.images.volumes import write_label_map

ENDS = (6.0, 18.0, 80.0)  # depths at which fat, muscle and liver end
VESSEL = np.array([30.0, 9.0, 6.0]), 4.0  # centre and radius in the frame of the layers
TURN = to_matrix(from_vector(np.array([0.4, -0.3, 0.8])))  # of the layers' frame to RAS
ORIGIN = np.array([12.0, -34.0, 56.0])
TEXT = """
scenario = "phantom3d"
labels = "image.seg.nrrd"
markups = ["points.mrk.json", "axis.mrk.json"]
entry = "entry"
target = "target"
skin = ["fat", "muscle", "liver"]
registration_sd_mm = 0.5
free_radius_mm = 10.0

[[layer]]
segments = ["fat"]
tissue = "superficial"

[[layer]]
segments = ["muscle"]
tissue = "superficial"
shear_modulus_kpa = 4.0

[[layer]]
segments = ["liver"]
tissue = "deep"

[[zone]]
segment = "vessel"
margin_mm = 3.0
"""


def to_ras(points):
    """Points (…, 3) in the layers' frame, x = 0 on the skin and x down, in RAS."""
    return np.asarray(points, float) @ TURN.T + ORIGIN


def label_map(spacing=1.0):
    """Voxels along the axes of RAS, through layers that are oblique to them."""
    size = np.ceil(np.array([120, 120, 120]) / spacing).astype(int)
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = to_ras([30.0, 0.0, 0.0]) + np.array([60.0, 60.0, -60.0])
    centres = np.indices(size).reshape(3, -1).T @ affine[:3, :3].T + affine[:3, 3]
    local = (centres - ORIGIN) @ TURN
    tissues = np.select([local[:, 0] < 0.0, *(local[:, 0] < end for end in ENDS)], [0, 1, 2, 3], 0)
    vessel = np.linalg.norm(local - VESSEL[0], axis=1) <= VESSEL[1]
    labels = np.array([tissues, vessel]).astype(np.uint8).reshape(2, *size)
    names = ("fat", "muscle", "liver")
    segments = (*(Segment(0, k, name) for k, name in enumerate(names, 1)), Segment(1, 1, "vessel"))
    return LabelMap(labels, affine, segments)


def point(label, position):
    return ControlPoint(label, None if position is None else tuple(map(float, position)))


def write_case(
    folder, text=TEXT, entry=(0.0, 0.0, 0.0), target=(45.0, 0.0, 0.0), axis=((0, 0, 0), (1, 0, 0))
):
    """Write image, points and case, and return the path of the case; positions in the layers' frame."""
    if not (folder / "image.seg.nrrd").exists():
        write_label_map(label_map(), folder / "image.seg.nrrd")
    points = (point("entry", to_ras(entry)), point("target", to_ras(target)), point("later", None))
    write_markups([Markup(POINTS, "points", points)], folder / "points.mrk.json")
    ends = tuple(point(str(k), to_ras(10.0 * np.array(each))) for k, each in enumerate(axis))
    write_markups([Markup(LINE, "axis", ends)], folder / "axis.mrk.json")
    path = folder / "case.toml"
    path.write_text(text)
    return path


def rename_points(folder, old, new):
    """Change the label of a point in its file."""
    path = folder / "points.mrk.json"
    content = json.loads(path.read_text())
    for each in content["markups"][0]["controlPoints"]:
        each["label"] = new if each["label"] == old else each["label"]
    path.write_text(json.dumps(content))
