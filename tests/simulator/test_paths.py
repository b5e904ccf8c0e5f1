"""The path as a continuous function of the commands: small steps, retraction, entry and exit, mirror images."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle import Control, Simulator, controls, load_scenario
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
