"""Suspected errors of units and signs."""

import numpy as np
import pytest

from recorded_insertions import PLAIN, columns, guided, load, write_csv

MIRRORED = {"position": ["x", "-y", "z"], "axis": ["ax", "-ay", "az"]}
TIP, GUIDE = PLAIN["tip"], PLAIN["guide"]


@pytest.fixture
def files(tmp_path):
    return [
        write_csv(tmp_path / f"{k}.csv", columns(guided(seed=k)) | {"roll": np.arange(18)}) for k in range(5)
    ]


def test_a_good_map_raises_no_suspicion(files):
    assert load(*files, time={"columns": ["t"]}).suspected == ()


@pytest.mark.parametrize(
    ("sections", "line"),
    [
        ({"tip": TIP | {"unit": "um"}}, "the insertions are 0.085 mm deep (median): check tip.unit = 'um' (mm?)"),
        ({"tip": TIP | {"unit": "m"}, "steps": {"gap_mm": 1e5}}, "check tip.unit = 'm' (mm?)"),
        (
            {"guide": GUIDE | {"unit": "um"}},
            "the guide moves by 0.0042 mm at most, so that stiffness and guide distance will not be identified: "
            "check guide.unit",
        ),
        ({"frame": {"skin_mm": 100.0}}, "5 of 5 insertions have no step in tissue: check tip.unit, frame.x and"),
        ({"guide": GUIDE | {"unit": "m"}}, "check guide.unit"),
        ({"guide": GUIDE | {"y": "-gy"}}, "turns towards the guide's motion along y"),
        ({"guide": GUIDE | {"z": "-gz"}}, "turns towards the guide's motion along z"),
        ({"guide": {"y": "gz", "z": "gy"}}, "exchange guide.y and guide.z"),
        ({"tip": MIRRORED}, "turns towards the guide's motion along y"),
        ({"tip": TIP | {"axis": ["ax", "-ay", "az"]}}, "turn to opposite sides along y"),
        ({"time": {"columns": ["t"], "unit": "ms"}}, "the tip advances at 500 mm/s (median): check time.unit"),
        ({"roll": {"column": "roll"}, "time": {"columns": ["t"], "unit": "us"}}, "check time.unit"),
    ],
)  # fmt: skip
def test_a_wrong_unit_or_sign_is_suspected(files, sections, line):
    assert line in "\n".join(load(*files, **sections).suspected)


def test_names_with_another_unit_than_the_map(tmp_path):
    table = {f"{name} [m]": values for name, values in columns(guided()).items()}
    file = write_csv(tmp_path / "a.csv", table)
    found = load(file, tip={"position": ["x [m]", "y [m]", "z [m]"]}, guide=None).suspected
    assert "column 'x [m]' seems to be in m, but tip.unit = 'mm'" in found


def test_a_rotation_in_degrees_and_angles_in_degrees(tmp_path):
    table = columns(guided()) | {"roll": 10.0 * np.arange(18), "a": np.degrees(guided().slope[:, 0])}
    found = load(
        write_csv(tmp_path / "a.csv", table),
        roll={"column": "roll"},
        tip={"position": ["x", "y"], "angle": ["a"]},
        guide={"y": "gy"},
    ).suspected
    assert any("check roll.unit" in line for line in found)
    assert any("check tip.angle_unit" in line for line in found)
