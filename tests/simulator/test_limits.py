"""Limits of many sequences by their extremes, against the check that names the first value."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.errors import CommandError
from flexneedle.simulator.control import Limits, controls
from flexneedle.types import COLUMNS, DB_X, ROLL

SCENARIOS = {
    "plane": load_scenario("phantom"),
    "space": load_scenario("phantom3d"),
    "range": load_scenario("phantom3d").with_values({"setup.max_rotation_deg": 180.0}),
}
MOVED = np.array([3.0, 0.1, 0.0, 0.0, 0.0, 0.2, 0.0])


def is_refused(limits, rows, roll):
    try:
        limits.check(MOVED, rows, roll)
    except CommandError:
        return True
    return False


@given(
    name=st.sampled_from(sorted(SCENARIOS)),
    place=st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, len(COLUMNS) - 1)),
    value=st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-4.0, 4.0)),
    length=st.floats(0.0, 70.0),
)
@settings(max_examples=200)
def test_sequences_within_by_their_extremes_break_no_limit(name, place, value, length):
    limits, rows = Limits.of(SCENARIOS[name]), controls(3, 4, db_x=0.5)
    rows[1, 2, DB_X], rows[0, 0, ROLL] = length, np.pi
    rows[place] = value
    roll = -np.pi if name == "range" else 0.0
    assert not (limits.are_kept(MOVED, rows, roll) and is_refused(limits, rows, roll))


@pytest.mark.parametrize("name", SCENARIOS)
def test_usual_sequences_are_within(name):
    limits, rows = Limits.of(SCENARIOS[name]), controls(3, 40, db_x=1.0, dg_y=0.02)
    rows[1, 7, ROLL], rows[2, 9, ROLL] = np.pi, -np.pi
    assert limits.are_kept(MOVED, rows, 0.0)
    assert not is_refused(limits, rows, 0.0)


@pytest.mark.parametrize(
    ("name", "start", "columns"),
    [
        ("plane", 0.0, {"db_x": [0.5, np.nan, 0.5]}),
        ("space", 0.0, {"roll": [0.0, 0.0, np.nan]}),
        ("space", 0.0, {"spin": [np.inf, 0.0, 0.0]}),
        ("space", 0.0, {"dg_y": [0.0, 2.0, 0.0]}),  # step
        ("plane", 0.0, {"dg_z": [0.0, 1e-3, 0.0]}),  # that may not move
        ("plane", 0.0, {"db_x": [1.0] * 108}),  # sum
        ("plane", 0.0, {"db_x": [-1.0, -1.0, -1.0, -0.1]}),
        ("plane", 0.0, {"roll": [0.0, 1.0, 0.0]}),
        ("plane", 0.0, {"spin": [0.0, 1e-3, 0.0]}),
        ("range", 0.0, {"roll": [-2.0, 4.0, 2.0]}),  # angle
        ("range", 0.0, {"roll": [3.5, 0.0, 0.0], "spin": [-1.0, 0.0, 0.0]}),
        ("range", 3.0, {"roll": [0.0, 0.2, -0.2]}),
    ],
)
def test_a_value_that_breaks_a_limit_is_found(name, start, columns):
    limits, steps = Limits.of(SCENARIOS[name]), max(map(len, columns.values()))
    rows = controls(2, steps)
    rows[1] = controls(steps, **columns)
    assert is_refused(limits, rows, start)
    assert not limits.are_kept(MOVED, rows, start)
