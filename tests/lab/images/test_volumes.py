"""Label maps: read and written, against nibabel and pynrrd used directly, and the traps of their formats."""

import nibabel
import nrrd
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import InputError
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.volumes import READ, read_label_map, write_label_map

pytestmark = pytest.mark.filterwarnings(
    "ignore:datetime.datetime.utcnow:DeprecationWarning"
)  # pynrrd's writer
OBLIQUE = np.array(
    [[0.6, -0.4, 0.0, -93.1], [0.3, 0.8, 0.0, 16.4], [0.0, 0.0, 5.0, -340.25], [0.0, 0.0, 0.0, 1.0]]
)
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
SKIN, LIVER, VESSEL = Segment(0, 1, "skin"), Segment(0, 2, "liver"), Segment(1, 1, "Gefäß, 3 mm")


def blocks():
    """Two layers; label 1 is in both."""
    labels = np.zeros((2, 6, 5, 4), int)
    labels[0, :2], labels[0, 3:] = 1, 2
    labels[1, 1:4, 2:, 1:3] = 1
    return LabelMap(labels, OBLIQUE, (SKIN, LIVER, VESSEL))


def header(affine=OBLIQUE, **fields):
    lps = LPS @ affine
    return {
        "space": "left-posterior-superior",
        "space directions": lps[:3, :3].T,
        "space origin": lps[:3, 3],
        "kinds": ["domain"] * 3,
    } | fields


def segment_fields(number, **fields):
    return {f"Segment{number}_{key}": value for key, value in fields.items()}


@pytest.fixture
def write_nrrd(tmp_path):
    """Return a function that writes an NRRD file with pynrrd and reads it here."""

    def write(values, fields, name="image.seg.nrrd"):
        path = tmp_path / name
        nrrd.write(str(path), values, {key: value for key, value in fields.items() if value is not None})
        return read_label_map(path)

    return write


def test_overlapping_segments_come_back_with_layers_names_and_places(tmp_path):
    image, path = blocks(), tmp_path / "image.seg.nrrd"
    write_label_map(image, path)
    found = read_label_map(path)
    np.testing.assert_array_equal(found.labels, image.labels)
    np.testing.assert_allclose(found.affine, OBLIQUE, atol=1e-12)
    assert found.segments == image.segments
    assert found.mask(found.find_segment("Gefäß, 3 mm")).sum() == 3 * 3 * 2
    assert (found.mask(VESSEL) & found.mask(SKIN)).any()


def test_a_segmentation_is_what_pynrrd_reads(tmp_path):
    path = tmp_path / "image.seg.nrrd"
    write_label_map(blocks(), path)
    values, found = nrrd.read(str(path))
    np.testing.assert_array_equal(values, blocks().labels)
    assert (found["space"], found["kinds"]) == (
        "left-posterior-superior",
        ["list", "domain", "domain", "domain"],
    )
    assert np.isnan(found["space directions"][0]).all()
    np.testing.assert_allclose(found["space directions"][1:].T, (LPS @ OBLIQUE)[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found["space origin"], (LPS @ OBLIQUE)[:3, 3], atol=1e-6)
    assert (found["Segment2_Layer"], found["Segment2_LabelValue"]) == ("1", "1")
    assert found["Segmentation_MasterRepresentation"] == found["Segmentation_SourceRepresentation"]


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_a_nifti_file_is_what_nibabel_reads(tmp_path, suffix):
    path, layer = tmp_path / f"image{suffix}", blocks().labels[:1]
    write_label_map(LabelMap(layer, OBLIQUE, (SKIN,)), path)
    other, found = nibabel.load(path), read_label_map(path)
    np.testing.assert_array_equal(np.asarray(other.dataobj), layer[0])
    np.testing.assert_array_equal(found.labels, layer)
    np.testing.assert_allclose(found.affine, other.affine, atol=1e-6)
    np.testing.assert_allclose(found.affine, OBLIQUE, atol=1e-4)  # single precision
    assert [each.name for each in found.segments] == ["Segment_1", "Segment_2"]


@given(seed=st.integers(0, 2**32 - 1), space=st.sampled_from(["left-posterior-superior", "RAS"]))
def test_voxels_are_where_pynrrd_and_nibabel_place_them(tmp_path_factory, seed, space):
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("files")
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.3, 5.0, 3)
    affine = np.vstack([np.column_stack([turn, rng.uniform(-300, 300, 3)]), [0, 0, 0, 1]])
    labels = rng.integers(0, 4, rng.integers(2, 6, 3)).astype(np.uint8)
    fields = {"space": space, "space directions": affine[:3, :3].T, "space origin": affine[:3, 3]}
    nrrd.write(str(folder / "image.nrrd"), labels, fields)
    found, ras = read_label_map(folder / "image.nrrd"), affine if space == "RAS" else LPS @ affine
    np.testing.assert_allclose(found.affine, ras, atol=1e-6)
    made = nibabel.Nifti1Image(labels, affine)
    nibabel.save(made, folder / "image.nii")
    np.testing.assert_allclose(
        read_label_map(folder / "image.nii").affine, nibabel.load(folder / "image.nii").affine, atol=1e-6
    )


