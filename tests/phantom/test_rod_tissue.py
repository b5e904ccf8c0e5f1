"""The exact rod in tissue: work and energy, friction, symmetry."""

import math

import numpy as np
import pytest

from flexneedle import Control
from reference.rods import IDEAL, move, plant
from reference.validation import friction_balance, insertion_balance

AHEAD, BACK = 0.25, -0.25


def test_a_push_with_friction_stores_and_dissipates_the_work_of_the_base():
    """3 mm along the channel, with an inserted length of 23 to 26 mm; within 0.1 % of the dissipated energy."""
    done, stored, lost = friction_balance(20)
    assert lost == pytest.approx(0.372, abs=0.001)
    assert stored > 0.01
    assert done == pytest.approx(stored + lost, abs=1.5e-3 * lost)


def test_work_on_an_insertion_is_stored_or_dissipated():
    """With cutting, guide motion and a flip: the difference decreases with the step, to 6e-4 of the work."""
    gaps = [abs(insertion_balance(step, friction=0.0).gap) for step in (0.5, 0.25, 0.125)]
    assert (np.diff(np.log2(gaps)) < -0.75).all()
    assert gaps[-1] < 6e-4
    rubbed = insertion_balance(0.25, friction=5.0)
    assert rubbed.friction > 3.9  # 5 mN/mm over 40 mm
    assert abs(rubbed.gap) < 4e-5
    assert min(rubbed.needle, rubbed.tissue) > 0.01


def test_friction_is_5_mn_per_mm_opposite_to_the_last_sliding_direction():
    """For a straight needle the base force is 5 mN per mm inserted: pushing, resting, pulling."""
    needle = plant(IDEAL.with_values({"needle.bevel.offset_mm": 0.0, "phantom.friction_mn_per_mm": 5.0}))
    move(needle, AHEAD, times=114)
    assert needle.state["base_force"][0] == 0.0
    for _ in range(8):
        move(needle, AHEAD, times=20)
        assert needle.state["base_force"][0] == pytest.approx(5e-3 * needle.tip[0], rel=1e-12)
        assert needle.state["base_force"][1] == 0.0
    assert needle.tip[0] == pytest.approx(40.0)
    assert move(needle).state["base_force"][0] == pytest.approx(5e-3 * 40.0)  # constant at rest
    move(needle, BACK)
    assert needle.state["base_force"][0] == pytest.approx(-5e-3 * 39.75)
    move(needle, BACK, times=159)
    assert needle.state["base_force"][0] == pytest.approx(0.0, abs=1e-12)  # the tip is at the skin


def test_mirrored_commands_give_the_mirrored_needle():
    """Base, guide, bevel, start, bend and random commands mirrored at the axis: to the last bit."""
    rng = np.random.default_rng(0)
    changes = {"phantom.friction_mn_per_mm": 5.0, "phantom.guide_clearance_mm": 0.05}
    rough = IDEAL.with_values(changes | {"setup.tip_to_skin_mm": 2.0})
    one = plant(rough, base_y=0.4, base_turn=0.003, bend=0.5)
    other = plant(rough, roll=math.pi, base_y=-0.4, base_turn=-0.003, bend=0.5)
    for _ in range(240):
        ahead = rng.choice([0.25, 0.25, 0.25, 0.1, -0.25])
        lateral, rotation, guide = rng.normal(0.0, [0.02, 2e-4, 0.05])
        flip = bool(rng.choice([True, False], p=[0.05, 0.95]))
        for needle, sign in ((one, 1.0), (other, -1.0)):
            across = {"db_y": sign * lateral, "db_theta": sign * rotation, "dg_y": sign * guide}
            needle.step(np.array(Control(db_x=ahead, **across, flip=flip)))
    assert one.converged
    assert one.tip[0] > 10.0
    assert abs(one.tip[1]) > 0.1
    np.testing.assert_array_equal(other.tip, one.tip * [1.0, -1.0, 1.0, -1.0, 1.0])
    np.testing.assert_array_equal(other.nodes, one.nodes * [1.0, -1.0, 1.0])
    assert (other.strain_energy, other.least_stretch) == (one.strain_energy, one.least_stretch)


def test_a_symmetric_tip_has_a_straight_path():
    """b = 0 without lateral offsets: exactly straight through both layers, without stored energy."""
    needle = move(plant(IDEAL.with_values({"needle.bevel.offset_mm": 0.0})), AHEAD, times=294)
    assert not needle.nodes[:, 1:].any()
    assert needle.tip[0] == pytest.approx(45.0, abs=1e-12)
    assert needle.strain_energy == needle.state["energy"] == 0.0
    assert needle.least_stretch == 1.0
