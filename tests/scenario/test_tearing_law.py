"""Tissue that tears in a scenario: its channel as in a phantom that tears, its bevel as in intact tissue."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import flexneedle
from flexneedle.errors import ScenarioError
from flexneedle.mechanics.law import tables
from flexneedle.mechanics.model import CONTACT
from flexneedle.phantom.tearing import tear
from flexneedle.simulator.excess import LoadLimits
from flexneedle.simulator.simulator import Simulator
from mechanics.test_law import tabled
from phantoms import AHEAD, both_plants, driven, make_phantom
from reference.rods import IDEAL

INTACT = flexneedle.load_scenario("gel")
PHANTOM = flexneedle.load_scenario("phantom")
YIELD = 0.4
QUICK = {"plan.samples": 16, "plan.iterations": 2, "plan.max_iterations": 2, "phantom.element_mm": 5.0}


def tearing(scenario, yield_mm=YIELD, where=(0, 1)):
    """The scenario with these layers tearing."""
    torn = {"law": "tearing", "yield_mm": yield_mm}
    tissue = [layer.model_dump() | (torn if k in where else {}) for k, layer in enumerate(scenario.tissue)]
    return scenario.with_values({"tissue": tissue})


def guided(simulator, *moves):
    """Return tips with the guide moved at a depth of 15 mm and 2 mm of advance after each move."""
    rows = np.zeros((25 + 2 * len(moves), 9))
    rows[:, flexneedle.DB_X] = 1.0
    rows[25::2, flexneedle.DG_Y] = moves
    return simulator.replay(simulator.start(), rows)[1]


def rested(simulator, *moves):
    """Return tips at a depth of 40 mm, where the guide moves at rest."""
    state = simulator.advance_to(simulator.start(), 40.0)
    rows = np.zeros((len(moves), 9))
    rows[:, flexneedle.DG_Y] = moves
    return state.tip, simulator.replay(state, rows)[1]


def test_the_model_is_the_one_of_a_phantom_that_tears():
    expected = Simulator(INTACT).with_model(tear(Simulator(INTACT).model, INTACT.tissue, YIELD))
    np.testing.assert_array_equal(guided(Simulator(tearing(INTACT)), 3.0), guided(expected, 3.0))


@both_plants
def test_a_phantom_of_tissue_that_tears_is_the_one_of_the_structure_that_tears(kind):
    tips = [
        driven(phantom, AHEAD, times=50).condition().tip
        for phantom in (make_phantom(tearing(IDEAL), kind), make_phantom(IDEAL, kind, yield_mm=YIELD))
    ]
    np.testing.assert_array_equal(tips[0], tips[1])


def test_tissue_that_tears_holds_the_needle_less():
    intact, torn = guided(Simulator(INTACT), 3.0), guided(Simulator(tearing(INTACT)), 3.0)
    assert abs(torn[-1, 1] - intact[-1, 1]) > 0.02
    never = guided(Simulator(tearing(INTACT, 13.0)), 3.0)
    np.testing.assert_allclose(never, intact, atol=1e-6)


@pytest.mark.parametrize("yield_mm", [14.0, 1e3])
def test_a_displacement_beyond_the_law_of_the_tissue_has_no_effect(yield_mm):
    """The table of the channel ends where the intact one does."""
    torn, intact = tables([tearing(INTACT, yield_mm).tissue[0].channel]), tables([INTACT.tissue[0]])
    np.testing.assert_allclose(torn, intact, rtol=1e-12)


@given(share=st.floats(0.0, 4.0), yield_mm=st.floats(0.3, 1.0))
def test_energy_and_force_beyond_the_yield_are_the_closed_form(share, yield_mm):
    """w = w₀ + f₀ d + ½ r d² + (k₀′ − r) a (d − a (1 − e^(−d/a))), with d = e − e₀, a = e₀/2, r = k₀′/50."""
    layer = tearing(INTACT, yield_mm).tissue[0]
    e0 = yield_mm / layer.compression_length_mm
    w0, f0, k0 = (float(each(np.array([e0]))[0]) for each in (layer.energy, layer.force, layer.stiffness))
    a, r, d = 0.5 * e0, k0 / 50.0, share * e0
    saturated = (k0 - r) * a * (1.0 - np.exp(-d / a))
    energy = w0 + f0 * d + 0.5 * r * d**2 + (k0 - r) * a * d - a * saturated
    assert tabled(layer.channel, e0 + d)[:2] == pytest.approx((energy, f0 + r * d + saturated), rel=1e-4)


@pytest.mark.parametrize("axes", [1, 2])
def test_the_channel_keeps_no_memory_of_a_displacement(axes):
    """Torn at rest by the guide, and back: nothing was cut, so the needle is where it was."""
    simulator = Simulator(tearing(INTACT).with_values({"setup.axes": axes}))
    before, after = rested(simulator, 4.0, -8.0, 4.0)
    np.testing.assert_allclose(after[-1], before, atol=1e-6)
    assert abs(after[0, 1] - before[1]) > 1e-3
    torn = simulator.advance_to(simulator.start(), 40.0)
    back = simulator.advance_to(simulator.advance_to(torn, 20.0), 40.0)
    np.testing.assert_allclose(back.tip, torn.tip, atol=1e-5)


def test_only_the_layers_that_tear_do():
    simulator, intact = Simulator(tearing(PHANTOM, where=(1,))), Simulator(PHANTOM)
    nodes, layers = simulator.model.nodes, simulator.model.layers
    contact, below = nodes["kind"] == CONTACT, nodes["x"] > layers["end"][0]
    assert (nodes["law"][contact & ~below] == layers["law"][0]).all()
    assert (nodes["law"][contact & below] == layers["channel"][1]).all()
    assert layers["channel"].tolist() == [layers["law"][0], len(simulator.model.laws) - 1]
    np.testing.assert_array_equal(guided(simulator)[:28], guided(intact)[:28])


def test_the_guard_allows_the_compression_of_intact_tissue():
    scenario = tearing(PHANTOM, where=(1,))
    limits = LoadLimits.of(scenario)
    assert limits.values == LoadLimits.of(PHANTOM).values
    state = Simulator(scenario).advance_to(Simulator(scenario).start(), 40.0)
    tissue = next(limits.excesses(state))
    assert tissue.share == pytest.approx((1.0 - state.least_stretch) / 0.665)


def test_an_adapted_channel_still_tears():
    simulator = Simulator(tearing(INTACT))
    same = flexneedle.Adaptation(shift=np.zeros(0), stiffness=np.array([1.0 + 1e-12]))
    adapted = simulator.adapt(same)
    contact = adapted.nodes["kind"] == CONTACT
    assert (adapted.nodes["law"][contact] == adapted.layers["channel"][0]).all()
    assert (adapted.layers["law"] != adapted.layers["channel"]).all()
    np.testing.assert_allclose(guided(simulator.with_model(adapted), 3.0), guided(simulator, 3.0), atol=1e-9)


def test_the_energy_of_displaced_tissue_is_the_torn_one():
    intact, torn = INTACT.tissue[0], tearing(INTACT).tissue[0]
    assert torn.energy_per_mm(0.5 * YIELD) == pytest.approx(intact.energy_per_mm(0.5 * YIELD), rel=1e-12)
    assert torn.energy_per_mm(4.0 * YIELD) < 0.7 * intact.energy_per_mm(4.0 * YIELD)


@pytest.mark.parametrize("name", ["phantom", "phantom3d"])
def test_a_needle_is_planned_and_steered_in_tissue_that_tears_through_a_loose_guide(name):
    scenario = tearing(flexneedle.load_scenario(name)).with_values(QUICK | {"setup.guide_clearance_mm": 0.05})
    insertion = flexneedle.insert(scenario, flexneedle.plan(scenario, seed=0), seed=3)
    assert insertion.true_error_mm < 0.3


def test_the_displacement_has_to_be_given():
    layer = INTACT.tissue[0].model_dump() | {"law": "tearing"}
    with pytest.raises(ScenarioError, match=r"tissue\[0\]\.yield_mm"):
        INTACT.with_values({"tissue": [layer]})
