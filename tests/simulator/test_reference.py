"""Agreement with the independent implementation in tests/reference/insertion.py, in every quantity of a state."""

import math

import numpy as np
import pytest

from flexneedle import load_scenario
from reference.comparison import Pair, too_far, worst_gaps
from reference.draws import draw_controls, draw_scenario, in_space
from reference.ogden import Tissue, ogden

PHANTOM = load_scenario("phantom")
IN_SPACE = PHANTOM.with_values({"setup.axes": 2})


def random_gaps(axes, seed, every):
    """Return the gaps of a random insertion in the plane (1) or in space (2)."""
    rng = np.random.default_rng(seed)
    scenario = draw_scenario(rng)
    if axes == 1:
        return worst_gaps(scenario, draw_controls(scenario, 90, rng), every=every)
    scenario = in_space(scenario, rng)
    rows = draw_controls(scenario, 40, rng)
    return worst_gaps(scenario, rows, roll=rng.uniform(-math.pi, math.pi), every=every)


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize(
    "seed",
    [
        *(0, 1),
        *(pytest.param(k, marks=pytest.mark.long) for k in (2, 3)),
        *(pytest.param(k, marks=pytest.mark.slow) for k in range(4, 25)),
    ],
)
def test_random_insertions_agree(axes, seed):
    """Steps of 1e-9 to 2 mm, retractions, all inputs, layers, a guide on two axes, on one, or none."""
    assert not too_far(random_gaps(axes, seed, every=15))


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("hundred", range(10))
def test_a_thousand_random_insertions_agree(axes, hundred):
    """Seeds apart from those in the sample."""
    seeds = range(1000 + 100 * hundred, 1100 + 100 * hundred)
    assert {seed: found for seed in seeds if (found := too_far(random_gaps(axes, seed, every=30)))} == {}


def test_a_step_that_ends_just_past_a_contact_or_an_interval_agrees():
    """A billionth to a tenth of a millimetre past points, ends of intervals and the layers' boundary."""
    begun = Pair(PHANTOM)
    begun.step(30, db_x=1.0)
    for past in (1e-9, 1e-3, 0.1):
        pair = begun.copy()
        for place in (2.5, 3.0, 19.5, 20.0, 20.5):
            while pair.state.tip[0] < place - 1.0:
                pair.step(db_x=0.9)
            for _ in range(3):  # the step itself bends the needle
                pair.step(db_x=place + past - pair.state.tip[0])
            assert not pair.too_far()


def test_spins_and_rolls_agree():
    """Spins fast and slow, rolls between them, and spins in which the needle does not cut."""
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


def test_a_needle_without_a_guide_agrees():
    """Steered by base motion alone, on both axes."""
    pair = Pair(IN_SPACE.with_values({"setup.guide_to_skin_mm": None}), roll=2.5)
    pair.step(40, db_x=1.0, db_y=0.1, db_z=-0.06)
    pair.step(15, db_x=0.7, db_theta=-1e-3, db_psi=7e-4)
    assert not pair.too_far()


def test_large_compressions_agree():
    """A bevel of half the compression length: contacts are stiffer along a compression than across it."""
    pair = Pair(IN_SPACE.with_values({"needle.bevel.offset_mm": 10.0}))
    pair.step(36, db_x=1.0)
    pair.step(12, db_x=0.8, roll=0.4, dg_z=0.2)
    assert pair.state.contacts.stretch.min() < 0.8
    assert not pair.too_far()


@pytest.fixture(scope="module")
def deep():
    """The needle in the plane and in space, 26 mm deep; in space with a spin."""
    plane, space = Pair(PHANTOM), Pair(IN_SPACE, roll=-0.3)
    plane.step(55, db_x=1.0, dg_y=0.05)
    space.step(55, db_x=1.0, dg_y=0.05, dg_z=0.01, spin=0.02)
    return {1: plane, 2: space}


