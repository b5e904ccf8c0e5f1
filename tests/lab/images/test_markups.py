"""Markups of 3D Slicer: written and read, and the traps of `.mrk.json` and `.fcsv`."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.markups import KINDS, ControlPoint, Markup, read_markups, write_markups

SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/markups-schema-v1.0.{}.json#"
HEADER = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel\n"
PLACED = Rigid(Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix(), np.array([1.0, -20.0, 300.25]))
ENTRY, TARGET = ControlPoint("entry", (1.0, -2.0, 3.5)), ControlPoint("target, 2", (10.1, 20.2, -30.3))
UNPLACED = ControlPoint("later", None)


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file with one markup, or a text, and returns its path."""

    def write_file(content, name="plan.mrk.json", version=3):
        path = tmp_path / name
        if isinstance(content, dict):
            content = json.dumps({"@schema": SCHEMA.format(version), "markups": [content]})
        path.write_text(content, encoding="utf-8")
        return path

    return write_file


def one_point(position=(1.0, 2.0, 3.0), **fields):
    return {"type": "Fiducial", "controlPoints": [{"label": "a", "position": position} | fields]}


def test_every_kind_comes_back(tmp_path):
    markups = (
        Markup("Fiducial", "plan", (ENTRY, TARGET, UNPLACED)),
        Markup("Line", "axis", (ENTRY, UNPLACED)),
        Markup("Curve", "path", (ENTRY, TARGET, ENTRY)),
        Markup("ClosedCurve", "outline", (ENTRY, TARGET, ENTRY)),
        Markup("ROI", "box", (ENTRY,), PLACED, (10.0, 20.0, 30.5)),
        Markup("Plane", "skin", (ENTRY,), PLACED, (50.0, 60.0, 0.0)),
    )
    assert {each.kind for each in markups} == {*KINDS}
    write_markups(markups, tmp_path / "all.mrk.json")
    for given, found in zip(markups, read_markups(tmp_path / "all.mrk.json"), strict=True):
        assert (found.kind, found.name, found.points, found.size) == (
            given.kind,
            given.name,
            given.points,
            given.size,
        )
        if given.placement is not None:
            np.testing.assert_allclose(found.placement.rotation, PLACED.rotation, atol=1e-12)
            np.testing.assert_allclose(found.placement.translation, PLACED.translation, atol=1e-12)


def test_files_are_in_lps_and_defined(tmp_path):
    write_markups([Markup("Fiducial", "plan", (ENTRY, UNPLACED))], tmp_path / "plan.mrk.json")
    content = json.loads((tmp_path / "plan.mrk.json").read_text())
    (markup,) = content["markups"]
    assert content["@schema"].endswith("markups-schema-v1.0.3.json#")
    assert (markup["coordinateSystem"], markup["coordinateUnits"]) == ("LPS", "mm")
    assert [(each["position"], each["positionStatus"]) for each in markup["controlPoints"]] == [
        ([-1.0, 2.0, 3.5], "defined"),
        ("", "undefined"),
    ]


def test_a_plane_has_the_matrices_by_which_3d_slicer_places_it(tmp_path):
    """baseToNode · objectToBase, both stored with the signs of LPS, is the placement."""
    write_markups([Markup("Plane", "skin", (ENTRY,), PLACED)], tmp_path / "skin.mrk.json")
    (markup,) = json.loads((tmp_path / "skin.mrk.json").read_text())["markups"]
    signs = np.diag([-1.0, -1.0, 1.0, 1.0])
    base, node = (signs @ np.reshape(markup[key], (4, 4)) for key in ("objectToBase", "baseToNode"))
    np.testing.assert_allclose((node @ base)[:3], np.column_stack([PLACED.rotation, PLACED.translation]))
    np.testing.assert_allclose(markup["normal"], PLACED.rotation[:, 2] * [-1, -1, 1])


@pytest.mark.parametrize(("frame", "x", "y"), [("LPS", -1.0, -2.0), ("RAS", 1.0, 2.0), (None, -1.0, -2.0)])
def test_points_are_in_lps_unless_the_file_names_ras(write, frame, x, y):
    given = one_point() | ({} if frame is None else {"coordinateSystem": frame})
    assert read_markups(write(given))[0].points[0].position == (x, y, 3.0)


@pytest.mark.parametrize("unit", ["mm", ["mm", "UCUM", "millimeter"]])
def test_millimetres_are_the_unit(write, unit):
    assert read_markups(write(one_point() | {"coordinateUnits": unit}))[0].points[0].position is not None


@pytest.mark.parametrize("version", [0, 3, 4])
def test_all_schemas_of_version_1_are_read(write, version):
    assert read_markups(write(one_point(), version=version))[0].name == "plan"


@pytest.mark.parametrize(
    "point",
    [
        one_point(None),
        one_point(""),
        one_point(None, positionStatus="defined"),
        one_point(positionStatus="undefined"),
        one_point(positionStatus="preview"),
        one_point(positionStatus="missing"),
    ],
)
def test_a_point_without_position_or_status_defined_is_not_defined(write, point):
    (markup,) = read_markups(write(point))
    assert markup.points == (ControlPoint("a", None),)
    with pytest.raises(InputError, match="point 'a' of 'plan' is not defined: place it in 3D Slicer"):
        _ = markup.positions


def test_an_old_plane_is_placed_by_three_points(write):
    points = [{"position": each} for each in ([0, 0, 0], [-10, 0, 0], [-5, -5, 0])]
    (markup,) = read_markups(write({"type": "Plane", "controlPoints": points}))
    np.testing.assert_allclose(markup.placement.rotation, np.eye(3))


@pytest.mark.parametrize(
    ("frame", "position"), [("LPS", (-1, -2, 3)), ("1", (-1, -2, 3)), ("RAS", (1, 2, 3)), ("0", (1, 2, 3))]
)
def test_old_point_lists_are_in_the_frame_of_their_header(write, frame, position):
    rows = '1,1,2,3,0,0,0,1,1,1,0,"entry, left",,,2,0\n2,4,5,6,0,0,0,1,1,1,0,,,,0,0\n'
    (markup,) = read_markups(write(HEADER.format(frame) + rows, "old.fcsv"))
    assert (markup.kind, markup.name) == ("Fiducial", "old")
    assert markup.points == (ControlPoint("entry, left", position), ControlPoint("2", None))


def test_a_row_without_status_is_defined(write):
    (markup,) = read_markups(write(HEADER.format("LPS") + "1,1,2,3\n", "old.fcsv"))
    np.testing.assert_array_equal(markup.positions, [[-1, -2, 3]])
