"""Consequences of a predicted miss: its probability, a warning, a hold."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

import flexneedle
from flexneedle.control.forecast import (
    count_likely_misses,
    describe_miss,
    probability_beyond,
    reason_to_hold,
    warn_of_miss,
)
from flexneedle.control.interface import Decision
from flexneedle.errors import InputError
from flexneedle.types import STILL

CONTROL = flexneedle.load_scenario("phantom").control
LIMIT, SURE = CONTROL.miss_limit_mm, norm.ppf(CONTROL.miss_confidence)


def predicting(miss, sd):
    """A decision that predicts a miss (mm)."""
    return Decision(STILL, "", miss=miss, miss_sd=sd)


@given(st.floats(0.0, 10.0), st.floats(-20.0, 20.0), st.floats(1e-3, 10.0))
def test_the_probability_equals_a_normal_miss_on_either_side(limit, miss, sd):
    expected = norm.cdf(-limit, miss, sd) + norm.sf(limit, miss, sd)
    assert probability_beyond(limit, miss, sd) == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(("miss", "beyond"), [(1.99, 0.0), (-1.99, 0.0), (2.01, 1.0), (-2.01, 1.0)])
def test_a_miss_that_is_certain_is_beyond_the_limit_or_not(miss, beyond):
    assert probability_beyond(2.0, miss, 0.0) == beyond
    assert probability_beyond(2.0, miss, 1e-9) == pytest.approx(beyond)


@pytest.mark.parametrize(("miss", "sd"), [(math.nan, math.nan), (math.nan, 1.0)])
def test_without_a_prediction_there_is_neither_hold_nor_warning(miss, sd):
    assert probability_beyond(LIMIT, miss, sd) == 0.0
    assert reason_to_hold(predicting(miss, sd), CONTROL) == ""
    assert count_likely_misses(predicting(miss, sd), 5) == 0


def test_a_predicted_miss_without_a_standard_deviation_is_refused():
    with pytest.raises(InputError, match="miss_sd"):
        predicting(9.0, math.nan)


def test_where_no_path_was_found_the_needle_is_held():
    assert reason_to_hold(Decision(STILL, "no path converges", math.inf), CONTROL) == "no path converges"


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("sd", [0.05, 0.4])
def test_the_needle_is_held_from_the_confidence_on(side, sd):
    """The bound is the limit plus the quantile of the confidence."""
    bound = LIMIT + SURE * sd
    assert reason_to_hold(predicting(side * (bound - 1e-6), sd), CONTROL) == ""
    held = reason_to_hold(predicting(side * (bound + 1e-6), sd), CONTROL)
    assert f"{side * bound:+.3f} ± {sd:.3f} mm" in held
    assert "control.miss_limit_mm = 2 " in held
    assert "0.95" in held
    assert "--force" in held


def test_limit_and_confidence_are_the_scenarios():
    strict = flexneedle.load_scenario("phantom").with_values(
        {"control.miss_limit_mm": 0.5, "control.miss_confidence": 0.5}
    )
    assert reason_to_hold(predicting(0.51, 0.3), CONTROL) == ""
    assert "control.miss_limit_mm = 0.5 " in reason_to_hold(predicting(0.51, 0.3), strict.control)


def warned(decisions):
    """Return the warning after each of several decisions."""
    in_a_row, lines = 0, []
    for decision in decisions:
        in_a_row = count_likely_misses(decision, in_a_row)
        lines.append(warn_of_miss(decision, in_a_row))
    return lines


def test_several_likely_misses_in_a_row_make_a_warning():
    """A single one does not, and neither does a row that a good decision interrupts."""
    bad, good = predicting(3.0, 0.5), predicting(0.1, 0.1)
    lines = warned([bad] * 5)
    first = next(k for k, line in enumerate(lines) if line)
    assert first > 0
    assert all("+3.000 ± 0.500 mm" in line for line in lines[first:])
    assert warned(([bad] * first + [good]) * 4) == [""] * (4 * (first + 1))


def test_it_is_likely_from_a_probability_of_one_half_on():
    """With a small standard deviation, that is where the predicted miss itself exceeds 1 mm."""
    for miss, likely in ((0.999, 0), (1.001, 1), (-0.999, 0), (-1.001, 1)):
        assert count_likely_misses(predicting(miss, 0.05), 0) == likely
    assert count_likely_misses(predicting(1.5, 0.05), 4) == 5
    assert count_likely_misses(predicting(0.0, 0.05), 4) == 0


def test_without_a_prediction_nothing_is_warned_of():
    """A needle at rest predicts nothing, even after decisions that did."""
    assert warn_of_miss(predicting(math.nan, math.nan), 9) == ""


@given(st.floats(-5.0, 5.0), st.floats(1e-3, 3.0))
def test_a_miss_that_holds_also_counts_towards_a_warning(miss, sd):
    decision = predicting(miss, sd)
    assert count_likely_misses(decision, 0) == 1 or not reason_to_hold(decision, CONTROL)


@pytest.mark.parametrize(
    ("true", "estimated", "shown"),
    [(1.1, 0.3, "1.100 mm"), (0.9, 1.3, ""), (math.nan, 2.5, "2.500 mm"), (math.nan, 0.9, "")],
)
def test_an_end_beyond_a_millimetre_of_the_target_is_a_miss(true, estimated, shown):
    """The true tip counts where it is known."""
    line = describe_miss(true, estimated)
    assert shown in line
    assert bool(line) == bool(shown)
