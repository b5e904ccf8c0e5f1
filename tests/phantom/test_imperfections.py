"""Each key of `[phantom]` alone: the size of its effect."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle.errors import CommandError
from flexneedle.phantom.draw import draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.types import PSI, THETA, Y, Z
from phantoms import AHEAD, COARSE, PHANTOM, STRAIGHT, TURN, alone, both_plants, driven, make_phantom, tip
from reference.rods import IDEAL, planar


def free(scenario=IDEAL):
    """Return the scenario without its guide: the needle is held only by its clamp."""
    return scenario.with_values({"setup.guide_to_skin_mm": None})


@both_plants
@pytest.mark.parametrize("seed", range(2))
def test_the_tip_moves_by_the_run_out_when_the_bevel_rolls(kind, seed):
    """0.2 mm, normal to the tip, at once; and back with the next roll."""
    phantom = alone(seed, kind, run_out_mm=0.2)
    here = tip(phantom)
    there = tip(driven(phantom, TURN))
    assert abs(there[1] - here[1]) == pytest.approx(0.2)
    assert abs(here[1]) == pytest.approx(0.1)
    np.testing.assert_allclose(tip(driven(phantom, TURN)), here, atol=1e-9)


@both_plants
def test_factors_of_tissue_bevel_and_needle_equal_a_changed_scenario(kind):
    """1.5 times the modulus of both layers, half the bevel, and a drawn modulus of the needle."""
    factors = {
        "shear_modulus_factor": [1.5, 1.5],
        "bevel_factor": [0.5, 0.5],
        "youngs_modulus_variation": 0.3,
    }
    phantom = alone(0, kind, **factors)
    modulus = phantom._truth.scenario.needle.youngs_modulus_gpa
    assert abs(modulus - 200.0) > 1.0
    values = {f"tissue.{k}.shear_modulus_kpa": 1.5 * (1.82, 3.63)[k] for k in (0, 1)}
    values |= {"contact.spacing_mm": 0.5, "needle.bevel.offset_mm": 2.0, "needle.youngs_modulus_gpa": modulus}
    other = make_phantom(IDEAL.with_values(values), kind)
    ends = [tip(driven(needle, AHEAD, times=35)) for needle in (phantom, other)]
    np.testing.assert_allclose(*ends, atol=1e-9)


@both_plants
def test_start_offset_and_slope_move_the_clamp(kind):
    """The tip of a free needle moves by the offset, and by 150 mm times the slope."""
    rng = np.random.default_rng(0)
    offset = draw(free().with_values({"phantom.start_offset_sd_mm": 0.5}), rng)
    slope = draw(free().with_values({"phantom.start_angle_sd_mrad": 3.0}), rng)
    np.testing.assert_allclose(planar(tip(Phantom(offset, 0.0, kind)))[1:], [offset.base_y, 0.0], atol=1e-9)
    np.testing.assert_allclose(
        planar(tip(Phantom(slope, 0.0, kind)))[1:], [150.0 * slope.base_turn, slope.base_turn], rtol=1e-4
    )
    assert offset.base_y != 0.0 != slope.base_turn


@pytest.mark.parametrize("angle", [0.0, -1.2])
def test_a_bend_is_the_deflection_of_the_free_tip_and_rolls_with_the_needle(angle):
    """The free tip is 0.5 mm off in the direction of the bevel turned by the angle."""
    tips = [tip(make_phantom(free(), roll=roll, bend=0.5, bend_angle=angle)) for roll in (0.0, math.pi)]
    for at, sign in zip(tips, (1.0, -1.0), strict=True):
        expected = sign * 0.5 * np.array([math.cos(angle), math.sin(angle)])
        np.testing.assert_allclose(at[[Y, Z]], expected, rtol=1e-4)
        np.testing.assert_allclose(at[[THETA, PSI]], 2.0 * expected / 150.0, rtol=5e-3)


@both_plants
def test_a_run_out_is_across_the_tilted_tip(kind):
    """Along the bevel's direction of the tip, turned by its angle; in the plane exactly without z."""
    pose = {"base_turn": 0.02, "base_psi": -0.03}
    plain, off = (make_phantom(free(), kind, run_out=size, run_out_angle=0.7, **pose) for size in (0.0, 0.1))
    theta, psi = tip(off)[[THETA, PSI]]
    frame = Rotation.from_rotvec([0.0, -psi, theta]) * Rotation.from_rotvec([0.7, 0.0, 0.0])
    np.testing.assert_allclose((tip(off) - tip(plain))[:3], frame.apply([0.0, 0.1, 0.0]), atol=1e-12)
    for roll in (0.0, math.pi):
        assert tip(make_phantom(IDEAL, kind, roll=roll, run_out=0.1))[Z] == 0.0


