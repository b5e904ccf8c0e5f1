"""The needle as a beam: closed forms, with the order in which the contact spacing approaches them."""

import numpy as np
import pytest

from flexneedle import Control, Simulator, load_scenario
from flexneedle.types import THETA, Y
from reference import closed_forms as exact
from reference.cases import EI, FOUNDATION, LENGTH_MM, long_beam, repeat, tight

PHANTOM = load_scenario("phantom")


def orders(errors):
    """Observed order between halvings."""
    errors = np.abs(errors)
    return np.log2(errors[:-1] / errors[1:])


def free_needle(**changes):
    """The phantom's needle without guide, in air."""
    return tight(PHANTOM.with_values({"setup.guide_to_skin_mm": None, **changes}), slide=1e-13)


@pytest.mark.parametrize("load", [1e-6, -0.02])
def test_cantilever_with_an_end_load_is_exact_to_rounding(load):
    """In every node, over the length that the shortening leaves."""
    simulator = free_needle()
    state = simulator.step(simulator.start().with_estimate(tip_load=(load, 0.0)), Control())
    stiffness = simulator.scenario.needle.bending_stiffness
    x, length = state.nodes[:, 0] - state.base[0], state.tip[0] - state.base[0]
    np.testing.assert_allclose(
        state.nodes[:, 1], exact.cantilever(x, load, stiffness, length), rtol=1e-12, atol=1e-15 * length
    )
    assert state.tip[1] == pytest.approx(load * length**3 / (3 * stiffness), rel=1e-13)
    assert state.tip[THETA] == pytest.approx(load * length**2 / (2 * stiffness), rel=1e-13)
    assert state.energy == pytest.approx(load * state.tip[1] / 2, rel=1e-12)
    assert state.reactions.base_force[0] == pytest.approx(-load, rel=1e-12)
    assert state.reactions.base_moment[0] == pytest.approx(-load * length, rel=1e-12)
    short = load**2 * length**5 / (15 * stiffness**2)  # equation 5: ½∫y'²
    assert simulator.scenario.needle.length_mm - length == pytest.approx(short, rel=1e-3, abs=1e-11)


def test_needle_in_air_follows_base_and_guide():
    """Clamp, guide and a straight free end."""
    simulator = Simulator(PHANTOM)
    control = Control(db_x=0.1, db_y=0.2, db_theta=-2e-3, dg_y=0.4)
    state = repeat(simulator, simulator.start(), control, 10)[-1]
    arm, overhang = -41.0 - state.base[0], state.tip[0] + 41.0
    y, turn, force = exact.guided_tip(2.0, -0.02, 4.0, arm, overhang, PHANTOM.needle.bending_stiffness)
    np.testing.assert_allclose(state.tip[[Y, THETA]], [y, turn], rtol=1e-12)
    assert state.reactions.guide_force[0] == pytest.approx(force, rel=1e-12)
    assert state.contacts.x.size == 0
    assert state.strain_energy == 0.0


def test_endless_beam_on_springs_converges_at_fourth_order():
    """A needle held at a lateral offset in the middle of 40/β of tissue: shape, and the load that the springs take."""
    depth, y0, beta = 400.0, 1e-3, 1 / LENGTH_MM
    shape, load = [], []
    for spacing in (8.0, 4.0, 2.0, 1.0):
        simulator = Simulator(long_beam(depth, spacing=spacing))
        state = simulator.step(simulator.start(), Control(db_x=depth + 1.0))
        contacts = simulator.assimilate(state, (depth, 0.0), [(depth / 2, y0)]).state.contacts
        y = exact.endless_beam(contacts.x - depth / 2, y0, beta)
        shape.append(np.abs(contacts.position[:, 0] - y).max() / y0)
        load.append(FOUNDATION * spacing * contacts.position[:, 0].sum() / (2 * FOUNDATION * y0 / beta) - 1)
    np.testing.assert_allclose(orders(shape), 4.0, atol=0.1)
    np.testing.assert_allclose(orders(load), 4.0, atol=0.25)
    assert shape[-1] < 1.2e-6
    assert abs(load[-1]) < 1.6e-6


def loaded_free_end(depth, spacing):
    """Relative errors of y, θ and energy at the loaded end of a half-endless needle."""
    beta, load = 1 / LENGTH_MM, 1e-3 * FOUNDATION * LENGTH_MM / 2
    simulator = Simulator(long_beam(depth, spacing=spacing))
    state = simulator.step(simulator.start(), Control(db_x=depth + 1.0))
    state = simulator.step(state.with_estimate(tip_load=(load, 0.0)), Control())
    y = exact.free_end(0.0, load, FOUNDATION, beta)
    turn = exact.free_end_slope(load, FOUNDATION, beta)
    return np.array([state.tip[1] / y, state.tip[THETA] / turn, state.energy / (load * y / 2)]) - 1


def test_loaded_free_end_converges_at_second_order():
    """The tip at the end of an interval, where all the tissue behind it acts."""
    errors = np.array([loaded_free_end(160.0, spacing) for spacing in (4.0, 2.0, 1.0, 0.5)])
    np.testing.assert_allclose(orders(errors), 2.0, atol=0.06)
    assert np.abs(errors[-1]).max() < 7e-4


def test_the_long_beam_has_the_constants_in_the_closed_forms():
    """EI and k₀ of the helper agree with its scenario."""
    scenario = long_beam(20.0, spacing=1.0)
    layer = scenario.tissue[0]
    foundation = 3 * layer.shear_modulus * layer.engaged_width_mm / layer.compression_length_mm
    assert scenario.needle.bending_stiffness == pytest.approx(EI, rel=1e-14)
    assert foundation == pytest.approx(FOUNDATION, rel=1e-14)
    assert exact.characteristic(FOUNDATION, EI) == pytest.approx(1 / LENGTH_MM, rel=1e-14)
