"""`flexneedle plan`: results, records, exit status."""

import json
from unittest.mock import patch

import numpy as np
import pytest

import flexneedle
from commands import names, run
from flexneedle.cli.common import clearance_rows, out_of_reach_rows
from flexneedle.invasiveness import format_number
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.simulator.zones import FileZone, zones_of
from zoned import SPHERE, grid_files, with_zones

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")
FREE = {"entry.free_radius_mm": 5.0, "entry.free_slope_mrad": 100.0}
STRATEGIES = ("manipulation", "steering")
PLAN_KEYS = [
    *(
        "tip_mm",
        "error_mm",
        "reached",
        "limit",
        "refusal",
        "entry",
        "cost",
        "terms",
        "flips",
        "strain_energy_mj",
    ),
    *(
        "peak_energy_uj",
        "mean_energy_uj",
        "end_energy_uj",
        "least_stretch",
        "guide_travel_mm",
        "energy_scale_uj",
    ),
    *("clearance_mm", "iterations", "converged", "seed", "timing"),
]


def test_plan_writes_a_record_and_a_figure(engine, capsys, in_tmp):
    engine()
    status, out, _ = run(capsys, "plan", "--out", "here")
    assert status == 0
    assert names(in_tmp / "here") == ["plan.png", "plan.svg", "run.json"]
    assert out.startswith("Plan (manipulation) reaches the target to 0.010 mm\n")
    result = json.loads((in_tmp / "here/run.json").read_text())["result"]["manipulation"]
    peak, mean, end = (format_number(result[f"{of}_energy_uj"]) for of in ("peak", "mean", "end"))
    assert f"{peak}, {mean}, {end} µJ" in out
    assert run(capsys, "view", "here")[:2] == (0, "here/plan.png\nhere/plan.svg\n")


def test_plan_json_is_one_object_or_one_by_strategy(engine, capsys):
    engine()
    status, out, _ = run(capsys, "plan", "--json")
    assert (status, list(json.loads(out))) == (0, PLAN_KEYS)
    both = json.loads(run(capsys, "plan", "--strategy", "both", "--json")[1])
    assert {name: list(result) for name, result in both.items()} == dict.fromkeys(STRATEGIES, PLAN_KEYS)


def test_a_plan_that_misses_names_the_limit_and_fails(engine, capsys):
    engine(plan_miss=2.5)
    status, out, _ = run(capsys, "plan")
    assert status == 1
    assert "MISSES the target: best distance 2.510 mm" in out
    assert "limited by setup.max_guide_travel_mm" in out


def test_the_row_of_the_clearance_names_the_nearest_zone_with_its_margin():
    scenario = with_zones("phantom", {**SPHERE, "name": "far", "center_mm": [25.0, 30.0, 0.0]}, SPHERE)
    straight = np.pad(np.arange(-60.0, 41.0)[:, None], ((0, 0), (0, 4)))
    shapes = [straight - [30.0, 0.0, 0.0, 0.0, 0.0], straight]
    found = clearance_rows(scenario, "least", 5.5, shapes)
    assert found == {"least": "5.500 mm to node (margin 2 mm)"}
    before = [straight - [40.0, 0.0, 0.0, 0.0, 0.0]]
    assert clearance_rows(scenario, "least", np.inf, before) == {"least": "not in the tissue"}
    assert clearance_rows(scenario.with_values({"zone": []}), "least", np.inf, shapes) == {}


@pytest.mark.parametrize("command", [("plan",), ("plan", "--entries"), ("insert",)])
def test_a_zone_file_that_cannot_be_read_leaves_no_folder(command, engine, capsys, in_tmp):
    engine()
    free = with_zones(
        "phantom", {"name": "a", "shape": "file", "file": str(in_tmp / "a.seg.nrrd"), "label": 1}
    )
    (in_tmp / "a.toml").write_text(dump_scenario(free.with_values(FREE)))
    status, _, err = run(capsys, command[0], "a.toml", *command[1:], "--out", "here")
    assert (status, err.splitlines()[-1].startswith("flexneedle: zone a: ")) == (2, True)
    assert names(in_tmp) == ["a.toml"]


@pytest.mark.parametrize("options", [(), ("--entries",)])
def test_a_target_in_a_margin_is_refused_before_the_search(options, capsys, in_tmp):
    depth, lateral, _ = load_scenario("phantom").target.position
    near = {**SPHERE, "center_mm": [depth, lateral + 4.5, 0.0]}
    scenario = with_zones("phantom", near).with_values(FREE)
    (in_tmp / "a.toml").write_text(dump_scenario(scenario))
    status, _, err = run(capsys, "plan", "a.toml", *options)
    assert status == 1
    assert "flexneedle: target: 1.50 mm from zone node, within its margin" in err
    assert names(in_tmp) == ["a.toml"]


def test_a_zone_out_of_reach_is_named_without_a_clearance(in_tmp):
    with (
        grid_files(in_tmp) as ring,
        patch("flexneedle.simulator.zones.load_part", lambda *_: lambda *_: FileZone(None, None)),
    ):
        scenario = with_zones("phantom", ring)
        straight = np.pad(np.arange(-60.0, 41.0)[:, None], ((0, 0), (0, 4)))
        assert clearance_rows(scenario, "least", np.inf, [straight]) == {}
        assert out_of_reach_rows(scenario) == {"zone ring": "out of the needle's reach"}
        zones = zones_of(scenario)
        assert zones.clearances(straight[:, :3]).min() == np.inf
        plan = flexneedle.plan(scenario)
        assert plan.least_clearance_mm == np.inf
        assert plan.refusal == ""


@pytest.mark.parametrize(
    "command", [("plan",), ("plan", "--entries"), ("insert",)], ids=["plan", "entries", "insert"]
)
def test_a_file_of_a_zone_without_an_image_is_one_line_as_of_scenario_check(capsys, in_tmp, engine, command):
    engine()
    name, *options = command
    with grid_files(in_tmp) as ring:
        scenario = with_zones("phantom", ring).with_values(FREE)
        (in_tmp / "a.toml").write_text(dump_scenario(scenario))
        (in_tmp / "b.toml").write_text(dump_scenario(scenario.with_values({"image.sd_mm": 0.3})))
        _, _, checked = run(capsys, "scenario", "check", "a.toml")
        (_, _, err), (_, _, placed) = (run(capsys, name, each, *options) for each in ("a.toml", "b.toml"))
    assert "zone ring: file in the image's frame" in checked
    assert err.count(checked) == 1
    assert "zone ring" not in placed
