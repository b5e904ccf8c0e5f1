"""E₁, the energy of all tissue down to a depth displaced by 1 mm."""

import pytest

from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.tissue.linear import Linear

PHANTOM = load_scenario("phantom")


def test_the_energy_scale_is_of_all_tissue_above_a_depth_displaced_by_a_millimetre():
    """20 mm of the first layer and 10.4 of the second, the density of each from the law; weighted by layer."""
    phantom = PHANTOM.with_values({"tissue.1.energy_weight": 3.0})
    stretch = 1.0 - 1.0 / 20.0
    strain = 2.0 * stretch ** (-8.74 / 2.0) + stretch**8.74 - 3.0
    density = [2.0 * 1e-3 * kpa * 5.2 * 20.0 / 8.74**2 * strain for kpa in (1.82, 3.63)]
    expected = 20.0 * density[0] + 3.0 * 10.4 * density[1]
    assert phantom.energy_scale(30.4) == pytest.approx(expected, rel=1e-12)
    assert phantom.energy_scale(7.3) == pytest.approx(7.3 * density[0], rel=1e-12)
    assert phantom.energy_scale(-3.0) == 0.0


def test_doubling_all_moduli_doubles_the_energy_scale():
    """E₁ is a unit of the tissue's stiffness."""
    moduli = {
        f"tissue.{k}.shear_modulus_kpa": 2.0 * layer.shear_modulus_kpa
        for k, layer in enumerate(PHANTOM.tissue)
    }
    assert PHANTOM.with_values(moduli).energy_scale(33.0) == pytest.approx(
        2.0 * PHANTOM.energy_scale(33.0), rel=1e-14
    )


def test_beyond_the_limit_of_a_law_the_force_continues_linearly():
    """A millimetre in 0.8 mm of tissue; the energy of the linear law is ½ k u² at any displacement."""
    layer = Linear(law="linear", shear_modulus_kpa=2.0, compression_length_mm=0.8, engaged_width_mm=5.0)
    for displacement in (0.3, 1.0):
        expected = 0.5 * (3.0 * 2e-3 * 5.0 / 0.8) * displacement**2
        assert layer.energy_per_mm(displacement) == pytest.approx(expected, rel=1e-12)
