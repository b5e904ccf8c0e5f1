"""The record of an insertion names a wrong scale, direction or channel of the rig file, and no other cause."""

import re
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.lab.rig.diagnosis import explain_record, find_fault
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.results import Outcome
from rig_diagnosis import insert, is_wrong, scaled, shifted, swapped

RIG = load_rig("emulated")


@pytest.fixture(scope="module")
def plans():
    """Plans of the presets in the plane and in space."""
    return {name: flexneedle.plan(name, seed=0) for name in ("phantom", "phantom3d")}


def insertion_of(plans, preset, changes=None, error=None, seed=1):
    return insert(flexneedle.load_scenario(preset), plans[preset], seed, changes, error)


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
@pytest.mark.parametrize("factor", [0.5, 0.9, 1.1, 2.0, -1.0, 25.4, 0.0])
def test_a_wrong_scale_or_direction_of_the_insertion_is_named(plans, preset, factor):
    text = explain_record(RIG, insertion_of(plans, preset, scaled("insertion", factor)))
    if factor == 0.0:
        assert text.startswith(
            "insertion does not move the tip, or its sensor is loose (axes.insertion.channel)"
        )
    elif factor < 0.0:
        assert text.startswith("insertion moves in the other direction (axes.insertion.direction)")
    else:
        moved, at, counts = re.match(
            r"insertion moves (.*) times as far .*= (.*), about (.*) would fit", text
        ).groups()
        assert at == "2000"
        assert float(moved) == pytest.approx(factor, rel=0.01)
        assert float(counts) == pytest.approx(2000.0 / factor, rel=0.02)
    assert text.endswith("flexneedle rig test emulated")


@pytest.mark.parametrize(
    ("preset", "one", "other"),
    [
        ("phantom", "insertion", "guide_y"),
        ("phantom3d", "insertion", "guide_z"),
        ("phantom3d", "guide_y", "guide_z"),
    ],
)
def test_swapped_channels_are_named(plans, preset, one, other):
    insertion = insertion_of(plans, preset, swapped(RIG, one, other))
    fault = find_fault(RIG, insertion.scenario, insertion)
    if insertion.outcome is Outcome.HELD:
        assert set(fault.axes) == {one, other}
    assert not is_wrong(f"{one} ↔ {other}", fault)


def test_a_reversed_guide_is_named_where_it_holds_the_needle(plans):
    insertion = insertion_of(plans, "phantom", scaled("guide_y", -1.0), seed=11)
    fault = find_fault(RIG, insertion.scenario, insertion)
    assert insertion.outcome is Outcome.HELD
    assert fault.axes == ("guide_y",)
    assert "in the other direction" in fault.text


@pytest.mark.parametrize(("begun", "seconds"), [(0.3, 2.0), (0.3, 1e-3), (9.0, 2.0)])
@pytest.mark.parametrize("way", [(6.0, 0.0, 0.0), (0.0, 6.0, 0.0)])
def test_a_tracker_that_jumps_or_drifts_is_no_fault_of_the_rig(plans, begun, seconds, way):
    insertion = insertion_of(plans, "phantom", error=shifted(begun, np.array(way), seconds))
    assert explain_record(RIG, insertion) == ""


@pytest.mark.parametrize(
    ("world", "seed", "changes"),
    [
        ("world:61159", 9, {"phantom.shear_modulus_factor": [0.08, 0.15]}),
        ("world:13043", 10, {"phantom.shear_modulus_factor": [5.0, 8.0]}),
        ("world:70513", 7, {"phantom.tracker_bias_mm": 1.5, "phantom.missing_fraction": 0.3}),
        ("world:81720", 22, {"phantom.start_offset_sd_mm": 1.5, "phantom.start_angle_sd_mrad": 9.0}),
    ],
)
def test_another_tissue_start_or_tracker_is_no_fault_of_the_rig(world, seed, changes):
    """Insertions of which a scale of the guide explains a part."""
    scenario = flexneedle.load_scenario(world)
    plan = flexneedle.plan(scenario, seed=0)
    insertion = insert(scenario.with_values(changes), plan, seed)
    assert find_fault(RIG, insertion.scenario, insertion) is None


def test_an_insertion_with_a_bevel_at_its_limit_is_diagnosed():
    steep = flexneedle.load_scenario("phantom").with_values({"needle.bevel.offset_mm": 13.0})
    insertion = insert(steep, flexneedle.plan(steep, seed=0), 1, scaled("insertion", 2.0))
    assert explain_record(RIG, insertion).startswith("insertion moves 2 times as far")


def test_a_right_rig_has_no_fault_and_a_failed_insertion_keeps_its_reason(plans):
    for preset in ("phantom", "phantom3d"):
        assert explain_record(RIG, insertion_of(plans, preset)) == ""
    wrong = insertion_of(plans, "phantom", scaled("insertion", 2.0))
    assert explain_record(RIG, wrong)
    assert explain_record(RIG, replace(wrong, outcome=Outcome.FAILED)) == ""
    assert explain_record(RIG, replace(wrong, periods=wrong.periods[:1])) == ""
