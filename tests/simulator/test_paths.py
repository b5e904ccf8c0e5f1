"""The path as a continuous function of the commands: small steps, retraction, entry and exit, mirror images."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.types import DG_Y, ROLL, THETA, X, Y
from reference.cases import MIRROR, assert_same_curve, insert_to, repeat

PHANTOM = load_scenario("phantom")
SIMULATOR = Simulator(PHANTOM)


def driven(simulator, state, count, db_x):
    """Take equal steps of the base; return the end state, and the largest distance of successive tips (mm)."""
    rows = controls(1, count, db_x=db_x)
    result = simulator.rollout(state, rows, limits=False)
    assert result.converged.all()
    tips = np.vstack([state.tip, result.tips[0]])
    return simulator.replay(state, rows[0])[0], np.linalg.norm(np.diff(tips[:, :2], axis=0), axis=1).max()


@pytest.mark.parametrize(("spacing", "guide_mm"), [(1.0, 0), (1.0, 2), (2.0, 1)])
def test_the_tip_never_jumps(spacing, guide_mm):
    """0.01 mm steps: in through the skin and the layers' boundary, all the way out, and in again.

    The guide loads the needle by `guide_mm` at the skin and by twice that the other way in the tissue.
    """
    simulator = Simulator(PHANTOM.with_values({"contact.spacing_mm": spacing}))
    state = repeat(simulator, simulator.start(), Control(dg_y=0.5), 2 * guide_mm)[-1]
    state = repeat(simulator, state, Control(db_x=1.0), 28)[-1]
    entry, first = driven(simulator, state, 500, 0.01)
    loaded = repeat(simulator, driven(simulator, entry, 10, 0.5)[0], Control(dg_y=-0.5), 4 * guide_mm)[-1]
    before = driven(simulator, loaded, 18, 0.5)[0]
    boundary, second = driven(simulator, before, 300, 0.01)
    out, third = driven(simulator, boundary, 2350, -0.01)
    again, fourth = driven(simulator, out, 2400, 0.01)
    assert state.tip[0] < 0.0 < entry.tip[0]
    assert before.tip[0] < 20.0 < boundary.tip[0]
    assert out.tip[0] < 0.0
    assert again.tip[0] > 20.0
    assert max(first, second, third, fourth) < 0.02


@pytest.mark.parametrize("past", [1e-9, 1e-3, 0.3, 0.5, 0.51, 1.0])
def test_a_step_may_end_any_distance_past_a_contact_point(past):
    """The way on is the same as without that stop, and the tip at the stop is on it."""
    start = insert_to(SIMULATOR, 20.0, step=0.5)
    way = 21.5 - start.tip[0]  # to the contact point at 21.5 mm, but for the bending of the step itself
    at_point = SIMULATOR.step(start, Control(db_x=way / 2))
    at_point = SIMULATOR.step(at_point, Control(db_x=way / 2))
    at_point = SIMULATOR.step(at_point, Control(db_x=21.5 - at_point.tip[0]))
    stop = SIMULATOR.step(at_point, Control(db_x=past))
    assert stop.converged
    assert np.abs(stop.tip - at_point.tip)[1] < 0.2 * past + 1e-4
    end = SIMULATOR.step(stop, Control(db_x=1.0 - past)) if past < 1.0 else stop
    direct = SIMULATOR.step(at_point, Control(db_x=1.0))
    assert_same_curve(end, direct, 2e-3)


@settings(max_examples=8)
@given(st.lists(st.floats(-0.3, 1.0), min_size=20, max_size=60))
def test_path_depends_little_on_how_it_is_divided_into_steps(lengths):
    """Random pushes and short pulls end where one-millimetre steps end."""
    state = SIMULATOR.start()
    for length in [1.0] * 28 + lengths:
        state = SIMULATOR.step(state, Control(db_x=length))
    deepest = 28.0 + max(np.cumsum([0.0, *lengths]))
    even = SIMULATOR.start()
    for length in np.diff(np.append(np.arange(0.0, deepest, 0.5), deepest)):
        even = SIMULATOR.step(even, Control(db_x=float(length)))
    pull = float(28.0 + sum(lengths) - deepest)
    for _ in range(int(-pull) + 1):
        even = SIMULATOR.step(even, Control(db_x=pull / (int(-pull) + 1)))
    assert_same_curve(state, even, 0.01)


@pytest.mark.parametrize("pull", [0.3, 4.0, 15.0])
def test_retraction_and_reinsertion_return_to_the_same_shape(pull):
    """The cut channel remembers the path, and the tip spring its rest position."""
    state = repeat(SIMULATOR, insert_to(SIMULATOR, 25.0), Control(db_x=1.0, dg_y=-0.2), 10)[-1]
    steps = int(np.ceil(pull))
    out = repeat(SIMULATOR, state, Control(db_x=-pull / steps), steps)[-1]
    back = repeat(SIMULATOR, out, Control(db_x=pull / steps), steps)[-1]
    assert np.abs(out.tip - state.tip)[0] > 0.9 * pull
    assert_same_curve(back, state, 1e-3)
    np.testing.assert_allclose(back.contacts.rest, state.contacts.rest, atol=1e-3)
    assert back.energy == pytest.approx(state.energy, abs=1e-4)
    one, other = (SIMULATOR.step(s, Control(db_x=1.0)) for s in (state, back))
    assert_same_curve(one, other, 2e-3)


def test_points_ahead_of_a_retracted_tip_rest():
    """They stay in the list, are not active, carry no energy and keep the path."""
    state = insert_to(SIMULATOR, 30.0)
    out = repeat(SIMULATOR, state, Control(db_x=-1.0), 10)[-1]
    contacts = out.contacts
    assert contacts.x.size == state.contacts.x.size == 35
    np.testing.assert_array_equal(contacts.active, contacts.x < out.tip[0])
    ahead = ~contacts.active
    assert ahead.sum() == 10
    np.testing.assert_array_equal(contacts.rest, state.contacts.rest)
    np.testing.assert_array_equal(contacts.position[ahead], contacts.rest[ahead])
    assert np.all(contacts.stretch[ahead] == 1.0)


def test_new_points_rest_on_the_line_from_tip_to_tip():
    """Equation 9, for a step that is also moved sideways."""
    scenario = PHANTOM.with_values({"setup.max_advance_mm": 5.0})
    simulator = Simulator(scenario)
    before = insert_to(simulator, 20.0)
    after = simulator.step(before, Control(db_x=4.0, dg_y=0.5))
    new = after.contacts.x > before.tip[0]
    assert new.sum() == 4
    line = np.interp(after.contacts.x[new], *np.transpose([before.tip[:2], after.tip[:2]]))
    np.testing.assert_allclose(after.contacts.rest[new, 0], line, atol=1e-12)
    np.testing.assert_array_equal(after.contacts.rest[~new], before.contacts.rest)


def test_channel_closes_when_the_tip_leaves_the_skin():
    """The next entry cuts a new one where the tip then is."""
    state = insert_to(SIMULATOR, 8.0)
    out = repeat(SIMULATOR, state, Control(db_x=-1.0), 10)[-1]
    assert out.tip[0] < 0.0
    assert out.contacts.x.size == 0
    assert out.strain_energy == 0.0
    again = repeat(SIMULATOR, out, Control(dg_y=0.5), 6)[-1]
    fresh = repeat(SIMULATOR, insert_to(SIMULATOR, -2.0), Control(dg_y=0.5), 6)[-1]
    one, other = (repeat(SIMULATOR, state, Control(db_x=1.0), 8)[-1] for state in (again, fresh))
    assert one.contacts.x.size == other.contacts.x.size == 11
    np.testing.assert_allclose(one.contacts.rest, other.contacts.rest, atol=1e-5)
    assert_same_curve(one, other, 1e-5)


@pytest.mark.parametrize("past", [0.05, 0.4])
def test_points_grow_in_over_the_second_half_of_their_interval(past):
    """Equation 4: energy of the last point over the energy of a whole one, at the same compression."""
    scenario = PHANTOM.with_values({"needle.bevel.length_mm": 1e-6, "needle.bevel.offset_mm": 0.0})
    simulator = Simulator(scenario)
    state = insert_to(simulator, 10.5)
    state = simulator.step(state, Control(db_x=past))
    held = simulator.assimilate(state, (state.tip[0], 0.2)).state
    contacts = held.contacts
    assert contacts.x[-1] == 10.5
    y = np.interp(contacts.x, held.nodes[:, 0], held.nodes[:, 1])  # check of the mesh against the nodes
    np.testing.assert_allclose(contacts.position[:, 0], y, atol=2e-3)
    layer, u = scenario.tissue[0], np.abs(contacts.position - contacts.rest)[:, 0]
    length = np.where(contacts.x < 1.0, 0.25, np.where(contacts.x < 3.0, 0.5, 1.0))
    lam = 1 - u / layer.compression_length_mm
    volume = length * layer.engaged_width_mm * layer.compression_length_mm
    whole = 2 * layer.shear_modulus * volume / layer.alpha**2
    whole = whole * (2 * lam ** (-layer.alpha / 2) + lam**layer.alpha - 3)
    ramp = np.minimum(1.0, (held.tip[0] - contacts.x) / 0.5)
    assert ramp[-1] < 1.0
    assert held.strain_energy == pytest.approx(ramp @ whole, rel=1e-6)


ROWS = st.tuples(
    st.floats(-0.3, 1.0),
    st.floats(-0.3, 0.3),
    st.floats(-3e-3, 3e-3),
    st.floats(-0.4, 0.4),
    st.sampled_from([0, 0, 0, 1]),
)


@settings(max_examples=10)
@given(rows=st.lists(ROWS, min_size=1, max_size=30))
def test_mirrored_commands_and_bevel_mirror_the_insertion_to_the_last_bit(rows):
    """y → −y with the bevel reversed."""
    db_x, db_y, db_theta, dg_y, flips = np.transpose([(1.0, 0.0, 0.0, 0.1, 0.0)] * 30 + rows)
    columns, roll = {"db_y": db_y, "db_theta": db_theta, "dg_y": dg_y}, np.pi * flips
    mirrored = {name: -values for name, values in columns.items()}
    one, _ = SIMULATOR.replay(SIMULATOR.start(), controls(len(db_x), db_x=db_x, roll=roll, **columns))
    other, _ = SIMULATOR.replay(
        SIMULATOR.start(math.pi), controls(len(db_x), db_x=db_x, roll=roll, **mirrored)
    )
    np.testing.assert_array_equal(one.nodes, other.nodes * MIRROR)
    np.testing.assert_array_equal(one.contacts.stretch, other.contacts.stretch)
    assert (one.energy, one.bevel, one.iterations) == (other.energy, -other.bevel, other.iterations)
    assert one.tip[1] != 0.0


def test_one_layer_or_two_of_the_same_tissue_are_the_same():
    """A boundary between equal layers, in and between intervals, is not felt."""
    layer = PHANTOM.values()["tissue"][1]
    tissues = [[layer], *([layer | {"thickness_mm": end}, layer] for end in (13.0, 13.5))]
    tips = [insert_to(Simulator(PHANTOM.with_values({"tissue": tissue})), 30.0).tip for tissue in tissues]
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-12)
    np.testing.assert_allclose(tips[2], tips[0], atol=2e-3)


def test_nodes_are_at_equal_arc_lengths():
    """Base and tip among them, with the arc length ∫(1 + ½y'²) dx."""
    state = repeat(SIMULATOR, insert_to(SIMULATOR, 30.0), Control(dg_y=-0.3, db_x=0.5), 20)[-1]
    x, y, turn = state.nodes.T[[X, Y, THETA]]
    assert state.nodes.shape == (61, 5)
    np.testing.assert_array_equal(state.nodes[0], state.base)
    np.testing.assert_array_equal(state.nodes[-1], state.tip)
    length = np.diff(x)
    mean = np.diff(y) / length
    slopes = np.stack([turn[:-1], 1.5 * mean - 0.25 * (turn[1:] + turn[:-1]), turn[1:]])
    arcs = length * (1 + np.array([1, 4, 1]) @ slopes**2 / 12)
    np.testing.assert_allclose(arcs, 150.0 / 60, atol=1e-6)
    assert arcs.sum() == pytest.approx(150.0, abs=1e-5)


def test_strain_energy_weighs_the_layers_and_energy_does_not():
    """w_c of each layer on its contacts; no weight changes the motion."""
    states = []
    for weights in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (2.0, 3.0)):
        weighted = {f"tissue.{i}.energy_weight": weight for i, weight in enumerate(weights)}
        states.append(insert_to(Simulator(PHANTOM.with_values(weighted)), 35.0))
    both, first, second, mixed = (state.strain_energy for state in states)
    assert min(first, second) > 0.005 * both
    assert first + second == pytest.approx(both, rel=1e-12)
    assert 2 * first + 3 * second == pytest.approx(mixed, rel=1e-12)
    assert len({state.energy for state in states}) == 1
    assert len({state.nodes.tobytes() for state in states}) == 1
    assert states[0].energy > both


@pytest.mark.parametrize("alpha", [-47.0, -38.0, 80.0])
@pytest.mark.parametrize("modulus_kpa", [2.0, 100.0])
def test_steep_laws_converge(alpha, modulus_kpa):
    """A full Newton step would pass the floor stretch and cycle."""
    layer = {"alpha": alpha, "shear_modulus_kpa": modulus_kpa}
    steep = {f"tissue.{i}.{key}": value for i in (0, 1) for key, value in layer.items()}
    simulator = Simulator(PHANTOM.with_values({"needle.bevel.offset_mm": 13.0, **steep}))
    rows = controls(1, 70, db_x=1.0)
    rows[0, 31:, DG_Y], rows[0, 45, ROLL] = 0.2, math.pi
    result = simulator.rollout(simulator.start(), rows)
    assert result.converged.all()
    assert np.isfinite(result.tips).all()
