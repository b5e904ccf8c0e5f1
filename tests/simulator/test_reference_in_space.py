"""Agreement in space with the independent implementation in tests/reference/insertion.py, a full Newton method."""

import math

import numpy as np
import pytest

from flexneedle import load_scenario
from reference.comparison import Pair, too_far, worst_gaps
from reference.draws import draw_controls, draw_scenario, in_space

IN_SPACE = load_scenario("phantom").with_values({"setup.axes": 2})
WITHOUT_GUIDE = IN_SPACE.with_values({"setup.guide_to_skin_mm": None})
STEPS = 40


def random_insertion(seed):
    """Gaps of one random insertion."""
    rng = np.random.default_rng(seed)
    scenario = in_space(draw_scenario(rng), rng)
    rows = draw_controls(scenario, STEPS, rng)
    return worst_gaps(scenario, rows, roll=rng.uniform(-math.pi, math.pi), every=10)


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(k, marks=pytest.mark.slow) for k in range(6, 25))]
)
def test_random_insertions_agree(seed):
    """40 random steps of up to 2 mm each: all inputs, retractions, layers, a guide on two axes, on one, or none."""
    assert not too_far(random_insertion(seed))


@pytest.mark.slow
@pytest.mark.parametrize("hundred", range(10))
def test_a_thousand_random_insertions_agree(hundred):
    """Seeds apart from those of the sample."""
    failures = {}
    for seed in range(1000 + 100 * hundred, 1100 + 100 * hundred):
        if found := too_far(random_insertion(seed)):
            failures[seed] = found
    assert not failures


def test_guide_moved_on_both_axes_agrees():
    """From a needle rolled to the side, to full depth, the guide on a circle."""
    pair = Pair(IN_SPACE, roll=1.9)
    for k in range(76):
        pair.step(db_x=1.0, dg_y=0.1 * math.cos(0.1 * k), dg_z=0.1 * math.sin(0.1 * k))
    assert pair.state.tip[0] > 45.0
    assert np.hypot(*pair.state.guide) > 0.9
    assert not pair.too_far()


def test_spins_and_rolls_agree():
    """Spins fast and slow, rolls between them, and spins where the needle does not cut."""
    pair = Pair(IN_SPACE)
    pair.step(40, db_x=1.0, spin=0.3)
    pair.step(roll=2.2)
    pair.step(10, db_x=1.0, spin=-12.0)
    pair.step(3, spin=1.0)
    pair.step(4, db_x=-1.0, spin=5.0)
    pair.step(9, db_x=0.9, roll=-0.7, spin=2.0)
    assert pair.state.bevel == pytest.approx(np.exp(1j * pair.state.roll), abs=1e-12)
    assert not pair.too_far()


def test_exit_from_the_skin_and_new_entry_agree():
    """Half out, on with a spin past the front of the channel, all out, lateral, in again with a spin."""
    pair = Pair(IN_SPACE, roll=-0.6)
    pair.step(36, db_x=1.0, dg_y=0.05, dg_z=-0.04)
    pair.step(4, db_x=-1.0)
    pair.step(5, db_x=0.9, roll=1.2, spin=0.8)
    assert not pair.too_far()
    pair.step(14, db_x=-0.8, dg_y=0.1, dg_z=0.1)
    assert pair.state.tip[0] < 0.0
    assert not pair.too_far()
    pair.step(6, dg_y=-0.4, dg_z=0.3, roll=0.5)
    pair.step(14, db_x=0.83, spin=-0.6)
    assert pair.state.contacts.active.sum() > 5
    assert not pair.too_far()


def test_needle_without_guide_agrees():
    """Steered by base motion alone, on both axes."""
    pair = Pair(WITHOUT_GUIDE, roll=2.5)
    pair.step(40, db_x=1.0, db_y=0.1, db_z=-0.06)
    pair.step(25, db_x=0.7, db_theta=-1e-3, db_psi=7e-4)
    assert not pair.too_far()


def test_large_compressions_agree():
    """A bevel of half the compression length: contacts are stiffer along a compression than across it."""
    pair = Pair(IN_SPACE.with_values({"needle.bevel.offset_mm": 10.0}))
    pair.step(36, db_x=1.0)
    pair.step(12, db_x=0.8, roll=0.4, dg_z=0.2)
    assert pair.state.contacts.stretch.min() < 0.8
    assert not pair.too_far()


@pytest.mark.parametrize(
    "points",
    [[], [(15.5, 5.4, -1.0)], [(10.5, 5.0, -1.2), (0.5, 4.2, 0.1)], [(-80.0, 1.0, -0.2), (12.2, 5.2, 0.3)]],
    ids=["tip", "one contact", "two contacts", "between nodes"],
)
def test_held_tip_and_points_agree(points):
    """Held, cut anew with a spin, held on while the base moves, and released; points that coincide with contacts."""
    pair = Pair(IN_SPACE, roll=-0.3)
    pair.step(55, db_x=1.0, dg_y=0.05, dg_z=0.01, spin=0.02)
    x, y, z = pair.state.tip[:3]
    innovation = pair.hold((x + 0.3, y + 0.4, z - 0.3), points)
    assert innovation == pytest.approx(x + 0.3 - pair.pose.tip.x, abs=5e-6)
    assert np.hypot(*pair.state.reactions.tip_force) > 1e-3
    assert not pair.too_far()
    pair.hold((x, y - 0.2, z + 0.1), points)
    assert not pair.too_far()
    pair.step(3, db_x=0.9, db_y=0.1, db_z=0.1)
    assert not pair.too_far()


def test_corrected_load_and_base_agree():
    """What an observer corrects acts from the next step on, on both axes."""
    pair = Pair(IN_SPACE)
    pair.step(20, db_x=1.0)
    pair.correct(base=(0.4, -0.3), slope=(-3e-3, 2e-3))
    pair.step(25, db_x=1.0)
    pair.correct(tip_load=(0.004, -0.003))
    pair.step(8, db_x=1.0, roll=1.0)
    assert pair.state.tip_load == (0.004, -0.003)
    assert not pair.too_far()


def test_start_on_a_slanting_line_and_held_in_air_agrees():
    """The start is a solve of its own, cut from nowhere, with the shortening of its slope."""
    entry = {"lateral_mm": 1.0, "lateral_z_mm": -2.0, "slope_mrad": 40.0, "slope_z_mrad": -25.0}
    pair = Pair(IN_SPACE.with_values({f"entry.{name}": value for name, value in entry.items()}), roll=0.8)
    assert not pair.too_far()
    x, y, z = pair.state.tip[:3]
    assert x < IN_SPACE.setup.start_tip_x - 0.1
    pair.hold((x, y + 0.3, z - 0.2))
    assert not pair.too_far()
    pair.step(45, db_x=1.0)
    assert not pair.too_far()
