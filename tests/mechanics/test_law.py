"""The laws of the tissue: Ogden's equation 1, each law as derivatives of its energy, and the tables of the kernels."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.mechanics import law as laws
from flexneedle.mechanics.law import CELLS, PER_UNIT, ROWS, Response, tables
from flexneedle.scenario.tissue.laws import LAWS
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.scenario.tissue.linear import Linear
from flexneedle.scenario.tissue.ogden import Ogden
from reference.interpreted import interpreted

PLAIN = interpreted(laws)
MU, ALPHA, HEIGHT, WIDTH = 1.82e-3, 8.74, 20.0, 5.2  # the phantom's first layer
SIZE = {"shear_modulus_kpa": 1e3 * MU, "compression_length_mm": HEIGHT, "engaged_width_mm": WIDTH}
LIMIT = Ogden.limit

alphas = st.one_of(st.floats(0.05, 30.0), st.floats(-30.0, -0.05))
OWN = {
    "ogden": st.builds(dict, alpha=alphas),
    "linear": st.just({}),
    "tearing": st.builds(dict, alpha=alphas, yield_mm=st.floats(0.3, 1.0)),
}
"""Parameters of each law besides its stiffness and size."""
layers = st.sampled_from(sorted(LAWS)).flatmap(
    lambda name: OWN[name].map(lambda own: LAWS[name](law=name, **own, **SIZE))
)
compressions = st.floats(1e-9, LIMIT * (1 - 1e-9))


def layer(alpha=ALPHA):
    """Return a layer of Ogden tissue."""
    return Ogden(alpha=alpha, **SIZE)


def of(law, e):
    """Return energy, force and stiffness of a law at one relative compression."""
    return tuple(float(each(np.array([e]))[0]) for each in (law.energy, law.force, law.stiffness))


def response(table, e):
    """Return the response of a table at e, its sharpness by e."""
    cells = table[CELLS, PER_UNIT]
    found = PLAIN.response(table, 0.0, e * cells)
    return Response(found.secant, found.tangent, found.sharpness * cells)


def stored_energy(table, e):
    """Return the energy of a table at e."""
    cells = table[CELLS, PER_UNIT]
    return PLAIN.stored_energy(table, 0.0, e * cells) / cells**2


def tabled(law, e):
    """Return the same values of its table."""
    table = tables([law])[0]
    secant, tangent, _ = response(table, e)
    return stored_energy(table, e), secant * e, tangent


def energy_written_out(alpha, e):
    """Return equation 1 unchanged, per volume."""
    stretch = 1 - e
    return 2 * MU / alpha**2 * (2 * stretch ** (-alpha / 2) + stretch**alpha - 3)


# ---- the laws


def test_all_laws_are_tested():
    assert set(OWN) == set(LAWS)


@pytest.mark.parametrize("alpha", [-100.0, -20.0, -2.0, 1.0, ALPHA, 30.0, 100.0])
@pytest.mark.parametrize("e", [0.1, 0.45, LIMIT])
def test_energy_is_equation_1(alpha, e):
    """No factor lost between the equation and its scaled form: k h² = 3μ w h, and w h is the volume of 1 mm."""
    assert 3 * MU * of(layer(alpha), e)[0] == pytest.approx(energy_written_out(alpha, e), rel=1e-9)


@pytest.mark.parametrize(
    ("stretch", "stress_kpa"), [(0.9, -0.549), (0.8, -1.306), (0.7, -2.80), (0.5, -17.2)]
)
def test_force_is_the_nominal_stress(stretch, stress_kpa):
    """Nominal stress (2μ/α)(λ^(α−1) − λ^(−α/2−1)) of layer 1 in kPa; of the law and of its table."""
    law, e = layer(), 1 - stretch
    assert -3 * MU * of(law, e)[1] == pytest.approx(1e-3 * stress_kpa, rel=2e-3)
    assert -3 * MU * tabled(law, e)[1] == pytest.approx(1e-3 * stress_kpa, rel=2e-3)


@settings(max_examples=30)
@given(law=layers)
def test_every_law_has_the_stiffness_1_at_no_compression(law):
    """Energy e²/2, force e: the modulus of a layer is the modulus of its law."""
    assert of(law, 0.0) == pytest.approx((0.0, 0.0, 1.0), abs=1e-12)
    energy, force, _ = of(law, 1e-6)
    assert force == pytest.approx(1e-6, rel=1e-4)
    assert energy == pytest.approx(0.5e-12, rel=1e-4)
    assert law.modulus == 3 * law.shear_modulus


@settings(max_examples=100)
@given(law=layers, e=st.floats(1e-3, LIMIT - 1e-4))
def test_force_and_stiffness_are_derivatives_of_the_energy(law, e):
    """Central differences, which lose the 1e-16 of each value over 2h."""
    h = 1e-5
    (w1, f1, _), (w2, f2, _), (energy, force, stiffness) = (of(law, x) for x in (e - h, e + h, e))
    assert force == pytest.approx((w2 - w1) / (2 * h), rel=1e-6, abs=1e-15 * energy / h)
    assert stiffness == pytest.approx((f2 - f1) / (2 * h), rel=1e-6, abs=1e-15 * force / h)


@settings(max_examples=100)
@given(law=layers, e=compressions)
def test_a_law_is_convex_and_finite(law, e):
    """Stiffness, force and energy are positive and finite at any compression."""
    values = of(law, e)
    assert min(values) > 0.0
    assert all(map(math.isfinite, values))


# ---- their tables


@settings(max_examples=100)
@given(law=layers, e=compressions)
def test_a_table_is_its_law(law, e):
    """Force and energy to 1e-9. The stiffness, which only guides a solve, to 1e-8, and 1e-7 for α < −18."""
    rough = getattr(law, "alpha", 0.0) < -18.0
    energy, force, stiffness = tabled(law, e)
    expected = of(law, e)
    assert energy == pytest.approx(expected[0], rel=1e-9)
    assert force == pytest.approx(expected[1], rel=1e-9)
    assert stiffness == pytest.approx(expected[2], rel=1e-7 if rough else 1e-8)


@pytest.mark.parametrize(
    ("alpha", "force", "stiffness"),
    [(-100.0, 1e-6, 2e-5), (-60.0, 5e-8, 2e-6), (60.0, 1.1e-9, 7e-8), (100.0, 2e-8, 7e-7)],
)
def test_the_steepest_tables_are_near_their_laws(alpha, force, stiffness):
    """The worst of the whole range of α; energies are integrals of the force, and nearer."""
    law, e = layer(alpha), np.linspace(1e-3, LIMIT * (1 - 1e-12), 2000)
    table = tables([law])[0]
    found = np.array([response(table, each) for each in e])
    np.testing.assert_allclose(found[:, 0] * e, law.force(e), rtol=force)
    np.testing.assert_allclose(found[:, 1], law.stiffness(e), rtol=stiffness)
    expected = [energy_written_out(alpha, each) / (3 * MU) for each in e]
    np.testing.assert_allclose([stored_energy(table, each) for each in e], expected, rtol=force)


def test_a_table_of_the_linear_law_is_exact():
    law = Linear(law="linear", **SIZE)
    for e in (1e-9, 0.3, LIMIT, 1.4):
        assert tabled(law, e) == pytest.approx((0.5 * e**2, e, 1.0), rel=1e-14)
        secant, tangent, sharpness = response(tables([law])[0], e)
        assert (secant, tangent) == (pytest.approx(1.0, rel=1e-14), pytest.approx(1.0, rel=1e-12))
        assert sharpness == pytest.approx(0.0, abs=1e-9) or e >= LIMIT


@settings(max_examples=100)
@given(law=layers, cell=st.integers(1, CELLS))
def test_a_table_is_continuous_from_cell_to_cell_and_at_its_limit(law, cell):
    """Energy and force to rounding, the stiffness to its accuracy."""
    edge = law.limit / CELLS * cell
    below, above = (tabled(law, edge * (1 + side * 1e-13)) for side in (-1, 1))
    np.testing.assert_allclose(below[:2], above[:2], rtol=5e-11)
    np.testing.assert_allclose(below[2], above[2], rtol=2e-7)


@settings(max_examples=100)
@given(law=layers, e=st.floats(1e-6, 1.5))
def test_force_and_stiffness_of_a_table_are_derivatives_of_its_energy(law, e):
    """Exactly its own, beyond the limit too, so that a line search and Newton's method agree."""
    h, table = 1e-6 * e, tables([law])[0]
    (w1, f1, _), (w2, f2, _), (_, force, stiffness) = (tabled(law, x) for x in (e - h, e + h, e))
    assert force == pytest.approx((w2 - w1) / (2 * h), rel=2e-7)
    if not abs(e % (law.limit / CELLS)) < 2 * h or e > law.limit:
        assert stiffness == pytest.approx((f2 - f1) / (2 * h), rel=1e-6)
    assert table.shape == (CELLS + 1, 8)


