"""A plan is carried out in the scenario that it was made for, with any controller and mismatch."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.plants import DEFAULT_PLANT
from flexneedle.planning.origin import check_origin
from flexneedle.scenario.worlds import CASES, world
from synthetic import make_plan

PHANTOM = flexneedle.load_scenario("phantom")
PLAN = replace(make_plan(), scenario=PHANTOM)
OF_THE_PLAN = {
    "needle.youngs_modulus_gpa": 60.0,
    "needle.bevel.offset_mm": 3.0,
    "setup.tip_to_skin_mm": 20.0,
    "tissue.1.alpha": 9.0,
    "contact.spacing_mm": 0.5,
    "plan.end_energy_weight_mm": 0.0,
}
NOT_OF_THE_PLAN = {
    "name": "Other",
    "control.load_gain": 0.2,
    "control.ce_mpc.samples": 9,
    "tracker.jitter_mm": 0.1,
    "monitor.references": 0,
    "phantom.friction_mn_per_mm": 9.0,
}


@pytest.mark.parametrize("key", OF_THE_PLAN)
def test_a_plan_of_another_scenario_is_refused_with_the_key_and_both_values(key):
    value = OF_THE_PLAN[key]
    with pytest.raises(InputError) as caught:
        check_origin(PLAN, PHANTOM.with_values({key: value}))
    line = str(caught.value)
    assert line.startswith(f"{key.replace('tissue.1', 'tissue[1]')} = {value}: ")
    assert str(PHANTOM.flat()[key]) in line


def test_the_first_key_that_differs_is_named_and_a_missing_one_is_none():
    other = PHANTOM.with_values({"setup.guide_to_skin_mm": None, "tissue.1.alpha": 9.0})
    with pytest.raises(InputError, match=r"^setup\.guide_to_skin_mm = none: .*41\.0"):
        check_origin(PLAN, other)


@pytest.mark.parametrize("key", NOT_OF_THE_PLAN)
def test_controller_tracker_monitor_and_mismatch_are_free(key):
    """`check_origin` returns None or raises."""
    assert check_origin(PLAN, PHANTOM.with_values({key: NOT_OF_THE_PLAN[key]})) is None


def test_a_plan_serves_all_cases_of_a_world():
    made = replace(make_plan(), scenario=world(3))
    for case in CASES:
        assert check_origin(made, world(3, case)) is None


def test_a_target_that_the_planner_was_given_need_not_be_the_scenarios():
    given = replace(PLAN, target=(30.0, -2.0, 0.0))
    check_origin(given, PHANTOM)
    check_origin(given, PHANTOM.with_values({"target.depth_mm": 30.0, "target.lateral_mm": -2.0}))
    with pytest.raises(InputError, match=r"^target\.depth_mm = 20\.0: .*40\.0"):
        check_origin(given, PHANTOM.with_values({"target.depth_mm": 20.0}))


def test_a_plan_without_a_scenario_is_accepted():
    assert check_origin(make_plan(), PHANTOM.with_values(OF_THE_PLAN)) is None


def test_the_planner_notes_the_scenario():
    coarse = PHANTOM.with_values({"plan.samples": 16, "plan.iterations": 1, "plan.max_iterations": 1})
    assert flexneedle.plan(coarse).scenario == coarse


def test_insert_refuses_before_anything_moves():
    other = PHANTOM.with_values({"tissue.0.shear_modulus_kpa": 3.0})
    seeds = Seeds(*np.random.SeedSequence(0).spawn(3))
    rig = virtual_rig(other, PLAN.roll, seeds, DEFAULT_PLANT)
    with pytest.raises(InputError, match=r"^tissue\[0\]\.shear_modulus_kpa = 3\.0: "):
        flexneedle.insert(other, PLAN, rig=rig)
    assert rig.clock.now() == 0.0