@both_plants
def test_a_clamp_out_of_the_plane_moves_the_free_tip_there(kind):
    """By base z, and 150 mm times its slope ψ; also where the controller steers in the plane."""
    here = tip(make_phantom(free(), kind, base_z=0.4, base_psi=-0.002))
    np.testing.assert_allclose(here[[Y, Z]], [0.0, 0.4 - 0.3], atol=1e-5)
    np.testing.assert_allclose(here[[THETA, PSI]], [0.0, -0.002], atol=1e-9)


def test_the_shaft_has_the_torsional_stiffness_of_steel():
    """GJ = E/(2(1 + ν)) πd⁴/32 with ν = 0.3, of a needle of 0.82 mm."""
    needle = IDEAL.needle
    modulus = 1e3 * needle.youngs_modulus_gpa / 2.6
    expected = modulus * math.pi * needle.outer_diameter**4 / 32.0
    assert make_phantom()._plant.rod.torsion == pytest.approx(expected, rel=1e-12)


@both_plants
def test_a_true_load_deflects_the_free_tip(kind):
    """Pl³/3EI in both axes."""
    load = np.array([2e-4, -3e-4])
    here = tip(make_phantom(free(), kind, load=tuple(load)))
    expected = load * 150.0**3 / (3.0 * IDEAL.needle.bending_stiffness)
    np.testing.assert_allclose(here[[Y, Z]], expected, rtol=1e-3)


@both_plants
def test_an_axial_start_error_moves_base_and_tip_and_keeps_the_stroke(kind):
    scenario = IDEAL.with_values({**COARSE, "phantom.start_axial_sd_mm": 3.0})
    truth = draw(scenario, np.random.default_rng(1))
    error = scenario.setup.tip_to_skin_mm - truth.scenario.setup.tip_to_skin_mm
    assert error != 0.0
    phantom = Phantom(truth, 0.0, kind)
    assert truth.scenario.start_base_x == pytest.approx(scenario.start_base_x + error)
    np.testing.assert_allclose(
        tip(phantom), [scenario.setup.start_tip_x + error, 0.0, 0.0, 0.0, 0.0], atol=1e-9
    )
    driven(phantom, STRAIGHT, times=110)
    assert tip(phantom)[0] == pytest.approx(scenario.setup.max_depth + error, abs=0.5)  # except for its bend
    assert phantom.condition().converged
    with pytest.raises(CommandError):
        driven(phantom, STRAIGHT)


@both_plants
def test_the_model_plant_lacks_its_documented_imperfections_and_the_exact_one_has_all(kind):
    """With all other imperfections, but for the motors."""
    rough = PHANTOM.with_values({"phantom.motor_resolution_mm": 0.0})
    only_exact = {"initial_bend_mm", "guide_clearance_mm", "friction_mn_per_mm", "shear_modulus_variation"}

    def end(scenario):
        truth = draw(scenario, np.random.default_rng(11))
        return tip(driven(Phantom(truth, 0.0, kind), AHEAD, times=55))[1]

    whole = end(rough)
    for key in sorted(only_exact | {"layer_shift_sd_mm", "run_out_mm"}):
        same = end(rough.with_values({f"phantom.{key}": 0.0})) == whole
        assert same == (kind == "model" and key in only_exact), key
