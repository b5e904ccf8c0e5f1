"""One-line summaries, results, and the entry angle."""

from dataclasses import replace
from math import atan, nan

import numpy as np
import pytest

from flexneedle.trace.results import insertion_result, insertion_timing
from flexneedle.types import Insertion, Outcome
from synthetic import blind, make_insertion, make_plan

PLAN = make_plan()


def straight(slope, start=-3.5):
    """A plan with a straight tip path and a slope that grows with depth."""
    depth = start + np.arange(8.0)
    return replace(PLAN, tips=np.column_stack([depth, slope * depth, slope + 0.01 * depth]))


def test_the_entry_angle_is_that_at_the_skin():
    assert straight(atan(0.2)).entry_angle == pytest.approx(atan(0.2), abs=1e-12)
    assert straight(-0.1, start=-7.0).entry_angle == pytest.approx(-0.1, abs=1e-12)
    assert straight(-0.1, start=0.0).entry_angle == pytest.approx(-0.1, abs=1e-12)


def test_a_tip_outside_the_skin_has_no_entry_angle():
    assert np.isnan(straight(0.1, start=-20.0).entry_angle)


def test_a_plan_that_misses_names_distance_and_limit():
    missing = replace(PLAN, target=(40.0, 8.0), limit="setup.stroke_mm = 60")
    assert missing.summary == (
        "MISSES the target: best distance 2.990 mm, more than 1 mm, limited by setup.stroke_mm = 60"
    )
    assert PLAN.summary == "reaches the target to 0.010 mm"


def test_the_summary_of_an_insertion_is_one_line():
    assert make_insertion().summary == "reached: the tip ended 0.070 mm from the target"
    assert (
        make_insertion(miss=1.0).summary == "MISSED: the tip ended 1.010 mm from the target, more than 1 mm"
    )
    assert (
        make_insertion(outcome="held", reason="no sample", periods=3).summary
        == "held after 3 periods: no sample"
    )
    unknown_tip = Insertion(PLAN, 0, tuple(map(blind, make_insertion().periods)), Outcome("done"), "")
    assert unknown_tip.summary == "done: true tip unknown"


def test_missing_values_are_null():
    unknown_tip = Insertion(PLAN, 0, tuple(map(blind, make_insertion().periods)), Outcome("done"), "")
    result = insertion_result(unknown_tip)
    unknown = {name for name, value in result.items() if value is None}
    errors = {"true_error_mm", "residual_mm"}
    assert unknown == {"phantom", "tip_true_mm", "tip_measured_mm", "strain_energy_mj", "warning"} | errors
    assert result["reached"] is False
    empty = Insertion(PLAN, 0, (), Outcome("failed"), "")
    assert insertion_result(empty)["steps"] == 0
    assert insertion_timing(empty)["period_ms"] == {"p50": None, "p99": None, "max": None}


def test_the_result_has_the_names_of_controller_and_phantom():
    result = insertion_result(replace(make_insertion(), controller="ce-mpc", phantom="model"))
    assert (result["controller"], result["phantom"]) == ("ce-mpc", "model")


def test_one_unconverged_period_is_not_hidden():
    insertion = make_insertion()
    assert insertion_result(insertion)["converged"] is True
    periods = (replace(insertion.periods[0], converged=False, cost=nan), *insertion.periods[1:])
    assert insertion_result(replace(insertion, periods=periods))["converged"] is False
