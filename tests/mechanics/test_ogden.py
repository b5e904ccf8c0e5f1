"""The tissue law: stress values, and force and stiffness as derivatives of the energy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.mechanics.ogden import FLOOR_STRETCH, contact_law, displaced_energy, law_scales
from reference.insertion import Tissue, ogden

MU, ALPHA, HEIGHT, WIDTH = 1.82e-3, 8.74, 20.0, 5.2  # the phantom's first layer
alphas = st.one_of(st.floats(0.05, 30.0), st.floats(-30.0, -0.05))


def law(u, alpha=ALPHA, height=HEIGHT, volume=WIDTH * HEIGHT, mu=MU):
    """Force, stiffness, energy of a point at compression u."""
    return contact_law(alpha, height, *map(float, law_scales(mu, alpha, height, volume)), u)


def energy_written_out(u):
    """Equation 1 unchanged, above the floor."""
    stretch = 1 - abs(u) / HEIGHT
    volume = WIDTH * HEIGHT
    return volume * 2 * MU / ALPHA**2 * (2 * stretch ** (-ALPHA / 2) + stretch**ALPHA - 3)


@pytest.mark.parametrize(
    ("stretch", "stress_kpa"), [(0.9, -0.549), (0.8, -1.306), (0.7, -2.80), (0.5, -17.2)]
)
def test_force_is_the_nominal_stress_times_the_area(stretch, stress_kpa):
    """Nominal stress (2μ/α)(λ^(α−1) − λ^(−α/2−1)) of layer 1 in kPa, times 1 mm × w."""
    force = law(HEIGHT * (1 - stretch))[0]
    assert force == pytest.approx(1e-3 * stress_kpa * WIDTH, rel=2e-3)


@pytest.mark.parametrize("u", [1e-3, 0.5, 3.0, 9.0, 13.9])
def test_energy_is_equation_1(u):
    """No factor lost between the equation and its rearrangement."""
    assert law(u)[2] == pytest.approx(energy_written_out(u), rel=1e-9)


def test_small_strain_stiffness_is_3_mu_w_over_h():
    """Vesic's foundation modulus for a millimetre of needle."""
    assert law(0.0)[1] == pytest.approx(3 * MU * WIDTH / HEIGHT, rel=1e-12)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(alpha=alphas, stretch=st.floats(0.02, 0.999), side=st.sampled_from([-1.0, 1.0]))
def test_force_and_stiffness_are_derivatives_of_the_energy(alpha, stretch, side):
    """Central differences, on both sides of the floor stretch and for negative α."""
    h = 1e-5
    if abs(stretch - FLOOR_STRETCH) < 1e-4:
        stretch = FLOOR_STRETCH + 1e-3
    u = side * HEIGHT * (1 - stretch)
    (f1, _, w1), (f2, _, w2), (force, stiffness, energy) = (law(x, alpha) for x in (u - h, u + h, u))
    noise = 1e-15 * energy / h + 1e-15 * MU * WIDTH * HEIGHT / (alpha**2 * h)
    assert force == pytest.approx(-(w2 - w1) / (2 * h), rel=1e-6, abs=10 * noise)
    assert stiffness == pytest.approx(-(f2 - f1) / (2 * h), rel=1e-6, abs=1e-10)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(alpha=alphas, u=st.floats(0.0, 60.0))
def test_law_is_convex_odd_in_force_and_finite(alpha, u):
    """Stiffness positive wherever a point may be, force against the displacement, energy not negative."""
    force, stiffness, energy = law(u, alpha)
    assert stiffness > 0.0
    assert energy >= -1e-15
    assert force <= 0.0
    assert law(-u, alpha) == (-force, stiffness, energy)
    assert all(map(math.isfinite, (force, stiffness, energy)))


@settings(deadline=None, derandomize=True, max_examples=100)
@given(alpha=alphas, u=st.floats(-40.0, 40.0))
def test_law_is_that_of_the_reference(alpha, u):
    """Above and below the floor stretch of 0.3, written out there as in equations 1 to 3."""
    point = Tissue(*(np.array([value]) for value in (MU, alpha, HEIGHT, WIDTH * HEIGHT)))
    energy, force, stiffness = (float(values[0]) for values in ogden(point, np.array([u])))
    size = MU * WIDTH * HEIGHT / alpha**2
    assert law(u, alpha)[0] == pytest.approx(force, rel=1e-9, abs=1e-14 * size)
    assert law(u, alpha)[1] == pytest.approx(stiffness, rel=1e-9)
    assert law(u, alpha)[2] == pytest.approx(energy, rel=1e-9, abs=1e-14 * size)


@pytest.mark.parametrize("alpha", [-20.0, -2.0, 1.0, 8.74, 30.0])
def test_floor_is_once_differentiable(alpha):
    """Energy, force and stiffness meet at the floor stretch, below it the stiffness is constant."""
    edge = HEIGHT * (1 - FLOOR_STRETCH)
    above, below = law(edge - 1e-9, alpha), law(edge + 1e-9, alpha)
    np.testing.assert_allclose(above, below, rtol=1e-7)
    assert law(edge + 5.0, alpha)[1] == law(edge + 1.0, alpha)[1]
    assert law(edge + 5.0, alpha)[0] == pytest.approx(law(edge, alpha)[0] - 5.0 * law(edge + 1.0, alpha)[1])


@pytest.mark.parametrize("u", [0.0, -1.0, 13.9])
def test_displaced_energy_is_that_of_the_law(u):
    scale = law_scales(MU, np.array([ALPHA, -3.0]), np.array([HEIGHT, 25.0]), WIDTH * HEIGHT)[1]
    expected = [law(u)[2], law(u, -3.0, 25.0)[2]]
    stored = displaced_energy(np.array([ALPHA, -3.0]), np.array([HEIGHT, 25.0]), scale, u)
    np.testing.assert_allclose(stored, expected, rtol=1e-9, atol=1e-18)
