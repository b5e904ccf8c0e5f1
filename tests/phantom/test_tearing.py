"""Tissue that tears: a law that saturates, in the channel alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.mechanics.law import tables
from flexneedle.mechanics.model import CONTACT
from flexneedle.scenario.tissue.laws import LAWS
from flexneedle.scenario.tissue.torn import TornLaw
from flexneedle.simulator.simulator import Simulator
from mechanics.test_law import SIZE, of, tabled
from phantoms import AHEAD, STRAIGHT, both_plants, driven, make_phantom
from reference.rods import IDEAL

HEIGHT = SIZE["compression_length_mm"]
OWN = {"ogden": {"alpha": 8.74}, "linear": {}}
laws = st.builds(
    lambda name, start: TornLaw(LAWS[name](law=name, **OWN[name], **SIZE), start / HEIGHT),
    st.sampled_from(sorted(OWN)),
    st.floats(0.3, 1.0),
)
shares = st.floats(1e-3, 6.0)
"""Displacements in units of the one from which the tissue tears."""


@given(law=laws, share=shares)
def test_force_is_the_derivative_of_the_energy_and_stiffness_of_the_force(law, share):
    e, step = share * law.start, 1e-4 * law.start
    low, _, high = (of(law, e + d) for d in (-step, 0.0, step))
    energy, force, stiffness = of(law, e)
    assert (high[0] - low[0]) / (2.0 * step) == pytest.approx(force, rel=1e-4)
    assert (high[1] - low[1]) / (2.0 * step) == pytest.approx(stiffness, rel=1e-3, abs=1e-5)
    assert energy > 0.0


@given(law=laws, share=st.floats(1e-3, 1.0))
def test_intact_tissue_has_its_own_law(law, share):
    np.testing.assert_allclose(of(law, share * law.start), of(law.layer, share * law.start), rtol=1e-12)


@given(law=laws)
def test_the_force_saturates_at_one_and_a_half_times_the_force_where_tearing_begins(law):
    """Of linear tissue: k u₀ and, over the length u₀/2 of the exponential, 0.98 k u₀/2 more, but for a slope of 2 %."""
    at, torn = of(law, law.start), of(law, 5.0 * law.start)
    assert torn[1] - 0.02 * at[2] * 4.0 * law.start == pytest.approx(
        at[1] + 0.98 * 0.5 * law.start * at[2], rel=1e-3
    )
    assert torn[2] == pytest.approx(0.02 * at[2], rel=0.03)


@given(law=laws, low=shares, high=shares)
def test_the_energy_stays_convex(law, low, high):
    least, most = sorted((low, high))
    assert of(law, most * law.start)[1] >= of(law, least * law.start)[1]
    assert of(law, high * law.start)[2] > 0.0


@given(law=laws, share=shares)
def test_the_table_of_the_kernels_is_the_law(law, share):
    """Beyond its limit the table has the slope there, e^(−8) steeper than what is left."""
    np.testing.assert_allclose(tabled(law, share * law.start)[:2], of(law, share * law.start)[:2], rtol=5e-4)
    assert np.isfinite(tables([law])).all()


@both_plants
def test_torn_tissue_holds_the_needle_with_less_force(kind):
    """The guide bends the needle sideways: at the same guide the tip follows less in tissue that tears."""
    tips, energies = [], []
    for yield_mm in (None, 0.3):
        phantom = driven(make_phantom(IDEAL, kind, yield_mm=yield_mm), AHEAD, times=55)
        assert phantom.condition().converged
        tips.append(phantom.condition().tip)
        energies.append(phantom.condition().strain_energy)
    assert abs(tips[0][1] - tips[1][1]) > 0.05
    assert energies[1] < 0.9 * energies[0]


@both_plants
def test_tissue_that_tears_nowhere_is_intact(kind):
    """To the last digits of the tables."""
    tips = [
        driven(make_phantom(IDEAL, kind, yield_mm=each), AHEAD, times=45).condition().tip
        for each in (None, 13.0)
    ]
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-6)


@both_plants
def test_the_bevel_has_the_intact_law(kind):
    """A tip above the first contact, with an offset of 4 mm, deviates as in intact tissue."""
    wide = {
        "phantom.contact_spacing_mm": 6.0,
        "contact.spacing_mm": 24.0,
    }  # first contacts at a depth of 3 mm
    tips = [
        driven(make_phantom(IDEAL.with_values(wide), kind, yield_mm=each), STRAIGHT, times=31).condition().tip
        for each in (None, 0.3)
    ]
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-9)


def test_only_contacts_tear_in_the_model():
    phantom = make_phantom(IDEAL, "model", yield_mm=0.5)
    model, intact = phantom._plant._simulator.model, Simulator(IDEAL, threads=1).model
    assert (model.layers["law"] == intact.layers["law"]).all()
    assert ((model.nodes["law"] != intact.nodes["law"]) == (model.nodes["kind"] == CONTACT)).all()
    assert len(model.laws) == len(intact.laws) + len(IDEAL.tissue)
