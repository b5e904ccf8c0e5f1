"""One-line summaries, results, and the entry angle."""

from dataclasses import replace
from math import atan, nan

import numpy as np
import pytest

import flexneedle
from flexneedle.record.results import insertion_result, insertion_row, insertion_timing, plan_result
from flexneedle.results import Insertion, Outcome
from flexneedle.types import UNKNOWN, Shape
from synthetic import blind, make_insertion, make_plan
from synthetic_space import in_space

PLAN = make_plan()


def straight(slope, start=-3.5):
    """A plan with a straight tip path and a slope that grows with depth."""
    depth = start + np.arange(8.0)
    still = np.zeros_like(depth)
    return replace(PLAN, tips=np.column_stack([depth, slope * depth, still, slope + 0.01 * depth, still]))


@pytest.mark.parametrize(("slope", "start"), [(atan(0.2), -3.5), (-0.1, -7.0), (-0.1, 0.0)])
def test_the_entry_angle_is_the_slope_at_the_skin(slope, start):
    assert straight(slope, start).entry_angle == pytest.approx(slope, abs=1e-12)
    assert np.isnan(straight(slope, start=-20.0).entry_angle)  # the tip remains outside


UNKNOWN_TIP = Insertion(PLAN, 0, tuple(map(blind, make_insertion().periods)), Outcome("done"), "")


@pytest.mark.parametrize(
    ("record", "summary"),
    [
        (PLAN, "reaches the target to 0.010 mm"),
        (
            replace(PLAN, target=(40.0, 8.0, 0.0), limit="setup.stroke_mm = 60"),
            "MISSES the target: best distance 2.990 mm, more than 1 mm, limited by setup.stroke_mm = 60",
        ),
        (make_insertion(), "reached: the tip ended 0.070 mm from the target"),
        (make_insertion(miss=1.0), "MISSED: the tip ended 1.010 mm from the target, more than 1 mm"),
        (
            make_insertion(outcome="held", reason="no sample", periods=3),
            "held 25.5 mm before the skin after 3 periods: no sample",
        ),
        (UNKNOWN_TIP, "done: neither the true tip nor a reading of it is known"),
    ],
)
def test_the_summary_is_one_line(record, summary):
    assert record.summary == summary


@pytest.mark.parametrize(
    ("diameter", "miss", "words"),
    [
        (0.819, 0.4, "reaches the target to 0.400 mm"),
        (0.819, 0.42, "ends 0.420 mm from the target"),
        (0.819, 0.9, "ends 0.900 mm from the target"),
        (0.3, 0.2, "ends 0.200 mm from the target"),
        (3.0, 0.99, "reaches the target to 0.990 mm"),
        (3.0, 1.2, "MISSES the target: best distance 1.200 mm, more than 1 mm"),
    ],
)
def test_a_target_is_reached_only_within_the_needle(diameter, miss, words):
    needle = {"needle.outer_diameter_mm": diameter, "needle.inner_diameter_mm": 0.5 * diameter}
    scenario = flexneedle.load_scenario("phantom").with_values(needle)
    x, y, z = PLAN.tip_mm
    gentle = 0.0 * PLAN.strain_energy
    plan = replace(PLAN, target=(x, y, z + miss), scenario=scenario, strain_energy=gentle)
    assert plan.summary == words
    if plan.hit:
        scale = scenario.energy_scale(plan.target[0])
        assert replace(plan, strain_energy=gentle + 0.9 * scale).summary == words
        loaded = replace(plan, strain_energy=gentle + 2.5 * scale)
        assert loaded.summary == f"{words}, but the tissue energy peaks at 2.5 E₁"
    assert (plan.hit, plan.reached) == (words.startswith("reaches"), miss < 1.0)
    insertion = replace(make_insertion(miss=miss - 0.01), scenario=scenario)
    assert insertion.hit == plan.hit
    assert insertion.summary.startswith("reached" if plan.hit else "done" if miss < 1.0 else "MISSED")


def test_a_plan_that_a_limit_binds_does_not_reach_its_target():
    summary = replace(PLAN, limit="setup.stroke_mm = 60").summary
    assert summary == "ends 0.010 mm from the target, limited by setup.stroke_mm = 60"


def test_missing_values_are_null():
    result = insertion_result(UNKNOWN_TIP)
    unknown = {name for name, value in result.items() if value is None}
    errors = {"true_error_mm", "residual_mm"}
    parts = {"phantom", "rig", "disturbed", "tip_true_mm", "tip_measured_mm", "strain_energy_mj", "warning"}
    parts |= {"true_clearance_mm"}
    load = {"least_stretch", "energy_scale_uj"}
    assert unknown == parts | errors | load
    assert result["reached"] is False
    empty = Insertion(PLAN, 0, (), Outcome("failed"), "")
    assert insertion_result(empty)["steps"] == 0
    assert insertion_timing(empty)["period_ms"] == {"p50": None, "p99": None, "max": None}


def test_the_clearance_of_an_insertion_is_the_least_of_its_periods_and_null_without_zones():
    result = insertion_result(make_insertion())
    found = [result[f"{name}clearance_mm"] for name in ("", "true_", "planned_")]
    assert found == pytest.approx([2.9, 2.8, 3.0])
    assert insertion_result(UNKNOWN_TIP)["clearance_mm"] == pytest.approx(2.9)
    free = replace(PLAN, clearance=np.full(1, np.inf))
    assert plan_result(free)["clearance_mm"] is None


