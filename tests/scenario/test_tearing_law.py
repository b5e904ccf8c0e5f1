"""The law of tissue that tears, in scenarios: that of the phantom's torn channels, with the bevel in intact tissue."""

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import ScenarioError
from flexneedle.mechanics.model import CONTACT
from flexneedle.phantom.tearing import tear
from flexneedle.simulator.simulator import Simulator

INTACT = flexneedle.load_scenario("gel")
YIELD = 0.4


def tearing(yield_mm):
    layer = INTACT.tissue[0].model_dump() | {"law": "tearing", "yield_mm": yield_mm}
    return INTACT.with_values({"tissue": [layer]})


def guided(simulator):
    """Return tips with the guide moved by 3 mm at a depth of 15 mm."""
    rows = np.zeros((60, 9))
    rows[:, flexneedle.DB_X] = 1.0
    rows[25, flexneedle.DG_Y] = 3.0
    return simulator.replay(simulator.start(), rows)[1]


def test_the_model_is_the_one_of_a_phantom_that_tears():
    expected = Simulator(INTACT).with_model(tear(Simulator(INTACT).model, INTACT.tissue, YIELD))
    np.testing.assert_array_equal(guided(Simulator(tearing(YIELD))), guided(expected))


def test_tissue_that_tears_holds_the_needle_less():
    intact, torn = guided(Simulator(INTACT)), guided(Simulator(tearing(YIELD)))
    assert abs(torn[-1, 1] - intact[-1, 1]) > 0.1
    never = guided(Simulator(tearing(13.0)))
    np.testing.assert_allclose(never, intact, atol=1e-6)


def test_an_adapted_channel_still_tears():
    simulator = Simulator(tearing(YIELD))
    same = flexneedle.Adaptation(shift=np.zeros(0), stiffness=np.array([1.0 + 1e-12]))
    adapted = simulator.adapt(same)
    contact = adapted.nodes["kind"] == CONTACT
    assert (adapted.nodes["law"][contact] == adapted.layers["channel"][0]).all()
    assert (adapted.layers["law"] != adapted.layers["channel"]).all()
    np.testing.assert_allclose(guided(simulator.with_model(adapted)), guided(simulator), atol=1e-9)


def test_the_energy_of_displaced_tissue_is_the_torn_one():
    intact, torn = INTACT.tissue[0], tearing(YIELD).tissue[0]
    assert torn.energy_per_mm(0.5 * YIELD) == pytest.approx(intact.energy_per_mm(0.5 * YIELD), rel=1e-12)
    assert torn.energy_per_mm(4.0 * YIELD) < 0.7 * intact.energy_per_mm(4.0 * YIELD)


def test_the_displacement_has_to_be_given():
    layer = INTACT.tissue[0].model_dump() | {"law": "tearing"}
    with pytest.raises(ScenarioError, match=r"tissue\[0\]\.yield_mm"):
        INTACT.with_values({"tissue": [layer]})
