"""Surfaces: STL, PLY and OBJ against trimesh used directly, and the comment that names the frame."""

import numpy as np
import pytest
import trimesh

from flexneedle.errors import InputError
from flexneedle.lab.images.meshes import SUFFIXES, Mesh, read_mesh, write_mesh

ASCII_STL = (
    "solid{comment}\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 10 0 0\nvertex 0 10 5\n"
    "endloop\nendfacet\nendsolid\n"
)


def sphere():
    """A surface whose coordinates are exact in single precision."""
    ball = trimesh.creation.icosphere(2, 20.0)
    points = ball.vertices.astype(np.float32) + np.array([1.0, -20.0, 300.0], np.float32)
    return Mesh(points.astype(float), np.array(ball.faces))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_surface_comes_back_and_is_in_lps_in_its_file(tmp_path, suffix):
    mesh, path = sphere(), tmp_path / f"liver{suffix}"
    write_mesh(mesh, path)
    found = read_mesh(path)
    np.testing.assert_allclose(found.points[found.triangles], mesh.points[mesh.triangles], atol=1e-6)
    other = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(other.triangles, (mesh.points * [-1, -1, 1])[mesh.triangles], atol=1e-6)
    assert other.volume > 0  # triangles still face outwards
    assert b"SPACE=LPS" in path.read_bytes()


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_decimal_files_keep_double_precision(tmp_path, suffix):
    mesh = Mesh(sphere().points * np.pi, sphere().triangles)
    write_mesh(mesh, tmp_path / f"liver{suffix}")
    np.testing.assert_array_equal(read_mesh(tmp_path / f"liver{suffix}").points, mesh.points)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_of_trimesh_needs_a_frame(tmp_path, suffix):
    mesh, path = sphere(), tmp_path / f"liver{suffix}"
    trimesh.Trimesh(mesh.points, mesh.triangles, process=False).export(path)
    with pytest.raises(InputError, match="has no comment SPACE=LPS or SPACE=RAS: name the frame, LPS or RAS"):
        read_mesh(path)
    for frame, signs in (("RAS", [1, 1, 1]), ("LPS", [-1, -1, 1])):
        found = read_mesh(path, frame=frame)
        expected = (mesh.points * signs)[mesh.triangles]
        np.testing.assert_allclose(found.points[found.triangles], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.stl", ASCII_STL.format(comment=" 3D Slicer output. SPACE={space}")),
        (
            "a.obj",
            "#  3D Slicer output. SPACE={space}\n\nmtllib a.mtl\nv 0 0 0\nv 10 0 0\nv 0 10 5\nf 1/1/1 2/2/1 3//1\n",
        ),
        (
            "a.ply",
            "ply\nformat ascii 1.0\ncomment VTK generated PLY File\ncomment SPACE={space}\nelement vertex 3\n"
            "property float x\nproperty float y\nproperty float z\nelement face 1\n"
            "property list uchar int vertex_indices\nend_header\n0 0 0\n10 0 0\n0 10 5\n3 0 1 2\n",
        ),
    ],
)
@pytest.mark.parametrize(("space", "signs"), [("RAS", [1, 1, 1]), ("LPS", [-1, -1, 1])])
def test_the_comment_of_3d_slicer_names_the_frame(tmp_path, name, text, space, signs):
    path = tmp_path / name
    path.write_text(text.replace("{space}", space))
    found = read_mesh(path, frame=space)
    expected = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 5]]) * signs
    np.testing.assert_array_equal(found.points[found.triangles[0]], expected)
    with pytest.raises(InputError, match="has two frames, LPS and RAS"):
        read_mesh(path, frame="LPS" if space == "RAS" else "RAS")


def test_polygons_are_triangles(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("# SPACE=RAS\nv 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\nf 1 2 3 4\n")
    mesh = read_mesh(path)
    area = np.linalg.norm(np.cross(*np.diff(mesh.points[mesh.triangles], axis=1).swapaxes(0, 1)), axis=1)
    assert area.sum() / 2 == pytest.approx(100.0)
