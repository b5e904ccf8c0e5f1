"""The exact rod in the plane is what it was before it could leave it, and stays there to the last bit."""

import math

import numpy as np
import pytest

from flexneedle import Control, controls, load_scenario
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant
from flexneedle.types import PSI, Z
from reference import draws, planar_rod
from reference.rods import IDEAL, planar, plant

ROUGH = {
    "phantom.friction_mn_per_mm": 20.0,
    "phantom.guide_clearance_mm": 0.1,
    "phantom.initial_bend_mm": 2.0,
    "phantom.shear_modulus_factor": [0.3, 2.5],
    "phantom.bevel_factor": [0.0, 2.0],
    "phantom.start_angle_sd_mrad": 6.0,
    "phantom.element_mm": 1.0,
}
SCENARIOS = {
    "preset": lambda _rng: load_scenario("phantom").with_values(ROUGH),
    "any": lambda rng: draws.draw_scenario(rng).with_values(ROUGH),
}


def commands(rng, scenario, steps=160):
    """Random rows (m, 9), mostly ahead, some back, in all planar inputs; from air into the tissue."""
    ahead = rng.choice([0.5, 0.5, 0.25, -0.25], steps)
    ahead[0] = scenario.setup.tip_to_skin_mm - 2.0
    base, turn, guide = rng.normal(0.0, [0.02, 2e-4, 0.05], (steps, 3)).T
    roll = rng.choice([math.pi, 0.0], steps, p=[0.05, 0.95])
    return controls(steps, db_x=ahead, db_y=base, db_theta=turn, dg_y=guide, roll=roll)


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("seed", range(6))
def test_random_insertions_are_those_of_the_planar_kernel(name, seed):
    """Needles, tissues, flips, friction, clearance, bend: tips within 1e-6 mm and 1e-7 rad, z exactly 0."""
    rng = np.random.default_rng(seed)
    scenario = SCENARIOS[name](rng)
    roll = float(rng.choice([math.pi, 0.0]))
    needle = ExactPlant(draw(scenario, rng), roll)
    before = planar_rod.Needle(needle, roll)
    for row in commands(rng, scenario):
        needle.step(row)
        before.step(row)
        assert bool(before.converged) == (needle.state["converged"] > 0.0)
        np.testing.assert_allclose(planar(needle.tip), before.tip, atol=1e-6)
        assert needle.tip[Z] == needle.tip[PSI] == 0.0
        assert not needle.nodes[:, 2].any()
    assert needle.count == before.count > 40
    assert math.cos(needle.roll) == before.s[planar_rod.BEVEL]
    for name in ("ENERGY", "STRAIN_ENERGY", "LEAST_STRETCH"):
        expected = before.s[getattr(planar_rod, name)]
        assert needle.state[name.lower()] == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_any_number_of_half_turns_stays_in_the_plane():
    """Also with a natural bend, and by rolls of −π, 3π and 20 turns."""
    needle = plant(IDEAL, bend=0.5)
    needle.step(np.array(Control(db_x=40.0)))
    for half_turns in (1, 1, -1, 3, 1, 40, 1, 1, 5):
        for _ in range(4):
            needle.step(np.array(Control(db_x=0.25, dg_y=0.02)))
        needle.step(np.array(Control(db_x=0.25, roll=half_turns * math.pi)))
        assert not needle.nodes[:, 2].any()
        assert abs(needle.state["tangent"][2]) == 0.0
    assert needle.converged
    assert abs(needle.tip[1]) > 0.1


def test_two_flips_are_none():
    """The roll of the bevel is from −π, excluded, to π."""
    needle, rolls = plant(IDEAL, bend=0.5), []
    for _ in range(4):
        needle.step(np.array(Control(db_x=0.25, flip=True)))
        rolls.append(needle.roll)
    np.testing.assert_allclose(rolls, [math.pi, 0.0, math.pi, 0.0], atol=1e-15)
