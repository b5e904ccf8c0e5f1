"""From counts of the motors to positions of the axes, and to motions of the needle."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import RigError
from flexneedle.lab.emulators.emulated_rig.axes import (
    NAMES,
    Carriage,
    carriages_of,
    control_between,
)
from flexneedle.lab.rig.rig_axes import Axes
from flexneedle.scenario.files import load_scenario
from flexneedle.types import DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

PHANTOM = load_scenario("phantom")
FAR = (-1e9, 1e9)
LINEAR = {"channel": "A", "counts_per_mm": 2000.0, "range_mm": [0.0, 110.0], "speed_mm_s": 10.0}
LINEAR["acceleration_mm_s2"] = 250.0
travels = st.lists(st.floats(-50_000.0, 50_000.0), min_size=1, max_size=30)


def axes(**changes):
    return Axes.model_validate({"insertion": LINEAR | changes})


def followed(carriage, path):
    """Positions after each travel of a path (counts)."""
    places = itertools.accumulate(path, carriage.move, initial=carriage.start)
    return np.array(list(places))


def with_slack(start, backlash, motor):
    """Positions of a carriage that is moved by what exceeds the slack: it is all behind the motor at first."""
    place, slack, places = start, 0.0, []
    for step in np.diff([start, *motor]):
        wanted = slack + step  # beyond 0 it pushes, beyond −backlash it pulls
        slack = min(max(wanted, -backlash), 0.0)
        place += wanted - slack
        places.append(place)
    return np.array(places)


@given(travels, st.sampled_from([2000.0, -2000.0]), st.floats(0.0, 3.0))
def test_with_backlash_the_axis_lags_by_the_lost_motion_on_reversal(path, scale, backlash):
    places = followed(Carriage(scale, 1.0, FAR, FAR, backlash), path)[1:]
    motor = 1.0 + np.array(path) / scale
    np.testing.assert_allclose(places, with_slack(1.0, backlash, motor), rtol=0, atol=1e-9)
    assert (places >= motor - 1e-9).all()
    assert (places <= motor + backlash + 1e-9).all()


def test_a_carriage_ends_at_its_stops():
    places = followed(Carriage(1000.0, 0.0, (-2.0, 10.0), FAR), [20_000.0, 9_500.0, -9_000.0])
    np.testing.assert_allclose(places, [0.0, 10.0, 9.5, -2.0])


def test_switches_and_stops_are_beyond_the_soft_limits():
    carriage = carriages_of(axes(), PHANTOM)["insertion"]
    assert carriage.switches == (-2000.0, 222_000.0)
    assert carriage.stops == (-2.0, 112.0)
    backwards = carriages_of(axes(direction=-1), PHANTOM)["insertion"]
    assert backwards.switches == (-222_000.0, 2000.0)
    assert backwards.move(0.0, -2000.0) == 1.0


def test_the_insertion_ends_behind_the_stroke_of_the_scenario():
    """The phantom has no tissue beyond."""
    short = PHANTOM.with_values({"setup.stroke_mm": 80.0})
    assert carriages_of(axes(), short)["insertion"].stops == (-2.0, 82.0)


def test_an_axis_starts_at_its_home_and_a_switch_is_where_it_is_homed():
    here = carriages_of(axes(home_mm=10.0), PHANTOM)["insertion"]
    assert (here.start, here.switches) == (10.0, (-22_000.0, 202_000.0))
    at_switch = carriages_of(axes(home="reverse-limit", home_mm=-0.5), PHANTOM)["insertion"]
    assert (at_switch.start, at_switch.switches) == (0.0, (-1000.0, 222_000.0))
    lateral = Axes.model_validate({"insertion": LINEAR, "guide_y": LINEAR | {"channel": "B", "home_mm": 3.0}})
    assert carriages_of(lateral, PHANTOM)["guide_y"].start == 0.0  # on the needle's axis


def test_an_axis_beyond_the_emulated_channels_is_refused():
    with pytest.raises(RigError, match=r"axes.insertion.channel = 'E': must be one of A, B, C, D"):
        carriages_of(axes(channel="E"), PHANTOM)


places = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6).map(np.array)


@given(st.lists(places, min_size=2, max_size=10))
def test_increments_add_up_to_the_whole_way(path):
    rows = np.array([control_between(before, after) for before, after in itertools.pairwise(path)])
    total = dict(zip(NAMES, path[-1] - path[0], strict=True))
    columns = {"insertion": DB_X, "guide_y": DG_Y, "guide_z": DG_Z, "base_y": DB_Y, "base_z": DB_Z}
    for name, column in columns.items():
        assert rows[:, column].sum() == pytest.approx(total[name], abs=1e-9)
    assert rows[:, [ROLL, SPIN]].sum() == pytest.approx(total["rotation"], abs=1e-9)


def test_the_needle_turns_at_rest_or_during_the_advance():
    at_rest, moving = np.zeros(6), np.zeros(6)
    at_rest[NAMES.index("rotation")] = moving[NAMES.index("rotation")] = 0.3
    moving[NAMES.index("insertion")] = 0.1
    assert control_between(np.zeros(6), at_rest)[[ROLL, SPIN]].tolist() == [0.3, 0.0]
    assert control_between(np.zeros(6), moving)[[ROLL, SPIN]].tolist() == [0.0, 0.3]