@pytest.mark.parametrize(
    ("axes", "points"),
    [
        (2, []),
        (2, [(10.5, 5.0, -1.2), (0.5, 4.2, 0.1)]),
        (2, [(-80.0, 1.0, -0.2), (12.2, 5.2, 0.3)]),
        (1, [(10.5, 5.0), (-80.0, 1.0)]),
    ],
    ids=["tip", "two contacts", "between nodes", "plane"],
)
def test_held_tip_and_points_agree(deep, axes, points):
    """Hold the tip, cut, hold it again while the base moves, release it; points coincide with contacts."""
    pair = deep[axes].copy()
    tip = pair.state.tip[: 1 + axes]
    innovation = pair.hold(tip + [0.3, 0.4, -0.3][: 1 + axes], points)
    assert innovation == pytest.approx(tip[0] + 0.3 - pair.pose.tip.x, abs=5e-6)
    assert np.hypot(*pair.state.reactions.tip_force) > 1e-3
    assert not pair.too_far()
    pair.hold(tip + [0.0, -0.2, 0.1][: 1 + axes], points)
    assert not pair.too_far()
    pair.step(3, db_x=0.9, db_y=0.1)
    assert not pair.too_far()


def test_points_measured_among_fresh_cuts_agree():
    """A long step that cuts several contacts, held between and behind them: the path's end is in every condition."""
    pair = Pair(PHANTOM.with_values({"setup.max_advance_mm": 5.0}))
    pair.step(12, db_x=4.0, dg_y=0.1)
    x, y = pair.state.tip[:2]
    pair.hold((x, y + 0.2), [(x - 2.2, y - 0.1)])
    assert pair.state.contacts.x[-3] > x - 4.0
    found = pair.too_far()
    assert found.pop("tip force", 0.0) < 1e-4  # 2.2 mm of needle are as stiff as 1 N/µm
    assert not found


def test_corrected_load_and_base_agree():
    """An observer's corrections act from the next step on, on both axes."""
    pair = Pair(IN_SPACE)
    pair.step(20, db_x=1.0)
    pair.correct(base=(0.4, -0.3), slope=(-3e-3, 2e-3))
    pair.step(20, db_x=1.0)
    pair.correct(tip_load=(0.004, -0.003))
    pair.step(5, db_x=1.0, roll=1.0)
    assert pair.state.tip_load == (0.004, -0.003)
    assert not pair.too_far()


def test_a_start_on_a_slanting_line_and_held_in_air_agrees():
    """The start is a separate solve, cut from nowhere, with the shortening of its slope."""
    entry = {"lateral_mm": 1.0, "lateral_z_mm": -2.0, "slope_mrad": 40.0, "slope_z_mrad": -25.0}
    pair = Pair(IN_SPACE.with_values({f"entry.{name}": value for name, value in entry.items()}), roll=0.8)
    assert not pair.too_far()
    x, y, z = pair.state.tip[:3]
    assert x < IN_SPACE.setup.start_tip_x - 0.1
    pair.hold((x, y + 0.3, z - 0.2))
    assert not pair.too_far()
    pair.step(35, db_x=1.0)
    assert not pair.too_far()


def test_the_references_law_is_that_in_the_equations():
    """Stress of layer 1 at λ = 0.7 (kPa), so that both implementations do not share a slip."""
    assert ogden(POINT, np.array([6.0])).force[0] == pytest.approx(-2.80e-3 * 5.2, rel=2e-3)


POINT = Tissue(*(np.array([value]) for value in (1.82e-3, 8.74, 20.0, 5.2 * 20.0)))


@pytest.mark.parametrize("size", [0.5, 4.0, 15.0])
def test_the_references_force_and_stiffness_are_derivatives(size):
    """Along and across the compression, and beyond the floor stretch."""
    n, h = np.exp(0.7j), 1e-4
    at = ogden(POINT, size * n)
    less, more = (ogden(POINT, (size + side * h * size) * n).energy for side in (-1, 1))
    np.testing.assert_allclose(-(more - less) / (2 * h * size) * n, at.force, rtol=1e-6)
    for way, stiffness in ((n, at.along), (1j * n, at.across)):
        less, more = (ogden(POINT, size * n + side * h * size * way).force for side in (-1, 1))
        np.testing.assert_allclose(-(more - less) / (2 * h * size), stiffness * way, rtol=1e-5)
