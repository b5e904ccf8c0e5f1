"""`flexneedle plan --entries`: table, record, figure, exit status."""

import json

import numpy as np
import pytest

import flexneedle
from commands import names, run
from flexneedle.planning.entries import map_entries
from flexneedle.record.entries import read_entries
from flexneedle.record.folder import read_run
from flexneedle.scenario.files import dump_scenario

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")
SPHERE = {"name": "vessel", "shape": "sphere", "center_mm": [15.0, 3.0, 0.0], "radius_mm": 1.5}
FREE = {"entry.free_radius_mm": 10.0, "entry.free_slope_mrad": 200.0, "zone": [SPHERE]}
PLANE = flexneedle.load_scenario("phantom").with_values(FREE)


@pytest.fixture
def zoned(in_tmp):
    """Write a scenario with a free entry and a zone."""
    path = in_tmp / "zoned.toml"
    path.write_text(dump_scenario(PLANE), encoding="utf-8")
    return path


def test_a_map_writes_a_record_and_a_figure(zoned, capsys, in_tmp):
    status, out, _ = run(capsys, "plan", str(zoned), "--entries", "--out", "here")
    assert status == 0
    assert names(in_tmp / "here") == ["entries.json", "entries.png", "entries.svg", "run.json"]
    result = json.loads((in_tmp / "here/run.json").read_text())["result"]
    assert out.startswith(
        f"Entries: {result['clear']} are clear of all margins, {result['reached']} of 121 reach"
    )
    assert "1 recommended" in out
    assert "vessel" in out
    assert run(capsys, "view", "here")[:2] == (0, "here/entries.png\nhere/entries.svg\n")


def test_json_is_one_object_with_the_best_entries(zoned, capsys):
    status, out, _ = run(capsys, "plan", str(zoned), "--entries", "--json")
    result = json.loads(out)
    assert status == 0
    assert list(result) == ["target_mm", "entries", "reached", "clear", "best", "timing"]
    assert 1 <= len(result["best"]) <= 5
    assert all(row["clear"] and row["clearance_mm"] >= 2.0 for row in result["best"])


def test_a_map_comes_back_from_its_folder(zoned, capsys, in_tmp):
    run(capsys, "plan", str(zoned), "--entries", "--out", "here")
    scenario = read_run(in_tmp / "here").scenario
    read, made = read_entries(in_tmp / "here", scenario), map_entries(scenario)
    for name in ("points", "slopes", "reached", "clear", "clearance_mm", "zone", "offset_mm", "length_mm"):
        np.testing.assert_allclose(getattr(read, name), getattr(made, name), rtol=1e-12, err_msg=name)
    assert read.best(5) == made.best(5)


def test_without_a_clear_entry_the_nearest_is_shown_and_the_status_is_1(capsys, in_tmp):
    before = {**SPHERE, "center_mm": [20.0, 2.0, 0.0], "radius_mm": 12.0}
    path = in_tmp / "close.toml"
    path.write_text(
        dump_scenario(
            PLANE.with_values({"zone": [before], "target.depth_mm": 40.0, "target.lateral_mm": 2.0})
        )
    )
    status, out, _ = run(capsys, "plan", str(path), "--entries")
    assert status == 1
    assert out.startswith("Entries: 0 are clear")
    assert "none without motion of the guide; nearest" in out


@pytest.mark.parametrize(
    ("options", "about"),
    [
        (("phantom", "--entries"), "entry.free_radius_mm = 0"),
        (("phantom", "--entries", "--strategy", "both"), "--strategy"),
    ],
)
def test_what_has_no_map_is_refused_in_one_line(options, about, capsys, in_tmp):
    status, out, error = run(capsys, "plan", *options)
    assert (status, out) == (2, "")
    assert error.startswith(f"flexneedle: {about}")
    assert error.count("\n") == 1
    assert names(in_tmp) == []


def test_a_map_is_no_plan_to_load(zoned, capsys):
    run(capsys, "plan", str(zoned), "--entries", "--out", "here")
    with pytest.raises(flexneedle.RunError, match="map of entries"):
        flexneedle.load("here")
