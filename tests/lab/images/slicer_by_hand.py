"""Check files of images against 3D Slicer's own readers and writers: `make slicer`, by hand.

Needs slicerio, or slicer-core (3D Slicer's scene without its window), or both, in the Python that runs it; names the
missing one. Each line is a check with the largest difference (mm, or voxels); exit status 1 if one is above its limit.
"""

import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from flexneedle import load_scenario, plan
from flexneedle.geometry.quaternion import from_vector, to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.example import write_example
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.markups import ControlPoint, Markup, read_markups, write_markups
from flexneedle.lab.images.meshes import SUFFIXES, Mesh, read_mesh, write_mesh
from flexneedle.lab.images.slicer_scene import write_scene
from flexneedle.lab.images.transforms import read_transform, write_transform
from flexneedle.lab.images.volumes import read_label_map, write_label_map

EXACT, SINGLE = 1e-6, 1e-4  # limits; single precision of a coordinate of 1 m
ROTATION = to_matrix(from_vector(np.array([0.3, -0.4, 0.5])))
AFFINE = np.vstack([np.column_stack([ROTATION * [0.7, 0.8, 5.0], [-93.1, 16.4, -340.25]]), [0, 0, 0, 1]])
POINTS = (ControlPoint("entry", (1.0, -2.0, 3.5)), ControlPoint("target", (10.1, 20.2, -30.3)))
PLACED = Rigid(ROTATION, np.array(POINTS[0].position))
MARKUPS = (
    Markup("Fiducial", "plan", (*POINTS, ControlPoint("later", None))),
    Markup("Line", "axis", POINTS),
    Markup("Curve", "path", (*POINTS, ControlPoint("end", (4.0, 5.0, 6.0)))),
    Markup("ROI", "box", POINTS[:1], PLACED, (10.0, 20.0, 30.5)),
    Markup("Plane", "skin", POINTS[:1], PLACED, (50.0, 60.0, 0.0)),
)


def label_map():
    """Two layers in an oblique image; label 1 is in both."""
    labels = np.zeros((2, 8, 7, 6), int)
    labels[0, 1:3, 1:6, 1:5], labels[0, 4:7, 2:5, 2:4], labels[1, 2:6, 1:4, 1:3] = 1, 2, 1
    return LabelMap(labels, AFFINE, (Segment(0, 1, "skin"), Segment(0, 2, "liver"), Segment(1, 1, "Gefäß")))


def mesh():
    points = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]]) @ ROTATION.T + [100.1, -200.2, 300.3]
    return Mesh(points, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))