def test_a_detached_header_names_its_data(tmp_path):
    nrrd.write(str(tmp_path / "image.nhdr"), blocks().labels[0], header(), detached_header=True)
    found = read_label_map(tmp_path / "image.nhdr")
    np.testing.assert_array_equal(found.labels, blocks().labels[:1])


def test_the_corners_are_half_a_voxel_beyond_the_centres():
    image = LabelMap(np.ones((1, 2, 2, 2)), np.diag([2.0, 2.0, 4.0, 1.0]), ())
    np.testing.assert_array_equal(image.corners.min(axis=0), [-1.0, -1.0, -2.0])
    np.testing.assert_array_equal(image.corners.max(axis=0), [3.0, 3.0, 6.0])


def test_old_files_have_a_layer_for_each_segment_and_the_old_key(write_nrrd):
    old = {"Segmentation_MasterRepresentation": "Binary labelmap"}
    for number, name in enumerate(("skin", "vein")):
        old |= segment_fields(number, ID=name, Name=name)
    directions = np.vstack([np.full(3, np.nan), (LPS @ OBLIQUE)[:3, :3].T])
    fields = header(kinds=["list", *["domain"] * 3]) | {"space directions": directions} | old
    found = write_nrrd((blocks().labels == 1).astype(np.uint8), fields)
    assert found.segments == (Segment(0, 1, "skin"), Segment(1, 1, "vein"))


@pytest.mark.parametrize("key", ["Segmentation_MasterRepresentation", "Segmentation_SourceRepresentation"])
def test_fractional_segments_are_refused_by_both_keys(write_nrrd, key):
    fields = header() | segment_fields(0, Name="skin") | {key: "Fractional labelmap"}
    with pytest.raises(InputError, match=f"{key} = 'Fractional labelmap': must be Binary labelmap"):
        write_nrrd(blocks().labels[0], fields)


def test_a_single_voxel_is_an_empty_segmentation(write_nrrd):
    """3D Slicer writes one voxel for a segmentation without any, whatever its label is."""
    fields = header() | segment_fields(0, Name="skin", LabelValue="1", Layer="0", Extent="0 -1 0 -1 0 -1")
    found = write_nrrd(np.ones((1, 1, 1), np.uint8), fields)
    assert not found.mask(found.find_segment("skin")).any()
    assert write_nrrd(np.ones((1, 1, 1), np.uint8), header()).segments == ()
    assert write_nrrd(np.ones((1, 1, 1), np.uint8), header(), "plain.nrrd").labels.any()


@pytest.mark.parametrize("extent", ["0 1 0 4 0 3", "10 11 20 24 30 33"])
def test_a_cropped_segment_is_where_its_voxels_are(write_nrrd, extent):
    """The origin of a cropped file has its offset already; extents are of the file, or of the reference image."""
    fields = header() | segment_fields(0, Name="skin", LabelValue="1", Layer="0", Extent=extent)
    found = write_nrrd(blocks().labels[0], fields | {"Segmentation_ReferenceImageExtentOffset": "10 20 30"})
    np.testing.assert_allclose(found.affine, OBLIQUE, atol=1e-12)
    assert found.mask(found.segments[0]).sum() == 40


def make_nifti(tmp_path, change, labels=None):
    made = nibabel.Nifti1Image(blocks().labels[0].astype(np.int16) if labels is None else labels, OBLIQUE)
    made.set_sform(np.diag([1.0, 1.0, 2.0, 1.0]), 1)
    made.set_qform(np.diag([1.0, 1.0, 2.0, 1.0]), 1)
    change(made)
    nibabel.save(made, tmp_path / "image.nii")
    return read_label_map(tmp_path / "image.nii")


