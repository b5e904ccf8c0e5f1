"""Data of the figures: indicators of the references, holds, and rolls of the needle."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle import controls
from flexneedle.figures.curves import (
    applied_rolls,
    held_spans,
    planned_angles,
    planned_rolls,
    worst_indicator,
)
from flexneedle.record.fields import parse_verdict
from flexneedle.types import ROLL, SPIN, CheckedMeasurement, Measurement, X
from synthetic import make_insertion, make_plan
from synthetic_readings import frame_of, held

INSERTION = make_insertion()


def indicators(frames, window, verdicts=()):
    """Return the curve of an insertion whose first period has these frames."""
    readings = tuple(
        CheckedMeasurement(Measurement(frame.time, 0.0, 0.0, 0.0, frame), parse_verdict(verdict))
        for frame, verdict in zip(frames, verdicts or ["ok"] * len(frames), strict=True)
    )
    period = replace(INSERTION.periods[0], readings=readings)
    return worst_indicator(replace(INSERTION, periods=(period,)), window)


def test_the_curve_is_the_largest_median_of_a_reference():
    """By hand; the last window is open at its beginning, as in the monitor: it excludes 0.0 s."""
    values = [(0.01, 0.02), (0.03, 0.90), (0.09, 0.04), (0.05, 0.06)]
    frames = [frame_of(k, 0.3 * k, {"a": a, "b": b, "tip": 5.0}) for k, (a, b) in enumerate(values)]
    np.testing.assert_allclose(indicators(frames, 0.9), [[0.0, 0.02], [0.3, 0.46], [0.6, 0.04], [0.9, 0.06]])


def test_readings_that_the_monitor_excludes_do_not_count():
    frames = [frame_of(k, 0.1 * k, {"a": value}) for k, value in enumerate((0.01, 0.5, 0.6, 0.02))]
    verdicts = ["ok", "stale: frame 1 after frame 1", "not a number", "innovation: 2.31 mm, limit 2.00 mm"]
    np.testing.assert_allclose(indicators(frames, 1.0, verdicts), [[0.0, 0.01], [0.3, 0.015]])


def test_the_curve_has_a_gap_where_a_window_has_no_measured_reference():
    frames = [frame_of(k, float(k), {"a": value}) for k, value in enumerate((0.01, None, 0.02))]
    np.testing.assert_array_equal(indicators(frames, 0.5)[:, 1], [0.01, np.nan, 0.02])


def test_holds_are_spans_of_whole_periods():
    periods = tuple(held(p) if p.index in {0, 1, 5} else p for p in INSERTION.periods)
    spans = held_spans(replace(INSERTION, periods=periods))
    np.testing.assert_allclose(spans, [(0.0, 0.4), (1.0, 1.2)])
    assert replace(INSERTION, periods=periods).held_s == pytest.approx(0.6)


def test_rolls_of_less_than_5_degrees_have_no_mark():
    for degrees, count in ((4.0, 0), (-6.0, 1)):
        command = INSERTION.periods[0].applied._replace(roll=np.radians(degrees), spin=0.3)
        first = replace(INSERTION.periods[0], applied=command)
        found = applied_rolls(replace(INSERTION, periods=(first,)))
        assert [roll.angle for roll in found] == [pytest.approx(first.roll - 0.3)] * count
    plan = make_plan()
    assert planned_rolls(replace(plan, controls=controls(len(plan.controls), db_x=1.0, roll=0.01))) == []


def test_the_planned_angle_jumps_at_rolls_and_rises_with_the_spin():
    plan = replace(make_plan(), roll=0.1)
    plan.controls[:, ROLL] = 0.0
    plan.controls[3, ROLL], plan.controls[4, SPIN] = 0.5, -0.25
    found, x = planned_angles(plan), plan.tips[:, X]
    np.testing.assert_allclose(found[6:11, 0], [x[3], x[3], x[4], x[4], x[5]])
    np.testing.assert_allclose(found[6:11, 1], [0.1, 0.6, 0.6, 0.6, 0.35])
    (roll,) = planned_rolls(plan)
    assert roll.angle == pytest.approx(0.6)
