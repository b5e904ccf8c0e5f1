"""Cases by an image: frame, layers and zones against an image whose geometry is known, and the synthetic abdomen."""

import math
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
from scipy.spatial import cKDTree

from flexneedle.errors import FileError
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.abdomen import make_abdomen
from flexneedle.lab.images.case_import import import_case
from flexneedle.lab.images.example import write_example
from flexneedle.lab.images.label_map import LabelMap
from flexneedle.lab.images.markups import read_markups
from flexneedle.lab.images.volumes import read_label_map, write_label_map
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.simulator.zones import zones_of
from lab.images.image_cases import ENDS, TEXT, VESSEL, label_map, rename_points, to_ras, write_case


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("case")


def to_needle(scenario):
    return Rigid(to_matrix(np.array(scenario.image.rotation)), np.array(scenario.image.translation_mm))


def test_skin_layers_target_and_zone_of_flat_layers(folder):
    """With voxels of 1 mm, oblique to the layers."""
    made = import_case(write_case(folder))
    scenario = made.scenario
    assert scenario.target.position == pytest.approx((45.0, 0.0, 0.0), abs=0.3)
    assert [layer.name for layer in scenario.tissue] == ["fat", "muscle", "liver"]
    assert scenario.layer_tops == pytest.approx((0.0, *ENDS[:2]), abs=0.7)
    superficial, deep = load_scenario("phantom3d").tissue
    assert [layer.shear_modulus_kpa for layer in scenario.tissue] == [
        superficial.shear_modulus_kpa,
        4.0,
        deep.shear_modulus_kpa,
    ]
    assert scenario.tissue[2].thickness_mm is None
    mapped = to_needle(scenario).apply(to_ras(VESSEL[0]))
    assert mapped[0] == pytest.approx(VESSEL[0][0], abs=0.3)
    assert math.hypot(*mapped[1:]) == pytest.approx(math.hypot(*VESSEL[0][1:]), abs=0.01)
    assert scenario.entry.free_radius_mm == 10.0
    assert scenario.image.sd_mm == 0.5
    assert made.doubts[0].startswith("skin: tilted by 0.")
    assert PageSession.of("case", scenario).describe().doubts == list(made.doubts)


def test_the_saved_scenario_is_the_same_and_needs_no_case(folder, tmp_path):
    scenario = import_case(write_case(folder)).scenario
    (tmp_path / "saved.toml").write_text(dump_scenario(scenario))
    again = load_scenario(tmp_path / "saved.toml")
    assert again == scenario
    (zone,) = again.zone
    assert Path(zone.file).is_absolute()
    assert zone.sha256 is not None


def test_the_clearance_of_a_zone_is_from_where_the_vessel_is(folder):
    scenario = import_case(write_case(folder)).scenario
    zones = zones_of(scenario)
    at = to_needle(scenario).apply(to_ras(VESSEL[0]))
    across = np.cross([1.0, 0.0, 0.0], at)
    point = at + 10.0 * across / np.linalg.norm(across)
    clear = 10.0 - VESSEL[1] - 0.5 * scenario.needle.outer_diameter - 2.0 * 0.5
    found = zones.clearances(point[None])[0, 0]
    assert clear - 1.2 < found < clear + 0.5  # a voxel to either side, and the bound


def test_what_is_added_to_the_margin_of_a_zone_is_printed(folder):
    """2.33 times the registration's 0.5 mm, and the rest."""
    made = import_case(write_case(folder))
    added = zones_of(made.scenario).added[0] - 2.33 * 0.5
    (line,) = [line for line in made.lines if line.startswith("zone to avoid: ")]
    assert line == (
        f"zone to avoid: vessel, margin 3 mm + 1.2 mm registration + {added:.2g} mm voxels and contacts"
    )


@pytest.mark.parametrize("tilt_deg", [5.0, 12.0])
def test_a_tilted_skin_is_a_plane_whose_tilt_is_reported(folder, tilt_deg):
    """Insertion in the plane x, y of the layers, with the same entry."""
    tilt = math.radians(tilt_deg)
    made = import_case(write_case(folder, target=(45.0, 45.0 * math.tan(tilt), 0.0)))
    assert made.scenario.target.depth_mm == pytest.approx(45.0 / math.cos(tilt), abs=0.4)
    reported = float(made.doubts[0].split("tilted by ")[1].split()[0])
    assert reported == pytest.approx(tilt_deg, abs=0.6)
    shift = float(made.doubts[0].split("by ")[2].split()[0])
    assert shift == pytest.approx(10.0 * math.tan(tilt), abs=0.2)
    # Along the insertion a layer is thicker by 1/cos.
    assert made.scenario.layer_tops[2] == pytest.approx(ENDS[1] / math.cos(tilt), abs=0.8)