@pytest.mark.parametrize(
    "change",
    [
        lambda made: made.set_qform(None, 0),
        lambda made: made.set_sform(None, 0),
        lambda made: made.header.__setitem__("qoffset_x", 0.009),
        lambda made: made.header.set_xyzt_units("mm", "sec"),
    ],
)
def test_one_valid_form_or_two_equal_ones_place_a_nifti_image(tmp_path, change):
    np.testing.assert_allclose(make_nifti(tmp_path, change).affine, np.diag([1, 1, 2, 1]), atol=0.01)


def test_forms_that_differ_at_a_far_corner_are_refused(tmp_path):
    """The forms agree at the first voxel, and differ by 0.03 mm at the last slice."""
    with pytest.raises(
        InputError, match=r"sform and qform differ by 0.03 mm at a corner, must be at most 0.01 mm"
    ):
        make_nifti(tmp_path, lambda made: made.set_sform(np.diag([1.0, 1.0, 2.01, 1.0]), 1))


def test_scaled_and_float_labels_are_whole_numbers(tmp_path):
    """The values in the file are 2 and 4, their slope is 2."""
    found = make_nifti(tmp_path, lambda made: made.header.set_slope_inter(2.0, 0.0), blocks().labels[0] * 2.0)
    np.testing.assert_array_equal(found.labels, blocks().labels[:1] * 4)


def test_a_name_is_unique_or_refused():
    image = LabelMap(np.ones((1, 2, 2, 2)), np.eye(4), (Segment(0, 1, "vein"), Segment(0, 2, "vein")))
    with pytest.raises(InputError, match="several segments have this name"):
        image.find_segment("vein")
    with pytest.raises(InputError, match=r"segment = 'bone': no such segment \(segments: vein, vein\)"):
        image.find_segment("bone")


def test_nifti_refuses_layers_and_other_suffixes_are_named(tmp_path):
    with pytest.raises(InputError, match=r"layers = 2: NIfTI has one layer: write .seg.nrrd"):
        write_label_map(blocks(), tmp_path / "image.nii")
    with pytest.raises(InputError, match=r"image.mha must end in .seg.nrrd, .nii, .nii.gz"):
        write_label_map(blocks(), tmp_path / "image.mha")
    (tmp_path / "image.mha").write_text("")
    with pytest.raises(InputError, match=f"must end in {', '.join(READ)}"):
        read_label_map(tmp_path / "image.mha")


@pytest.mark.parametrize("name", ["", " vein", "vein\nSegment0_Layer:=1"])
def test_a_name_that_a_header_cannot_hold_is_not_written(tmp_path, name):
    with pytest.raises(InputError, match=r"name of a segment = .*: must be printable"):
        write_label_map(
            LabelMap(np.ones((1, 2, 2, 2)), np.eye(4), (Segment(0, 1, name),)), tmp_path / "a.seg.nrrd"
        )


def test_labels_above_255_come_back(tmp_path):
    image = LabelMap(np.arange(8).reshape(1, 2, 2, 2) * 1000, OBLIQUE, (Segment(0, 3000, "skin"),))
    write_label_map(image, tmp_path / "a.seg.nrrd")
    np.testing.assert_array_equal(read_label_map(tmp_path / "a.seg.nrrd").labels, image.labels)
    np.testing.assert_array_equal(nrrd.read(str(tmp_path / "a.seg.nrrd"))[0], image.labels[0])


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("flexneedle.arguments.find_spec", lambda _: None)
    with pytest.raises(
        InputError, match=r"nibabel and nrrd: not installed: pip install 'flexneedle\[images\]'"
    ):
        read_label_map(tmp_path / "image.nii")


def test_a_sheared_affine_has_no_qform(tmp_path):
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    write_label_map(LabelMap(np.ones((1, 3, 3, 3)), sheared, ()), tmp_path / "image.nii")
    assert nibabel.load(tmp_path / "image.nii").header["qform_code"] == 0
    np.testing.assert_array_equal(read_label_map(tmp_path / "image.nii").affine, sheared)


def test_the_same_image_gives_the_same_bytes(tmp_path):
    for name in ("one.seg.nrrd", "two.seg.nrrd"):
        write_label_map(blocks(), tmp_path / name)
    assert (tmp_path / "one.seg.nrrd").read_bytes() == (tmp_path / "two.seg.nrrd").read_bytes()
