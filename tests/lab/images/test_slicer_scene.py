"""Files for 3D Slicer: positions in the image's frame against the map by hand, from the case to the files."""

from dataclasses import replace

import numpy as np
import pytest
from trimesh import Trimesh

import flexneedle
from commands import run
from flexneedle.lab.images.case_import import import_case
from flexneedle.lab.images.markups import read_markups
from flexneedle.lab.images.meshes import read_mesh
from flexneedle.lab.images.slicer_scene import write_scene
from flexneedle.lab.images.transforms import read_transform
from flexneedle.record.entries import read_entries
from flexneedle.record.folder import read_run
from flexneedle.scenario.files import load_scenario
from lab.images.image_cases import VESSEL, to_ras, write_case

EXACT = 1e-6


def with_small_search(scenario):
    return scenario.with_values({"plan.samples": 32, "plan.iterations": 3, "plan.max_iterations": 3})


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """An insertion in the case of flat layers, and the files."""
    folder = tmp_path_factory.mktemp("scene")
    scenario = import_case(write_case(folder)).scenario
    plan = flexneedle.plan(with_small_search(scenario), threads=1)
    insertion = flexneedle.insert(plan.scenario, plan, threads=1, force=True)
    return insertion, write_scene(insertion, folder / "slicer"), folder


def by_name(paths):
    return {path.name: path for path in paths}


def markups_of(paths):
    """Markups by name, of which each file has one."""
    files = [path for path in paths if path.name.endswith(".mrk.json")]
    found = [read_markups(path) for path in files]
    assert {len(each) for each in found} == {1}
    return {each.name: each for (each,) in found}


def image_from_needle(scenario, points):
    """Points (n, 3) of the needle's frame in RAS: the quaternion's matrix by its definition."""
    w, x, y, z = scenario.image.rotation
    vector = np.array([x, y, z])
    moved = np.asarray(points) - np.array(scenario.image.translation_mm)
    # The inverse rotation of each point p: p − 2 w (v × p) + 2 v × (v × p).
    across = np.cross(vector, moved)
    return moved - 2.0 * w * across + 2.0 * np.cross(vector, across)


def test_paths_points_and_needle_are_where_the_image_is(done):
    insertion, paths, _ = done
    markups = markups_of(paths)
    assert list(markups) == ["entry and target", "planned path", "executed path", "true path", "needle shape"]
    to_image = lambda points: image_from_needle(insertion.scenario, points)  # noqa: E731
    ends = markups["entry and target"].positions
    np.testing.assert_allclose(ends[1], to_image(insertion.plan.target), atol=EXACT)
    entry = insertion.plan.scenario.entry
    np.testing.assert_allclose(ends[0], to_image((0.0, entry.lateral_mm, entry.lateral_z_mm)), atol=EXACT)
    for name, points in {
        "planned path": insertion.plan.tips[:, :3],
        "executed path": np.array([period.estimate[:3] for period in insertion.periods]),
        "needle shape": np.asarray(insertion.periods[-1].shape)[:, :3],
    }.items():
        expected, found = to_image(points), markups[name].positions
        nearest = np.linalg.norm(found[:, None] - expected[None], axis=2).min(axis=1)
        assert nearest.max() < EXACT
        np.testing.assert_allclose(found[-1], expected[-1], atol=2e-3)  # points nearer than 1 µm are left out
    # The target of the plan is the point in the case.
    np.testing.assert_allclose(ends[1], to_ras([45.0, 0.0, 0.0]), atol=1e-5)


def test_the_transform_takes_the_needle_to_the_image(done):
    insertion, paths, _ = done
    matrix = read_transform(by_name(paths)["needle-to-image.tfm"])
    points = np.random.default_rng(0).uniform(-50.0, 50.0, (20, 3))
    mapped = points @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(mapped, image_from_needle(insertion.scenario, points), atol=EXACT)


def test_the_zone_is_around_the_vessel_with_its_margin(done):
    """The surface is up to the bound outside of the vessel's voxels; the margin adds what is added to clearances."""
    _, paths, _ = done
    centre, radius = to_ras(VESSEL[0]), VESSEL[1]
    for name, least, most in (
        ("zone-1-vessel.ply", radius - 0.7, radius + 0.7),
        ("zone-1-vessel-margin.ply", radius + 4.0 - 0.7, radius + 4.0 + 1.6),
    ):
        mesh = read_mesh(by_name(paths)[name])
        # Where two parts of a surface touch, an edge has four triangles.
        edges = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
        apart = np.linalg.norm(mesh.points - centre, axis=1)
        assert least < apart.min() < apart.max() < most


def test_the_needle_is_a_tube_around_its_shape(done):
    insertion, paths, _ = done
    mesh = read_mesh(by_name(paths)["needle.ply"])
    tube = Trimesh(mesh.points, mesh.triangles, process=False)
    shape = image_from_needle(insertion.scenario, np.asarray(insertion.periods[-1].shape)[:, :3])
    length = np.linalg.norm(np.diff(shape, axis=0), axis=1).sum()
    radius = 0.5 * insertion.scenario.needle.outer_diameter
    assert tube.is_watertight
    assert tube.volume == pytest.approx(0.974 * np.pi * radius**2 * length, rel=0.01)