def test_a_skin_that_is_too_oblique_is_refused(folder):
    with pytest.raises(FileError, match=r"the skin is tilted by 2[45].* degrees .* must be at most 20"):
        import_case(write_case(folder, target=(45.0, 45.0 * math.tan(math.radians(25.0)), 0.0)))


def test_a_direction_other_than_from_entry_to_target(folder):
    text = 'direction = "axis"\n' + TEXT
    made = import_case(write_case(folder, text, target=(45.0, 3.0, 4.0)))
    x, y, z = made.scenario.target.position
    assert (x, math.hypot(y, z)) == pytest.approx((45.0, 5.0), abs=0.3)


def test_a_target_outside_of_the_image_is_refused(tmp_path):
    """45 mm deep along RAS of an image that ends at a depth of 40 mm there."""
    image = label_map()
    path = write_case(tmp_path)
    target = np.linalg.solve(image.affine, [*to_ras([45.0, 0.0, 0.0]), 1.0])[:3]
    axis = int(np.abs(target - np.array(image.labels.shape[1:]) / 2).argmax())
    end = int(target[axis]) - 4
    cut = [slice(None)] * 3
    cut[axis] = slice(None, end)
    cropped = LabelMap(image.labels[:, *cut], image.affine, image.segments)
    write_label_map(cropped, tmp_path / "image.seg.nrrd")
    with pytest.raises(
        FileError, match=rf"target = 'target': must be in the label map.* {target[axis] - end + 0.5:.1f} mm"
    ):
        import_case(path)


def test_an_entry_off_the_skin_is_moved_along_the_insertion(folder):
    made = import_case(write_case(folder, entry=(-3.0, 0.0, 0.0)))
    assert made.scenario.target.depth_mm == pytest.approx(45.0, abs=0.3)
    (skin,) = [line for line in made.lines if line.startswith("skin: plane within 15 mm of entry, which is ")]
    assert skin.endswith(" mm above it")
    assert float(skin.split()[9]) == pytest.approx(3.0, abs=0.3)


def test_gaps_thin_layers_and_a_zone_above_the_skin_are_named_with_their_sizes(tmp_path):
    image = label_map()
    labels = image.labels.copy()
    centres = np.indices(labels.shape[1:]).reshape(3, -1).T @ image.affine[:3, :3].T + image.affine[:3, 3]
    local = ((centres - to_ras([0.0, 0.0, 0.0])) @ np.linalg.inv(_turn()).T).reshape(*labels.shape[1:], 3)
    labels[0][(local[..., 0] > 25.0) & (local[..., 0] < 30.0)] = 0
    beside = np.hypot(local[..., 1] - 8.0, local[..., 2]) < 4.0
    labels[1][beside & (local[..., 0] > -12.0) & (local[..., 0] < 4.0)] = 1
    write_label_map(LabelMap(labels, image.affine, image.segments), tmp_path / "image.seg.nrrd")
    made = import_case(write_case(tmp_path))
    (gap,) = [line for line in made.doubts if line.startswith("no layer from")]
    low, high = (float(word) for word in (gap.split()[3], gap.split()[5]))
    assert (low, high) == pytest.approx((25.0, 30.0), abs=1.0)
    (above,) = [line for line in made.doubts if line.startswith("zone vessel: up to")]
    assert float(above.split()[4]) == pytest.approx(12.0, abs=1.0)
    assert len(made.scenario.tissue) == 3


def _turn():
    return np.column_stack([to_ras(axis) - to_ras([0.0, 0.0, 0.0]) for axis in np.eye(3)])


def test_two_points_of_one_name_are_told_apart_by_the_name_of_their_markup(folder):
    path = write_case(folder, TEXT.replace('"target"', '"points/target"', 1))
    assert import_case(path).scenario.target.depth_mm == pytest.approx(45.0, abs=0.3)
    write_case(folder)
    rename_points(folder, "later", "target")
    with pytest.raises(FileError, match=r"target = 'target': must name one point of the markups, here 2"):
        import_case(folder / "case.toml")