def test_one_unconverged_period_is_not_hidden():
    insertion = make_insertion()
    assert insertion_result(insertion)["converged"] is True
    periods = (replace(insertion.periods[0], converged=False, cost=nan), *insertion.periods[1:])
    assert insertion_result(replace(insertion, periods=periods))["converged"] is False


# ---- deviations from the predictions, in standard deviations

SPACE = flexneedle.load_scenario("phantom3d")
MISS, MISS_SD, SHAPE_SD = (0.3, -0.2), 0.1, (0.2, 0.05)


def predicting(insertion, miss=MISS, off=(0.4, 0.1)):
    """The insertion with these predictions of tip and shape, off the final true needle, from half of the depth on."""
    true = insertion.periods[-1].true_shape
    nodes = np.column_stack([true, np.zeros((len(true), 2))]) - [0.0, *off, 0.0, 0.0]
    shape = Shape(nodes, np.tile(SHAPE_SD, (len(true), 1)))
    deep = 0.5 * insertion.target[0]
    periods = tuple(
        replace(period, miss=miss, miss_sd=MISS_SD if miss == MISS else np.nan, predicted=shape)
        if period.estimate.x >= deep
        else replace(period, miss=UNKNOWN, predicted=None)
        for period in insertion.periods
    )
    return replace(insertion, periods=periods)


def sds(insertion, fraction="half"):
    row = insertion_row(insertion)
    names = [f"predicted_{fraction}_{part}_{axis}_sds" for part in ("tip", "middle") for axis in "yz"]
    return [row[name] for name in names]


@pytest.fixture(scope="module")
def in_any_direction():
    """An insertion in space, with its true needle."""
    turned = in_space(make_insertion(miss=1.0), 0.7)
    shape = turned.periods[-1].shape[:, :3]
    last = replace(turned.periods[-1], true_shape=shape)
    return replace(turned, periods=(*turned.periods[:-1], last), scenario=SPACE)


def test_the_tip_is_compared_with_the_predicted_miss_and_the_middle_with_the_shape(in_any_direction):
    insertion = predicting(in_any_direction)
    true, target = insertion.periods[-1].true_tip, insertion.target
    tip = [(true[k] - target[k] - MISS[k - 1]) / MISS_SD for k in (1, 2)]
    assert sds(insertion) == pytest.approx([*tip, 0.4 / SHAPE_SD[0], 0.1 / SHAPE_SD[1]], rel=1e-9)
    assert sds(insertion, "quarter") == sds(insertion)  # the first prediction after it
    assert sds(insertion, "three_quarters") == sds(insertion)
    row = insertion_row(insertion)
    assert (row["predicted_half_y_mm"], row["predicted_half_z_mm"]) == MISS
    assert row["predicted_half_sd_mm"] == MISS_SD
    assert (row["tip_y_mm"], row["tip_z_mm"]) == (true.y, true.z)


def test_the_middle_is_taken_from_the_inserted_part(in_any_direction):
    """A shape that is predicted too low in the second half of the depth does not change it."""
    insertion = predicting(in_any_direction)
    nodes, sd = insertion.periods[-1].predicted
    lower = np.where(nodes[:, :1] > 0.6 * insertion.target[0], nodes - [0.0, 5.0, 5.0, 0.0, 0.0], nodes)
    beyond = Shape(lower, sd)
    changed = replace(insertion, periods=tuple(replace(p, predicted=beyond) for p in insertion.periods))
    assert sds(changed)[2:] == pytest.approx(sds(insertion)[2:], rel=1e-12)


def test_without_a_predicted_miss_the_shape_predicts_the_tip(in_any_direction):
    insertion = predicting(in_any_direction, miss=UNKNOWN)
    last = insertion.periods[-1]
    off = [last.true_tip[k] - last.predicted.nodes[-1, k] for k in (1, 2)]
    assert sds(insertion)[:2] == pytest.approx([off[0] / SHAPE_SD[0], off[1] / SHAPE_SD[1]], rel=1e-9)


def test_out_of_the_plane_nothing_is_compared():
    insertion = replace(make_insertion(), scenario=flexneedle.load_scenario("phantom"))
    assert [value is None for value in sds(predicting(insertion))] == [False, True, False, True]


def test_an_insertion_that_was_held_or_predicts_nothing_is_not_compared(in_any_direction):
    held = replace(predicting(in_any_direction), outcome=Outcome.HELD)
    silent = tuple(replace(p, miss=UNKNOWN, predicted=None) for p in in_any_direction.periods)
    for insertion in (held, replace(in_any_direction, periods=silent), replace(held, periods=())):
        assert sds(insertion) == [None] * 4


def test_tips_in_space_have_three_coordinates(in_any_direction):
    result = insertion_result(in_any_direction)
    true, target = in_any_direction.periods[-1].true_tip, in_any_direction.target
    assert result["tip_true_mm"] == [true.x, true.y, true.z]
    assert result["target_mm"] == list(target)
    assert len(result["tip_measured_mm"]) == 3
