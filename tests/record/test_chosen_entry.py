"""An entry that the planner chooses: shown by the commands, kept in the record, found again when it is read."""

import json
import re

import pytest

import flexneedle
from commands import run

FREE = """
name = "Free entry"
needle = { gauge = "22G" }
setup = { axes = 2, tip_to_skin_mm = 5.0, stroke_mm = 60.0 }
entry = { free_radius_mm = 3.0, free_slope_mrad = 20.0 }
target = { depth_mm = 15.0, lateral_mm = -3.0, lateral_z_mm = -2.0 }
plan = { samples = 32, max_iterations = 10 }

[[tissue]]
shear_modulus_kpa = 2.1
alpha = 8.74
compression_length_mm = 20.0
engaged_width_mm = 5.0
"""
LATERAL = r"^ chosen entry, lateral +(-\d\.\d\d), (-\d\.\d\d) mm "


@pytest.fixture
def free(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free.toml").write_text(FREE)
    return flexneedle.load_scenario("free.toml")


def shown(out):
    """The lateral offsets (mm) of the entry in a table."""
    return [float(value) for value in re.search(LATERAL, out, re.MULTILINE).groups()]


def test_a_recorded_plan_has_its_entry(free, capsys):
    made = flexneedle.plan(free)
    status, out, _ = run(capsys, "plan", "free.toml", "--out", "here")
    assert status == 0
    entry = flexneedle.load("here").scenario.entry
    assert not entry.free
    assert entry == made.scenario.entry
    assert shown(out) == pytest.approx([entry.lateral_mm, entry.lateral_z_mm], abs=0.005)
    saved = flexneedle.save(made, "saved")
    assert flexneedle.load(saved).scenario.entry == entry
    result = json.loads((saved / "run.json").read_text())["result"]["manipulation"]
    assert result["entry"]["slope_z_mrad"] == entry.slope_z_mrad


@pytest.mark.usefixtures("free")
def test_a_recorded_insertion_can_be_repeated(capsys):
    _, out, _ = run(capsys, "insert", "free.toml", "--out", "here")
    done = flexneedle.load("here")
    entry = done.scenario.entry
    assert not entry.free
    assert done.plan.scenario.entry == entry
    assert shown(out) == pytest.approx([entry.lateral_mm, entry.lateral_z_mm], abs=0.005)
    again = flexneedle.insert(done.scenario, done.plan, seed=done.seed)
    assert [period.true_tip for period in again.periods] == [period.true_tip for period in done.periods]


@pytest.mark.usefixtures("free")
def test_a_fixed_entry_is_not_shown(capsys):
    _, out, _ = run(capsys, "plan", "phantom", "--target", "15", "0", "--out", "here")
    assert "chosen entry" not in out
