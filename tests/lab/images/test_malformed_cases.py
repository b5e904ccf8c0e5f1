"""Malformed and contradictory case files: each is refused in one line, with the file, the key, value and rule."""

import re

import numpy as np
import pytest

from flexneedle.errors import FileError
from flexneedle.lab.images.case_import import import_case
from flexneedle.lab.images.label_map import LabelMap
from flexneedle.lab.images.volumes import write_label_map
from flexneedle.scenario.files import dump_scenario, load_scenario
from lab.images.image_cases import TEXT, label_map, write_case


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cases")
    write_case(folder)
    image = label_map(2.0)
    sheared = image.affine.copy()
    sheared[0, 1] = 0.7
    write_label_map(LabelMap(image.labels, sheared, image.segments), folder / "sheared.seg.nrrd")
    (folder / "broken.seg.nrrd").write_bytes(b"NRRD0004\nnothing")
    (folder / "broken.mrk.json").write_text("{")
    (folder / "bad.toml").write_text(
        dump_scenario(load_scenario("phantom3d")).replace("axes = 2", "axes = 3", 1)
    )
    return folder


FAT = 'segments = ["fat"]\ntissue = "superficial"'
TARGET, ENTRY = 'target = "target"', 'entry = "entry"'
REPLACED = [
    ('scenario = "phantom3d"', "", "scenario: missing"),
    (TARGET, "", "target: missing"),
    ("registration_sd_mm = 0.5", "", "registration_sd_mm: missing"),
    (
        TARGET,
        f'{TARGET}\ntargets = "x"',
        r'targets = "x": unknown key; did you mean target\? valid keys: name',
    ),
    (
        FAT,
        f"{FAT}\nsegment = 1",
        r"case.toml: layer\[0\].segment = 1: unknown key; valid keys: segments, tissue, law",
    ),
    (
        'segment = "vessel"',
        'segment = "vessel"\nmargin = 2',
        r"zone\[0\].margin = 2: unknown key; did you mean",
    ),
    ('scenario = "phantom3d"', 'scenario = "phantom4d"', "phantom4d: no such file, and no such preset"),
    ('scenario = "phantom3d"', 'scenario = "bad.toml"', r"bad.toml: setup.axes = 3: must be at most 2"),
    ("image.seg.nrrd", "none.seg.nrrd", "none.seg.nrrd: cannot be read: No such file or directory"),
    ("image.seg.nrrd", "broken.seg.nrrd", "broken.seg.nrrd: "),
    ("image.seg.nrrd", "image.png", "image.png"),
    ("image.seg.nrrd", "sheared.seg.nrrd", "angle between two axes of the image = .*: must be 90 degrees"),
    ("points.mrk.json", "none.mrk.json", "none.mrk.json: no such file"),
    ("points.mrk.json", "broken.mrk.json", "broken.mrk.json: cannot be read: JSONDecodeError"),
    (
        'markups = ["points.mrk.json", "axis.mrk.json"]',
        "markups = []",
        "markups = .*: must have at least 1 ent",
    ),
    (
        TARGET,
        'target = "tumour"',
        r"target = 'tumour': must name one point of the markups, here 0 \(points: points/",
    ),
    (TARGET, 'target = "later"', "target = 'later': is not placed: place it in 3D Slicer"),
    (TARGET, 'target = "entry"', "entry and target are 0 mm apart: must be at least 1 mm"),
    (
        ENTRY,
        f'{ENTRY}\ndirection = "line"',
        r"direction = 'line': must name one line markup, here 0 \(lines: axis\)",
    ),
    (ENTRY, f'{ENTRY}\ndirection = "points"', "direction = 'points': must name one line markup, here 0"),
    (
        'skin = ["fat"',
        'skin = ["Fat"',
        r"skin: segment = 'Fat': no such segment \(segments: fat, muscle, liver",
    ),
    (
        'skin = ["fat", "muscle", "liver"]',
        'skin = ["vessel"]',
        "skin: on .* % of the lines within 15 mm of the entry",
    ),
    ('skin = ["fat", "muscle", "liver"]', 'skin = ["liver"]', "entry: is 18.* mm outside of the skin"),
    (
        'segments = ["muscle"]',
        'segments = ["bone"]',
        r"layer\[1\].segments: segment = 'bone': no such segment",
    ),
    ('segment = "vessel"', 'segment = "artery"', "zone: segment = 'artery': no such segment"),
    ('segment = "vessel"', 'segment = "liver"', "zone = 'liver': contains the target"),
    (
        'tissue = "deep"',
        'tissue = "liver"',
        r"layer\[2\].tissue = 'liver': must name one .* \(superficial, deep\)",
    ),
    (
        'tissue = "deep"',
        "",
        r"layer\[2\].tissue: missing: name a \[\[tissue\]\] of the scenario \(superficial, deep\)",
    ),
    (
        "shear_modulus_kpa = 4.0",
        "shear_modulus_kpa = -4.0",
        r"layer\[1\].shear_modulus_kpa = -4.0: must be above 0",
    ),
    (
        "shear_modulus_kpa = 4.0",
        "thickness_mm = 4.0",
        r"layer\[1\].thickness_mm = 4.0: leave it out: the image",
    ),
    ("shear_modulus_kpa = 4.0", "alpah = 4.0", r"layer\[1\].alpah = 4.0: unknown key; did you mean alpha"),
    (
        "registration_sd_mm = 0.5",
        "registration_sd_mm = -0.5",
        "registration_sd_mm = -0.5: must be at least 0",
    ),
    (
        "registration_sd_mm = 0.5",
        'registration_sd_mm = "0.5"',
        'registration_sd_mm = "0.5": must be a number',
    ),
    ("free_radius_mm = 10.0", "free_slope_mrad = 300.0", "free_slope_mrad = 300.0: must be at most 200"),
    ("free_radius_mm = 10.0", "skin_radius_mm = 1.0", "skin_radius_mm = 1.0: must be at least 5"),
    (
        "margin_mm = 3.0",
        "margin_mm = 0.1",
        r"zone\[0\].margin_mm = 0.1: must be at least guard.zone_buffer_mm",
    ),
]


