"""Readings as exact text: all that a tracker measured, with its covariances."""

import math
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from flexneedle.record.reader import read_trace
from flexneedle.record.readings import from_values, to_values
from flexneedle.record.writer import TraceWriter
from flexneedle.types import CheckedMeasurement, Measurement, Verdict
from synthetic import make_periods, make_plan

NUMBERS = st.floats(-1e6, 1e6)
VARIANCES = st.floats(0.0, 1e6)
BARE = Measurement(0.1, 30.1, 1 / 3, -0.7)
FULL = replace(
    BARE,
    direction=(1 / 3, -0.1),
    points=((-1 / 7, 0.1, 0.2), (10.0, 1e-17, -1e22), (0.1 + 0.2, -0.0, 3.0)),
    covariance=((0.01, 1 / 300, 0.0), (1 / 300, 0.02, -1e-9), (0.0, -1e-9, 1 / 30)),
    direction_covariance=((1e-6, -1e-7), (-1e-7, 1 / 3e6)),
)
NEW = ("direction", "points", "covariance", "direction_covariance")
KEYS = {
    "direction_theta_rad", "direction_psi_rad", "points_mm", "covariance_mm2", "direction_covariance_rad2",
}  # fmt: skip


def restored(measurement):
    return from_values(to_values(CheckedMeasurement(measurement, Verdict())), Verdict()).measurement


@st.composite
def covariances(draw, size):
    rows = [[0.0] * size for _ in range(size)]
    for i in range(size):
        rows[i][i] = draw(VARIANCES)
        for j in range(i):
            rows[i][j] = rows[j][i] = draw(NUMBERS)
    return tuple(map(tuple, rows))


@given(
    direction=st.none() | st.tuples(NUMBERS, NUMBERS),
    points=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), max_size=4).map(tuple),
    covariance=st.none() | covariances(3),
    direction_covariance=st.none() | covariances(2),
)
def test_all_that_was_measured_is_restored_exactly(**measured):
    measurement = replace(BARE, **measured)
    assert restored(measurement) == measurement
    assert repr(restored(measurement)) == repr(measurement)  # the sign of a zero, too


def test_a_status_has_keys_with_units_for_what_was_measured():
    values = to_values(CheckedMeasurement(FULL, Verdict()))
    assert values.keys() - to_values(CheckedMeasurement(BARE, Verdict())).keys() == KEYS
    assert values["direction_theta_rad"] == repr(1 / 3)
    assert values["points_mm"].startswith(f"{-1 / 7!r} 0.1 0.2; 10.0 1e-17 -1e+22; ")
    assert values["direction_covariance_rad2"] == f"1e-06 -1e-07; -1e-07 {1 / 3e6!r}"


def test_values_that_are_not_finite_are_restored():
    bad = replace(
        BARE,
        direction=(math.nan, math.inf),
        points=((math.nan, 0.0, -math.inf),),
        covariance=((math.nan,) * 3,) * 3,
        direction_covariance=((math.inf, math.nan), (math.nan, 0.0)),
    )
    assert repr(restored(bad)) == repr(bad)


def test_a_trace_has_all_that_was_measured(tmp_path):
    plan = make_plan()
    readings = tuple(
        CheckedMeasurement(replace(FULL, **without), Verdict())
        for without in ({}, *({name: () if name == "points" else None} for name in NEW))
    )
    period = replace(next(iter(make_periods(plan))), readings=readings)
    with TraceWriter(tmp_path / "trace.mcap", plan, about={"seed": "0"}, scenario={}) as writer:
        writer.add(period)
    (again,) = read_trace(tmp_path / "trace.mcap").periods
    assert again.readings == readings


def test_a_trace_with_a_malformed_reading_ends_before_it(tmp_path, monkeypatch):
    plan = make_plan()
    monkeypatch.setattr(
        "flexneedle.record.topics.to_values",
        lambda checked: to_values(checked) | {"covariance_mm2": "1.0 0.0"},
    )
    first, second = (period for period, _ in zip(make_periods(plan), range(2), strict=False))
    with TraceWriter(tmp_path / "trace.mcap", plan, about={"seed": "0"}, scenario={}) as writer:
        writer.add(replace(first, readings=()))
        writer.add(replace(second, readings=(CheckedMeasurement(BARE, Verdict()),)))
    trace = read_trace(tmp_path / "trace.mcap")
    assert len(trace.periods) == 1
    assert "incomplete: 1 complete periods read" in trace.note
