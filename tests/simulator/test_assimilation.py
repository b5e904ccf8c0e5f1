"""Measurements as essential conditions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle import Control, Simulator, load_scenario
from flexneedle.errors import CommandError
from reference.cases import assert_same_curve, insert_to, repeat

PHANTOM = load_scenario("phantom")
SIMULATOR = Simulator(PHANTOM)
SPACE = load_scenario("phantom3d")


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


@pytest.mark.parametrize("axes", [1, 2])
def test_a_held_pose_of_a_free_needle_needs_the_loads_of_a_cantilever(axes):
    """F = EI (12 y/L³ − 6 θ/L²), M = EI (4 θ/L − 6 y/L²)."""
    free = {
        "setup.axes": axes,
        "setup.guide_to_skin_mm": None,
        "setup.stroke_mm": 100.0,
        "target.lateral_mm": 0.0,
    }
    simulator = Simulator(PHANTOM.with_values(free))
    start, (y, slope) = simulator.start(), (np.array([0.8, -0.5])[:axes], np.array([0.01, 0.004])[:axes])
    held, _ = simulator.assimilate(start, (start.tip[0], *y), slope=slope)
    stiffness, length = PHANTOM.needle.bending_stiffness, held.tip[0] - held.base[0]
    np.testing.assert_allclose(held.tip[1 : 1 + axes], y, atol=1e-12)
    np.testing.assert_allclose(held.tip[3 : 3 + axes], slope, atol=1e-12)
    force = stiffness * (12.0 * y / length**3 - 6.0 * slope / length**2)
    moment = stiffness * (4.0 * slope / length - 6.0 * y / length**2)
    np.testing.assert_allclose(held.reactions.tip_force[:axes], force, rtol=1e-6)
    np.testing.assert_allclose(held.reactions.tip_moment[:axes], moment, rtol=1e-6)


def test_a_held_slope_changes_nothing_where_it_agrees_and_else_needs_a_moment(state):
    x, y, _, slope, _ = state.tip
    same, _ = SIMULATOR.assimilate(state, (x, y), slope=(slope,))
    assert_same_curve(same, state, 1e-6)
    assert same.reactions.tip_moment == pytest.approx((0.0, 0.0), abs=1e-6)
    turned, _ = SIMULATOR.assimilate(state, (x, y), slope=(slope + 0.01,))
    assert turned.converged
    assert turned.tip[[1, 3]].tolist() == pytest.approx([y, slope + 0.01], abs=1e-12)
    assert turned.reactions.tip_moment[0] > 1.0
    free, _ = SIMULATOR.assimilate(state, (x, y))
    assert free.reactions.tip_moment == (0.0, 0.0)
    assert SIMULATOR.step(turned, Control()).tip[3] == pytest.approx(slope, abs=2e-3)


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
        ((30.0, np.nan), [], "measured point"),
        ((30.0, 1.0), [(5.0, np.inf)], "measured point"),
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


poses = st.tuples(*[st.floats(-bound, bound) for bound in (1.5, 1.5, 0.03, 0.03)])


@given(pose=poses, ahead=st.floats(0.0, 20.0))
def test_a_needle_in_air_starts_straight_at_the_measured_pose_of_its_tip(pose, ahead):
    """Base and guide are on its line, so that nothing bends it; only the guide is off its home."""
    simulator = Simulator(SPACE.with_values({"entry.slope_mrad": 20.0}))
    state = simulator.start(0.0, (-ahead, *pose[:2]), pose[2:])
    x, line = state.nodes[:, 0], state.nodes[:, 1:3]
    np.testing.assert_allclose(line, np.add(pose[:2], np.outer(x + ahead, pose[2:])), atol=1e-4)
    np.testing.assert_allclose(state.tip, [-ahead, *pose], atol=1e-6)
    np.testing.assert_allclose(state.reactions.guide_force, 0.0, atol=1e-5)
    np.testing.assert_allclose(state.travel[1:5], 0.0, atol=1e-9)
    assert state.travel[0] == pytest.approx(28.5 - ahead, abs=0.2)  # so the stroke ends at the same depth


def test_a_needle_that_starts_as_in_the_scenario_is_where_the_scenario_has_it():
    simulator = Simulator(SPACE)
    given = simulator.start(0.4, simulator.start().tip[:3], simulator.start().tip[3:])
    np.testing.assert_allclose(given.nodes, simulator.start(0.4).nodes, atol=1e-12)


def test_a_needle_of_which_the_slope_alone_is_measured_keeps_the_tip_of_the_scenario():
    state = SIMULATOR.start(slope=(0.02,))
    np.testing.assert_allclose(state.tip, [-28.5, 0.0, 0.0, 0.02, 0.0], atol=1e-6)
    assert state.guide[0] == pytest.approx(-0.02 * 12.5)


@pytest.mark.parametrize(
    ("tip", "slope", "message"),
    [
        ((2.0, 0.0), (0.0,), r"measured tip x = 2: must be at most 0, before the skin and past the guide"),
        ((-41.5, 0.0), (0.0,), r"measured tip x = -41.5: .* past the guide \(-41\)"),
        ((-2.0, np.nan), None, r"measured point = nan: must be finite"),
        ((-2.0,), None, r"coordinates of a measured point = 1: must be 2, x, y in mm"),
        ((-2.0, 0.0), (0.0, 0.0), r"coordinates of a measured slope = 2: must be 1: dy/dx"),
        (None, (0.21,), r"measured slope = 0.21: must be at most 0.2 in size"),
        (None, (np.inf,), r"measured slope = inf: must be finite"),
    ],
)
def test_a_start_that_cannot_be_is_refused(tip, slope, message):
    with pytest.raises(CommandError, match=message):
        SIMULATOR.start(0.0, tip, slope)


@pytest.mark.parametrize("slope", [(np.nan,), (0.0, 0.0)])
def test_an_impossible_slope_is_refused(state, slope):
    with pytest.raises(CommandError, match="measured slope"):
        SIMULATOR.assimilate(state, state.tip[:2], slope=slope)


@pytest.mark.parametrize("depth", [-28.6, 81.6, np.nan, np.inf])
def test_a_depth_outside_the_stroke_is_refused(state, depth):
    with pytest.raises(CommandError, match=r"depth = .*must be from -28.5 to 81.5, within the stroke"):
        SIMULATOR.advance_to(state, depth)


def test_a_depth_that_a_bent_needle_does_not_reach_is_refused(state):
    """A withdrawn needle with the guide far off its axis snaps out of the last of the tissue (theory, 12)."""
    bent, _ = SIMULATOR.replay(state, [Control(dg_y=8.0)])
    with pytest.raises(CommandError, match=r"depth = 0.1: .* the needle is bent too far"):
        SIMULATOR.advance_to(bent, 0.1)


@pytest.mark.parametrize(
    ("guide", "depth"), [(0.5, 33.7), (0.5, 30.02), (0.5, 12.5), (6.0, 12.5), (11.0, 80.0)]
)
def test_the_tip_is_advanced_to_a_depth(state, depth, guide):
    """Also where the needle has become shorter along its axis since a guide has bent it."""
    bent, _ = SIMULATOR.replay(state, [Control(dg_y=guide)])
    reached = SIMULATOR.advance_to(bent, depth)
    assert reached.tip[0] == pytest.approx(depth, abs=1e-6)
    assert reached.converged