def apart(first, second):
    """Return the largest difference of two arrays of numbers, inf for different shapes."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    return np.abs(first - second).max(initial=0.0) if first.shape == second.shape else np.inf


def check_slicerio(folder):
    """Yield a name, a difference and its limit: segmentations and point lists, written here and by 3D Slicer."""
    import slicerio

    data = Path(slicerio.__file__).parent / "data"
    write_label_map(label_map(), folder / "ours.seg.nrrd")
    for path in (folder / "ours.seg.nrrd", *sorted(data.glob("*.seg.nrrd"))):
        ours, theirs = read_label_map(path), slicerio.read_segmentation(str(path))
        voxels = theirs["voxels"].reshape(ours.labels.shape)
        yield f"slicerio, voxels of {path.name}", apart(ours.labels, voxels), 0.0
        to_ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ theirs["ijkToLPS"]
        yield f"slicerio, affine of {path.name}", apart(ours.affine, to_ras), EXACT
        # slicerio reads by pynrrd, which drops all characters of names beyond ASCII.
        names = [
            (each.layer, each.label, each.name.encode("ascii", "ignore").decode()) for each in ours.segments
        ]
        same = names == [(each["layer"], each["labelValue"], each["name"]) for each in theirs["segments"]]
        yield f"slicerio, segments of {path.name}", float(not same), 0.0
    for path in sorted(data.glob("*.fcsv")):
        (theirs,) = slicerio.read_markups_fcsv(path)["markups"]
        positions = np.array([each["position"] for each in theirs["controlPoints"]]) * [-1, -1, 1]
        yield f"slicerio, points of {path.name}", apart(read_markups(path)[0].positions, positions), EXACT


def load(kind, storage, path):
    """Return a scene, its node that 3D Slicer reads from a file, and the file that it writes from the node."""
    import slicer

    scene = slicer.vtkMRMLScene()
    node, reader = scene.AddNewNodeByClass(kind), getattr(slicer, storage)()
    scene.AddNode(reader)
    back = path.with_name(f"back-{path.name}")
    for name, carry_out in ((path, reader.ReadData), (back, reader.WriteData)):
        reader.SetFileName(str(name))
        if not carry_out(node):
            raise SystemExit(f"3D Slicer fails at {name.name}")
    return scene, node, back


def elements(matrix):
    return [[matrix.GetElement(i, j) for j in range(4)] for i in range(4)]


def check_markups(folder):
    """Yield checks of markups in 3D Slicer's scene, and of its files here."""
    import vtk

    for markup in MARKUPS:
        path = folder / f"{markup.name}.mrk.json"
        write_markups([markup], path)
        special = markup.kind if markup.placement is not None else ""
        _scene, node, back = load(
            f"vtkMRMLMarkups{markup.kind}Node", f"vtkMRMLMarkups{special}JsonStorageNode", path
        )
        given = [point.position for point in markup.points]
        known = [k for k, position in enumerate(given) if position is not None]
        theirs = [node.GetNthControlPointPositionStatus(k) == 2 for k in range(len(given))]
        yield (
            f"scene, defined points of {path.name}",
            apart([k in known for k in range(len(given))], theirs),
            0.0,
        )
        ours, (found,) = [given[k] for k in known], read_markups(back)
        theirs = [node.GetNthControlPointPosition(k) for k in known]
        yield f"scene, points of {path.name}", apart(ours, theirs), EXACT
        yield f"scene, points of {back.name}", apart(ours, [found.points[k].position for k in known]), EXACT
        if markup.placement is not None:
            placement = np.column_stack([PLACED.rotation, PLACED.translation])
            matrix = vtk.vtkMatrix4x4()
            if markup.kind == "Plane":
                node.GetObjectToWorldMatrix(matrix)
            else:
                matrix = node.GetObjectToWorldMatrix()
            theirs = elements(matrix)[:3]
            yield f"scene, placement of {path.name}", apart(placement, theirs), EXACT
            theirs = np.column_stack([found.placement.rotation, found.placement.translation])
            yield f"scene, placement of {back.name}", apart(placement, theirs), EXACT
            size = node.GetSize()
            yield f"scene, size of {path.name}", apart(markup.size[: len(size)], size), EXACT


def check_transform(folder):
    """Yield checks of a transform in 3D Slicer's scene, and of its file here."""
    import vtk

    write_transform(AFFINE, folder / "node.tfm")
    _scene, node, back = load(
        "vtkMRMLLinearTransformNode", "vtkMRMLTransformStorageNode", folder / "node.tfm"
    )
    matrix = vtk.vtkMatrix4x4()
    node.GetMatrixTransformToParent(matrix)
    yield "scene, matrix of node.tfm", apart(AFFINE, elements(matrix)), EXACT
    yield f"scene, matrix of {back.name}", apart(AFFINE, read_transform(back)), EXACT


def check_meshes(folder):
    """Yield checks of surfaces in 3D Slicer's scene, and of its files here."""
    from vtk.util.numpy_support import vtk_to_numpy

    corners = mesh().points[mesh().triangles]
    for suffix in SUFFIXES:
        path = folder / f"needle{suffix}"
        write_mesh(mesh(), path)
        _scene, node, back = load("vtkMRMLModelNode", "vtkMRMLModelStorageNode", path)
        points = vtk_to_numpy(node.GetPolyData().GetPoints().GetData())
        faces = vtk_to_numpy(node.GetPolyData().GetPolys().GetConnectivityArray()).reshape(-1, 3)
        yield f"scene, triangles of {path.name}", apart(corners, points[faces]), SINGLE
        found = read_mesh(back)
        yield f"scene, triangles of {back.name}", apart(corners, found.points[found.triangles]), SINGLE


def check_segmentation(folder):
    """Yield checks of 3D Slicer's file of a segmentation with overlapping segments."""
    image, path = label_map(), folder / "ours.seg.nrrd"
    write_label_map(image, path)
    _scene, _node, back = load("vtkMRMLSegmentationNode", "vtkMRMLSegmentationStorageNode", path)
    found = read_label_map(back)
    for segment in image.segments:
        ours, theirs = places(image, segment), places(found, found.find_segment(segment.name))
        yield f"scene, voxels of {segment.name} in {back.name}", apart(ours, theirs), EXACT


