"""An entry that the planner chooses: shown by the commands, kept in the record, found again when it is read."""

import json
import re

import pytest

import flexneedle
from commands import run

pytestmark = pytest.mark.usefixtures("in_tmp", "empty_figures")
FREE = """
name = "Free entry"
needle = { gauge = "22G" }
setup = { axes = 2, tip_to_skin_mm = 5.0, stroke_mm = 60.0 }
entry = { free_radius_mm = 3.0, free_slope_mrad = 20.0 }
target = { depth_mm = 8.0, lateral_mm = -2.0, lateral_z_mm = -1.0 }
plan = { samples = 16, iterations = 1, max_iterations = 2 }

[[tissue]]
shear_modulus_kpa = 2.1
alpha = 8.74
compression_length_mm = 20.0
engaged_width_mm = 5.0
"""
LATERAL = r"^ chosen entry, lateral +(-?\d\.\d\d), (-?\d\.\d\d) mm "


def test_a_recorded_insertion_has_the_chosen_entry_and_can_be_repeated(in_tmp, capsys):
    (in_tmp / "free.toml").write_text(FREE)
    made = flexneedle.plan(flexneedle.load_scenario("free.toml"))
    options = ("--controller", "open-loop", "--force", "--out", "here")
    _, out, _ = run(capsys, "insert", "free.toml", *options)
    done = flexneedle.load("here")
    entry = done.scenario.entry
    assert not entry.free
    assert done.plan.scenario.entry == made.scenario.entry == entry
    shown = [float(value) for value in re.search(LATERAL, out, re.MULTILINE).groups()]
    assert shown == pytest.approx([entry.lateral_mm, entry.lateral_z_mm], abs=0.005)
    saved = flexneedle.save(made, "saved")
    assert flexneedle.load(saved).scenario.entry == entry
    result = json.loads((saved / "run.json").read_text())["result"]["manipulation"]
    assert result["entry"]["slope_z_mrad"] == entry.slope_z_mrad
    again = flexneedle.insert(done.scenario, done.plan, done.seed, controller="open-loop", force=True)
    assert [period.true_tip for period in again.periods] == [period.true_tip for period in done.periods]


def test_a_fixed_entry_is_not_shown(engine, capsys):
    engine()
    _, out, _ = run(capsys, "plan", "phantom", "--out", "here")
    assert "chosen entry" not in out
