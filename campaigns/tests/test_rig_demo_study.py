"""campaigns/rig_demo.py: its bounds."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import rig_demo

GOOD = rig_demo.Result(
    scenario="phantom",
    seed=1,
    outcome="done",
    true_error=0.08,
    simulated_error=0.05,
    innovation=0.0,
    periods=60,
    late_periods=0,
    ticks=900,
    tick_99=4.9,
    tick_max=30.0,
    missed=2,
    unexplained=0,
)


def test_within_the_bounds_nothing_is_printed():
    assert list(rig_demo._exceeded([GOOD, GOOD])) == []


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"outcome": "held"}, "not done: 1"),
        ({"true_error": 0.2}, "above the simulated one, mm: 0.09"),
        ({"true_error": math.nan}, "above the simulated one, mm: nan"),
        ({"tick_99": 5.1}, "of the worst insertion, ms: 5.1"),
        ({"unexplained": 1}, "not by a stall: 1"),
    ],
)
def test_each_bound_has_its_line(values, line):
    (found,) = rig_demo._exceeded([GOOD, replace(GOOD, **values)])
    assert line in found


def test_a_quick_run_judges_no_time():
    late = replace(GOOD, tick_99=9.0, late_periods=3, unexplained=1, true_error=0.5)
    assert list(rig_demo._exceeded([late], quick=True)) == []
    assert len(list(rig_demo._exceeded([replace(late, outcome="failed")], quick=True))) == 1
