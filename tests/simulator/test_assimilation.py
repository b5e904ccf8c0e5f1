"""Measurements as essential conditions."""

import numpy as np
import pytest

from flexneedle import Control, Simulator, load_scenario
from flexneedle.errors import CommandError
from reference.cases import assert_same_curve, insert_to, repeat

PHANTOM = load_scenario("phantom")
SIMULATOR = Simulator(PHANTOM)


@pytest.fixture(scope="module")
def state():
    """The needle of the phantom, 30 mm deep."""
    return repeat(SIMULATOR, insert_to(SIMULATOR, 20.0), Control(db_x=1.0, dg_y=0.1), 10)[-1]


@pytest.mark.parametrize("offset", [-0.5, 1e-3, 0.8])
def test_tip_is_held_where_it_was_measured(state, offset):
    """y exactly; x is rigid, and its difference is returned."""
    x, y = state.tip[:2]
    held, innovation = SIMULATOR.assimilate(state, (x + 0.25, y + offset))
    assert held.tip[1] == y + offset
    assert innovation == x + 0.25 - held.tip[0]
    assert held.converged


def test_measurement_that_agrees_changes_nothing(state):
    """And needs no force."""
    held, innovation = SIMULATOR.assimilate(state, state.tip[:2])
    assert_same_curve(held, state, 1e-6)
    assert innovation == pytest.approx(0.0, abs=2e-6)
    assert held.reactions.tip_force == pytest.approx((0.0, 0.0), abs=1e-8)


def test_reaction_is_the_load_that_the_model_lacks(state):
    """With the reaction as a tip load, the needle stays where it was held without being held."""
    x, y = state.tip[:2]
    held, slide = SIMULATOR.assimilate(state, (x, y + 0.4))
    assert held.reactions.tip_force[0] > 1e-3
    assert state.reactions.tip_force == (0.0, 0.0)
    loaded = held.with_estimate(tip_load=held.reactions.tip_force)
    again, innovation = SIMULATOR.assimilate(loaded, (x, y + 0.4))
    assert again.reactions.tip_force == pytest.approx((0.0, 0.0), abs=1e-8)
    assert innovation == pytest.approx(slide, abs=1e-5)
    assert SIMULATOR.step(loaded, Control()).tip[1] == pytest.approx(y + 0.4, abs=2e-3)
    assert SIMULATOR.step(held, Control()).tip[1] < y + 0.3


def test_order_of_measured_points_does_not_matter(state):
    """They are sorted, and the caller's list stays as it is."""
    points = [(20.2, 3.0), (-20.0, 1.2), (-30.0, 1.0), (5.1, 2.0)]  # two of them between the same nodes
    kept = list(points)
    one = SIMULATOR.assimilate(state, state.tip[:2], points).state
    other = SIMULATOR.assimilate(state, state.tip[:2], points[::-1]).state
    assert one == other
    assert points == kept


@pytest.mark.parametrize(
    ("tip", "points", "name"),
    [
        ((30.0, np.nan), [], "measured position"),
        ((30.0, 1.0), [(5.0, np.inf)], "measured position"),
        ((30.0, 1.0), [(-41.05, 0.0)], "measured point x"),
        ((30.0, 1.0), [(40.0, 0.0)], "measured point x"),
        ((30.0, 1.0), [(5.0, 0.0), (5.01, 0.0)], "measured point x"),
        ((0.0, 0.0, 1.0, 2.0), (), "coordinates of a measured point"),
        ((-28.5, 0.0), [(1.0, 2.0, 3.0)], "coordinates of a measured point"),
    ],
)
def test_impossible_measurements_are_refused(state, tip, points, name):
    """Not finite, at the guide, off the needle, too close together, with too many coordinates."""
    with pytest.raises(CommandError) as caught:
        SIMULATOR.assimilate(state, tip, points)
    assert caught.value.name == name