@settings(max_examples=100)
@given(law=layers, beyond=st.floats(0.0, 3.0))
def test_beyond_its_limit_a_table_continues_linearly(law, beyond):
    """Stiffness of the limit, force on its tangent, energy the integral of that; no Newton step is trusted there."""
    _, force, stiffness = of(law, law.limit)
    found = tabled(law, law.limit + beyond)
    assert found[2] == stiffness
    assert found[1] == pytest.approx(force + stiffness * beyond, rel=1e-12)
    expected = tabled(law, law.limit)[0] + force * beyond + 0.5 * stiffness * beyond**2
    assert found[0] == pytest.approx(expected, rel=1e-12)
    assert response(tables([law])[0], law.limit + beyond).sharpness == math.inf


@settings(max_examples=100)
@given(law=layers, e=st.floats(1e-3, LIMIT - 1e-3))
def test_the_sharpness_bounds_the_change_of_the_stiffness(law, e):
    """|w‴|/w″ by central differences; the table has the mean of a cell, a hundredth less at a minimum."""
    h = 1e-5
    third = abs(of(law, e + h)[2] - of(law, e - h)[2]) / (2 * h)
    bound = response(tables([law])[0], e).sharpness
    assert third / of(law, e)[2] <= 1.02 * bound + 1e-5


def test_layers_of_one_law_share_a_table():
    """Whatever their stiffness and size; by type and own parameters."""
    wide = Ogden(alpha=8.74, **{**SIZE, "engaged_width_mm": 1.0, "shear_modulus_kpa": 9.0})
    tissue = [layer(8.74), Linear(law="linear", **SIZE), layer(-3.0), wide, layer(-3.0)]
    laws, place = laws_of(tissue)
    assert place == [0, 1, 2, 0, 2]
    assert len(laws) == 3
    together = tables(laws)
    rows = together.reshape(-1, 8)
    for each, k in zip(tissue, place, strict=True):
        table = tables([each])[0]
        np.testing.assert_array_equal(together[k], table)
        for e in (0.2, 0.95):
            cells = e * table[CELLS, PER_UNIT]
            assert PLAIN.response(rows, float(k * ROWS), cells) == PLAIN.response(table, 0.0, cells)
            assert PLAIN.stored_energy(rows, float(k * ROWS), cells) == PLAIN.stored_energy(table, 0.0, cells)
