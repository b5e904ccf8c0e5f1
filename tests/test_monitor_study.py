"""studies/monitor.py: random draws, evaluation of the runs, and consistency of the three runs."""

import math

import numpy as np
import pytest

import monitor as study
from flexneedle import load_scenario
from flexneedle.types import CheckedMeasurement, Measurement
from synthetic import make_periods, make_plan
from synthetic_readings import frame_of


def record(indicator, tip=None, distortion=0.0, held=(), step=0.2):
    """A run of n periods; held: indices of the periods held for the field."""
    count = len(indicator)
    time = step * np.arange(1, count + 1)
    straight = np.column_stack([np.arange(count), np.zeros(count)]).astype(float)
    tips = straight if tip is None else np.asarray(tip, dtype=float)
    flags = np.isin(np.arange(count), held)
    off = np.broadcast_to(np.asarray(distortion, dtype=float), count)
    return study.RunRecord(time, np.asarray(indicator, dtype=float), tips, straight, off, flags, "done")


def test_draws_depend_on_the_number_alone_and_stay_in_their_ranges():
    scenario = load_scenario("phantom")
    drawn = [study.approach(scenario, number) for number in range(100)]
    assert drawn[7] == study.approach(scenario, 7)
    assert len({one.target for one in drawn}) == 15
    assert all(30.0 <= one.speed <= 400.0 for one in drawn)
    depths = [one.begins * 5.0 - 28.5 for one in drawn]
    assert all(-1e-9 <= depth <= one.target[0] - 5.0 for depth, one in zip(depths, drawn, strict=True))


def test_medians_are_of_the_worst_reference_over_the_window():
    plan = make_plan()
    periods = list(make_periods(plan))[:10]
    values = np.random.default_rng(0).uniform(0.0, 0.1, (10, 4, 2))
    for k, period in enumerate(periods):
        frames = [frame_of(0, 0.0, {"ref1": one, "ref2": other}) for one, other in values[k]]
        readings = [
            CheckedMeasurement(Measurement(0.2 * k + 0.05 * j, 0.0, 0.0, 0.0, frame), "ok")
            for j, frame in enumerate(frames)
        ]
        object.__setattr__(period, "readings", tuple(readings))
    flat = values.reshape(40, 2)
    expected = [np.median(flat[max(0, 4 * k + 4 - 20) : 4 * k + 4], axis=0).max() for k in range(10)]
    np.testing.assert_allclose(study.medians(periods, 1.0), expected)


def test_a_hold_is_timed_from_the_start_and_from_the_distortion():
    drawn = study.Approach(0, (40.0, 0.0), begins=0.5, speed=100.0)
    clean = record([0.0] * 10)
    off = [[k, 0.0 if k < 6 else 0.3] for k in range(10)]
    run = record([0.0] * 10, off, distortion=[0.0] * 4 + [0.6] * 6, held=(6, 7))
    hold = study.hold_of(drawn, clean, run)
    assert hold.after_begin == pytest.approx(1.4 - 0.5)
    assert hold.after_distortion == pytest.approx(1.4 - 1.0)
    assert (hold.deviation, hold.estimate_error) == (pytest.approx(0.3), pytest.approx(0.3))
    assert study.hold_of(drawn, clean, record([0.0] * 10)) is None
    never = study.hold_of(drawn, clean, record([0.0] * 10, held=(3,)))
    assert math.isnan(never.after_distortion)


def test_runs_with_different_periods_are_compared_at_the_same_time():
    """1 mm in 0.2 s, and 1 mm in 0.4 s: after 1.6 s the eighth and the fourth position, 4 mm apart."""
    fast, slow = record([0.0] * 10), record([0.0] * 10, step=0.4)
    assert study.tip_distance(fast, slow, 1.6) == pytest.approx(4.0)
    short, long = record([0.0] * 3), record([0.0] * 8)  # the last position is kept
    assert (
        study.tip_distance(long, short, 1.6)
        == study.tip_distance(long, short, math.inf)
        == pytest.approx(5.0)
    )
    kept = record([0.0] * 10, held=(7,))
    off = [[k, 0.1 * k] for k in range(10)]
    runs = study.Runs([], [record([0.0] * 10, off, step=0.4)], [], [kept], np.array([]))
    assert runs.clean_estimate_errors() == [pytest.approx(0.3)]


def test_the_deviation_from_a_path_is_lateral_and_at_the_same_depth():
    """Half the speed on the same path is no deviation; a path 0.3 mm beside it deviates by 0.3 mm."""
    fast, slow = record([0.0] * 10), record([0.0] * 10, step=0.4)
    beside = record([0.0] * 10, [[k, 0.3] for k in range(10)], step=0.4)
    assert study.path_deviation(fast, slow, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert study.path_deviation(fast, beside, 1.0) == pytest.approx(0.3)


def test_the_curve_counts_false_and_missed_holds():
    """Three clean runs; four with a plate: never distorted, distorted too late, detected in time, detected late."""
    clean = [record([level] * 20) for level in (0.01, 0.03, 0.05)]
    late = [0.0] * 17 + [2.0] * 3
    early = [0.0] * 5 + [2.0] * 15
    free = [
        record([0.01] * 20),
        record([0.01] * 20, distortion=late),
        record([0.01] * 8 + [0.2] * 12, distortion=early),
        record([0.01] * 11 + [0.2] * 9, distortion=early),
    ]
    runs = study.Runs([], clean, free, [], np.array([0.02, 0.06]))
    false, anywhere, missed = study.curve(runs)
    at = [int(np.argmin(np.abs(study.THRESHOLDS - limit))) for limit in (0.02, 0.04, 0.1, 0.5)]
    np.testing.assert_allclose(false[at], [2 / 3, 1 / 3, 0.0, 0.0])
    np.testing.assert_allclose(anywhere[at[1:]], [0.5, 0.0, 0.0])
    np.testing.assert_allclose(missed[at], [0.5, 0.5, 0.5, 1.0])


@pytest.mark.long
def test_a_run_is_held_only_with_a_plate():
    drawn = study.Approach(300_001, (25.0, 0.0), begins=4.0, speed=200.0)
    clean, kept = study.carry_out(drawn, False, True), study.carry_out(drawn, True, True)
    assert not clean.held.any()
    assert not clean.distortion.any()
    assert kept.distortion.max() > 1.0
    hold = study.hold_of(drawn, clean, kept)
    assert 0.0 < hold.after_begin < 4.0
    assert hold.deviation < 1.0