def refusal(path):
    with pytest.raises(FileError) as error:
        import_case(path)
    (line,) = str(error.value).splitlines()
    assert line.startswith(str(path))
    assert "\n" not in line
    return line


@pytest.mark.parametrize(("old", "new", "message"), REPLACED, ids=range(len(REPLACED)))
def test_one_line_of_a_case_is_wrong(folder, old, new, message):
    assert old in TEXT
    line = refusal(write_case(folder, TEXT.replace(old, new, 1)))
    assert re.search(message, line), line


PLACES = [
    ({"target": (-20.0, 0.0, 0.0)}, "", "skin: .* % of the lines .* begin inside of the body"),
    ({"entry": (-9.0, 0.0, 0.0)}, "", "entry: is 9.0 mm outside of the skin"),
    ({"entry": (8.0, 0.0, 0.0)}, "", "entry: is 8.* mm below the skin"),
    ({"entry": (0.0, 81.0, 0.0), "target": (45.0, 81.0, 0.0)}, "", "skin: on .* % of the lines"),
    (
        {"target": (45.0, 90.0, 0.0)},
        "",
        "target = 'target': must be in the label map, but is 5.6 mm beyond it",
    ),
    (
        {"target": (30.0, 30.0, 0.0)},
        "",
        "the skin is tilted by 45.* degrees to the insertion: must be at most",
    ),
    ({"target": (95.0, 0.0, 0.0)}, "", "target.depth_mm = 9.*: beyond the stroke: must be at most 81.5"),
    (
        {"target": (30.0, 9.0, 6.0), "axis": ((0, 0, 0), (1, 0, 0))},
        'direction = "axis"\n',
        "zone = 'vessel': contains the target",
    ),
    (
        {"axis": ((1, 0, 0), (0, 0, 0))},
        'direction = "axis"\n',
        "direction = 'axis': must lead from the entry towards the target",
    ),
    (
        {"axis": ((0, 0, 0), (0.01, 0, 0))},
        'direction = "axis"\n',
        "direction = 'axis': must be at least 1 mm long",
    ),
    (
        {"target": (40.0, 50.0, 0.0), "axis": ((0, 0, 0), (1, 0, 0))},
        'direction = "axis"\n',
        "target.lateral(_z)?_mm = .*: must be from -?[0-9.]+ to",
    ),
]


@pytest.mark.parametrize(("places", "start", "message"), PLACES, ids=range(len(PLACES)))
def test_points_contradict_the_image(folder, places, start, message):
    line = refusal(write_case(folder, start + TEXT, **places))
    assert re.search(message, line), line


def test_files_that_are_no_cases(tmp_path):
    (tmp_path / "case.toml").write_text("scenario = ")
    assert "not TOML" in refusal(tmp_path / "case.toml")
    assert "no such file" in refusal(tmp_path / "none.toml")
    assert "is a directory" in refusal(tmp_path)


def test_a_label_map_of_a_layer_without_voxels_on_the_axis(tmp_path):
    image = label_map(2.0)
    labels = image.labels.copy()
    labels[0] = np.where(labels[0] > 0, 1, 0)
    write_label_map(LabelMap(labels, image.affine, image.segments), tmp_path / "image.seg.nrrd")
    text = TEXT.replace('[[layer]]\nsegments = ["fat"]\ntissue = "superficial"\n\n', "")
    assert text != TEXT
    line = refusal(write_case(tmp_path, text))
    assert "layer: none of the segments muscle, liver is on the insertion axis" in line