def test_a_label_map_of_nifti_is_the_same_case(folder, tmp_path):
    """Written by nibabel, with the vessel in the one layer and names by labels."""
    image = label_map()
    labels = np.where(image.labels[1] > 0, 4, image.labels[0]).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(labels, image.affine), tmp_path / "image.nii.gz")
    text = TEXT.replace("image.seg.nrrd", "image.nii.gz")
    for number, name in enumerate(("fat", "muscle", "liver", "vessel"), 1):
        text = text.replace(f'"{name}"', f'"Segment_{number}"')
    made = import_case(write_case(tmp_path, text))
    one = made.scenario
    assert "image image.nii.gz: unit not stated, mm assumed" in made.doubts
    other = import_case(write_case(folder)).scenario
    assert one.target == other.target
    assert one.image.model_copy(update={"doubts": other.image.doubts}) == other.image
    assert one.layer_tops == other.layer_tops
    points = np.random.default_rng(0).uniform([5.0, -20.0, -20.0], [60.0, 20.0, 20.0], (500, 3))
    np.testing.assert_allclose(
        zones_of(one).clearances(points), zones_of(other).clearances(points), atol=1e-4
    )


# ---- the synthetic abdomen


@pytest.mark.filterwarnings("ignore:datetime.datetime.utcnow:DeprecationWarning")
def test_the_files_of_the_abdomen_by_pynrrd(tmp_path):
    """Positions of voxels agree with the anatomy: the target is in the middle of its lesion."""
    labels, points, _ = write_example(tmp_path, 3, (1.0, 1.0, 2.0))
    values, header = nrrd.read(str(labels))
    assert header["space"] == "left-posterior-superior"
    lesion = int(header["Segment7_LabelValue"]), int(header["Segment7_Layer"])
    assert header["Segment7_Name"] == "lesion 1"
    index = np.argwhere(values[lesion[1]] == lesion[0])
    lps = index @ header["space directions"][1:] + header["space origin"]
    centre = (lps.min(axis=0) + lps.max(axis=0)) / 2.0 * [-1.0, -1.0, 1.0]
    np.testing.assert_allclose(centre, positions(points)["target 1"], atol=1.1)


def positions(path):
    (markup,) = read_markups(path)
    return dict(zip([point.label for point in markup.points], markup.positions, strict=True))


@pytest.mark.parametrize("seed", range(4))
def test_the_straight_line_runs_into_a_vessel_and_the_first_one_into_a_rib(seed):
    """By the voxels; and another line from nearby is clear."""
    made = make_abdomen(seed)
    image, points = made.image, made.points.positions
    trees = [
        cKDTree(
            np.argwhere(image.mask(image.find_segment(name))) @ image.affine[:3, :3].T + image.affine[:3, 3]
        )
        for name in ("ribs", "vessels")
    ]
    rng = np.random.default_rng(seed)
    for entry, target in points.reshape(2, 2, 3):
        way = target - entry
        across = np.cross(way, rng.normal(size=(400, 3)))
        across /= np.linalg.norm(across, axis=1)[:, None]
        entries = np.concatenate([entry[None], entry + rng.uniform(0.0, 10.0, (400, 1)) * across])
        share = np.linspace(0.0, 1.0, 80)[:, None]
        lines = entries[:, None] + share * (target - entries[:, None])
        ribs, vessels = (tree.query(lines)[0].min(axis=1) for tree in trees)
        assert vessels[0] < 1.0
        assert np.minimum(ribs, vessels)[1:].max() > 3.0
        if (entry == points[0]).all():
            assert ribs[0] < 1.5


def test_the_same_seed_is_the_same_anatomy_at_any_voxel_size(tmp_path):
    one, other = (write_example(tmp_path / name, 5, (2.0, 2.0, 2.0)) for name in ("one", "other"))
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in other]
    thick = make_abdomen(5, (0.9, 0.9, 5.0))
    fine, coarse = read_label_map(one[0]), thick.image
    assert (thick.points.positions == np.array(list(positions(one[1]).values()))).all()
    for segment in coarse.segments[:4]:
        volumes = [
            each.mask(segment).sum() * abs(np.linalg.det(each.affine[:3, :3])) for each in (fine, coarse)
        ]
        assert volumes[0] == pytest.approx(volumes[1], rel=0.1)


@pytest.mark.parametrize(("seed", "number"), [(0, 1), (1, 2)])
def test_the_abdomen_is_a_scenario_whose_straight_line_is_not_clear(tmp_path, seed, number):
    case = write_example(tmp_path, seed, (1.0, 1.0, 1.0))[2]
    if number == 2:
        case.write_text(
            case.read_text().replace('"entry 1"', '"entry 2"').replace('"target 1"', '"target 2"')
        )
    scenario = import_case(case).scenario
    assert [layer.name for layer in scenario.tissue] == ["skin, fat", "muscle", "liver, other organs"]
    target = np.array(scenario.target.position)
    line = np.linspace(0.02, 1.0, 60)[:, None] * target
    clearance = zones_of(scenario).clearances(line).min(axis=1)
    assert clearance[1] < 0.0
    if number == 1:
        assert clearance[0] < 0.0