def check_export(folder):
    """Yield checks of an exported plan in 3D Slicer's scene: curves, models, and the transform between the frames."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    w, x, y, z = from_vector(np.array([0.3, -0.4, 0.5])).tolist()
    scenario = load_scenario("phantom3d").with_values(
        {
            "image.rotation": [w, x, y, z],
            "image.translation_mm": [30.0, -120.0, 15.0],
            "zone": [{"shape": "sphere", "name": "vessel", "center_mm": [30.0, 20.0, 0.0], "radius_mm": 4.0}],
            **dict.fromkeys(("plan.samples", "plan.iterations", "plan.max_iterations"), 32),
        }
    )
    made = plan(scenario, threads=1)
    to_image = Rigid(to_matrix(np.array([w, x, y, z])), np.array([30.0, -120.0, 15.0])).inverse()
    for path in write_scene({"manipulation": made}, folder / "export"):
        if path.name.endswith(".mrk.json"):
            (ours,) = read_markups(path)
            _scene, node, _back = load(
                f"vtkMRMLMarkups{ours.kind}Node", "vtkMRMLMarkupsJsonStorageNode", path
            )
            theirs = [node.GetNthControlPointPosition(k) for k in range(node.GetNumberOfControlPoints())]
            yield f"scene, points of {path.name}", apart(ours.positions, theirs), EXACT
            if path.name == "entry-and-target.mrk.json":
                yield "scene, target", apart(to_image.apply(np.array(made.target)), theirs[1]), EXACT
        elif path.suffix == ".ply":
            _scene, node, _back = load("vtkMRMLModelNode", "vtkMRMLModelStorageNode", path)
            points = vtk_to_numpy(node.GetPolyData().GetPoints().GetData())
            ours = read_mesh(path).points
            yield f"scene, extent of {path.name}", apart(np.ptp(ours, axis=0), np.ptp(points, axis=0)), SINGLE
            yield f"scene, place of {path.name}", apart(ours.min(axis=0), points.min(axis=0)), SINGLE
        else:
            _scene, node, _back = load("vtkMRMLLinearTransformNode", "vtkMRMLTransformStorageNode", path)
            matrix = vtk.vtkMatrix4x4()
            node.GetMatrixTransformToParent(matrix)
            expected = np.column_stack([to_image.rotation, to_image.translation])
            yield f"scene, matrix of {path.name}", apart(expected, elements(matrix)[:3]), EXACT


def check_example(folder):
    """Yield checks of the synthetic abdomen in 3D Slicer's scene: voxels of each segment and points."""
    label_path, points_path, _case = write_example(folder / "abdomen", 0, (2.0, 2.0, 2.0))
    _scene, _node, back = load("vtkMRMLSegmentationNode", "vtkMRMLSegmentationStorageNode", label_path)
    ours, theirs = read_label_map(label_path), read_label_map(back)
    for segment in ours.segments:
        found = places(theirs, theirs.find_segment(segment.name))
        yield f"scene, voxels of {segment.name} in {back.name}", apart(places(ours, segment), found), EXACT
    _scene, node, _back = load("vtkMRMLMarkupsFiducialNode", "vtkMRMLMarkupsJsonStorageNode", points_path)
    theirs = [node.GetNthControlPointPosition(k) for k in range(4)]
    yield "scene, points of the abdomen", apart(read_markups(points_path)[0].positions, theirs), EXACT


def places(image, segment):
    """Return the centres (n, 3) of the voxels of a segment, RAS (mm), in one order for all files."""
    rows = np.argwhere(image.mask(segment)) @ image.affine[:3, :3].T + image.affine[:3, 3]
    return rows[np.lexsort(np.round(rows, 6).T)]


def main():
    """Print all checks; return 1 if one fails or none can be made."""
    tried, failed, missing = 0, 0, set()
    with TemporaryDirectory() as folder:
        for module, package, checks in (
            ("slicerio", "slicerio", check_slicerio),
            ("slicer", "slicer-core", check_markups),
            ("slicer", "slicer-core", check_transform),
            ("slicer", "slicer-core", check_meshes),
            ("slicer", "slicer-core", check_segmentation),
            ("slicer", "slicer-core", check_export),
            ("slicer", "slicer-core", check_example),
        ):
            if find_spec(module) is None:
                missing.add(package)
                continue
            for name, difference, limit in checks(Path(folder)):
                tried, failed = tried + 1, failed + (not difference <= limit)
                print(f"{'ok  ' if difference <= limit else 'FAIL'} {difference:8.1e}  {name}")
    for package in sorted(missing):
        print(f"NOT TRIED: {package} is not installed: pip install {package}")
    print(f"{tried} checks, {failed} failed")
    return int(failed > 0 or tried == 0)


if __name__ == "__main__":
    sys.exit(main())