def test_plans_by_strategy_in_the_frame_of_a_scenario_without_an_image(tmp_path):
    scenario = with_small_search(load_scenario("phantom3d"))
    plan = flexneedle.plan(scenario, threads=1)
    plans = {"manipulation": plan, "steering": replace(plan, strategy="steering")}
    paths = by_name(write_scene(plans, tmp_path / "files"))
    assert list(paths)[-3:] == ["needle-shape.mrk.json", "needle.ply", "needle-to-image.tfm"]
    markups = markups_of(paths.values())
    assert list(markups) == [
        "entry and target",
        "planned path, manipulation",
        "planned path, steering",
        "needle shape",
    ]
    np.testing.assert_allclose(markups["needle shape"].positions[-1], plan.shapes[-1, -1, :3], atol=EXACT)
    np.testing.assert_allclose(read_transform(paths["needle-to-image.tfm"]), np.eye(4))


@pytest.mark.usefixtures("drawing")
def test_the_commands_from_an_image_to_a_scene(capsys, in_tmp, engine):
    engine()
    status, out, _ = run(capsys, "image", "example", "abdomen", "--spacing", "2", "2", "2")
    assert (status, len(out.splitlines())) == (0, 3)
    status, _, err = run(capsys, "image", "example", "abdomen", "--seed", "1")
    assert (status, "abdomen: already exists and is not an empty folder" in err) == (2, True)
    status, out, _ = run(capsys, "plan", "--image", "abdomen/case.toml", "--out", "planned")
    assert "image (RAS) to needle frame: rotation (w x y z) " in out
    assert "outside of the model's assumptions:\n  skin: tilted by " in out
    status, out, err = run(capsys, "plan", "--image", "abdomen/case.toml", "--out", "again", "--json")
    assert out.startswith("{")
    assert "zone to avoid: ribs" in err
    status, out, _ = run(capsys, "export", "planned", "--slicer", "scene")
    assert status == 0
    assert out.splitlines()[-1] == "frame: image (LPS in files)"
    kept = {path: path.read_bytes() for path in (in_tmp / "scene").iterdir()}
    status, _, err = run(capsys, "export", "planned", "--slicer", "scene")
    assert (status, "scene: already contains an export" in err) == (2, True)
    assert {path: path.read_bytes() for path in (in_tmp / "scene").iterdir()} == kept
    labels = in_tmp / "abdomen/abdomen.seg.nrrd"
    for _ in range(2):  # a changed label map needs the scenario written again
        status, shown, _ = run(capsys, "image", "show", "abdomen/case.toml")
        (in_tmp / "mine.toml").write_text(shown)
        status, _, err = run(capsys, "scenario", "check", "mine.toml")
        assert (status, "has changed" in err) == (0, False)
        labels.write_bytes(labels.read_bytes().replace(b"\n", b"\n# edited\n", 1))
        assert "flexneedle image show CASE" in run(capsys, "scenario", "check", "mine.toml")[2]
    labels.unlink()
    status, _, err = run(capsys, "export", "planned", "--slicer", "without")
    assert (status, "not written: zone ribs: " in err) == (0, True)
    kept = {path.name for path in (in_tmp / "scene").iterdir() if not path.name.startswith("zone-")}
    assert {path.name for path in (in_tmp / "without").iterdir()} == kept


@pytest.mark.usefixtures("drawing")
def test_the_best_entries_of_an_image_are_on_its_skin(capsys, in_tmp):
    """At the abdomen's target of example: points where the needle's frame has x = 0, labelled by the tolerance."""
    run(capsys, "image", "example", "abdomen", "--spacing", "2", "2", "2")
    assert run(capsys, "plan", "--image", "abdomen/case.toml", "--entries", "--out", "map")[0] == 0
    status, out, _ = run(capsys, "export", "map", "--slicer", "scene")
    assert status == 0
    assert out.splitlines()[-1] == "frame: image (LPS in files)"
    scenario = read_run(in_tmp / "map").scenario
    found = read_entries(in_tmp / "map", scenario)
    (markup,) = read_markups(in_tmp / "scene/entries.mrk.json")
    best = found.best(10)
    expected = image_from_needle(scenario, np.insert(found.points[best], 0, 0.0, axis=1))
    np.testing.assert_allclose(markup.positions, expected, atol=EXACT)
    label = f"{found.clearance_mm[best[0]]:.1f} mm from {found.zone_name(best[0])}, tolerance "
    assert markup.points[0].label.startswith(f"{label}{found.offset_mm[best[0]]:.1f} mm, ")
    assert (in_tmp / "scene/zone-1-ribs.ply").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("plan", "phantom3d", "--image", "case.toml"), "phantom3d: not with --image: write it in case.toml"),
        (("plan", "--image", "case.toml", "--target", "40", "1"), "--target: not with --image"),
        (("plan", "--image", "none.toml"), "none.toml: no such file"),
        (
            ("export", "run", "--slicer", "scene", "--csv"),
            "--slicer: not with --csv, --readings or --sensors",
        ),
        (("export", "run"), "--csv, --readings, --sensors or --slicer: one must be given"),
        (("export", "run", "--slicer", "scene"), "run: contains no run"),
    ],
)
@pytest.mark.usefixtures("in_tmp")
def test_options_that_contradict_each_other(capsys, words, message):
    status, _, err = run(capsys, *words)
    assert status == 2
    assert message in err
    assert len(err.splitlines()) == 1
