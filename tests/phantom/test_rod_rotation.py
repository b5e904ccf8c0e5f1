"""Insertions of the exact rod in space: symmetry, rolls, spins, friction against rotation, work and energy."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle import Control
from flexneedle.types import PSI, THETA, Z
from reference import kirchhoff
from reference.bent_rods import PLAIN
from reference.interpreted import Record
from reference.rods import IDEAL, plant
from reference.space_insertions import Inserted, angle_between, turned, wander
from reference.space_validation import inserted_straight, largest_lag

ROUGH = IDEAL.with_values(
    {
        "phantom.friction_mn_per_mm": 5.0,
        "phantom.guide_clearance_mm": 0.05,
        "phantom.element_mm": 1.0,
        "setup.tip_to_skin_mm": 28.5,
    }
)


@pytest.mark.parametrize(("seed", "friction"), [(0, 0.0), (1, 20.0), (2, 20.0)])
def test_all_inputs_turned_about_the_axis_turn_the_needle(seed, friction):
    """Start, base, tilts, guide, roll: random commands in all columns, nodes within 1e-9 mm."""
    scenario = ROUGH.with_values({"phantom.rotation_friction_mn": friction})
    angle, rows = 0.7 + seed, wander(seed)
    c, s = math.cos(angle), math.sin(angle)
    base, tilt = np.array([0.3, -0.2]), np.array([2e-3, 3e-3])
    about = np.array([[c, -s], [s, c]])
    one = Inserted(scenario, base=base, tilt=tilt, roll=0.4, bend=0.5)
    other = Inserted(scenario, base=about @ base, tilt=about @ tilt, roll=0.4 + angle, bend=0.5)
    for row, row_turned in zip(rows, turned(rows, angle), strict=True):
        one.move(row)
        other.move(row_turned)
    assert one.tip[0] > 15.0
    assert np.linalg.norm(one.tip[1:]) > 0.05
    nodes = one.w["node"].copy()
    nodes[:, 1:] = nodes[:, 1:] @ about.T
    np.testing.assert_allclose(other.w["node"], nodes, atol=1e-9)
    assert other.roll == pytest.approx(one.roll + angle, abs=1e-9)
    assert other.s["energy"] == pytest.approx(one.s["energy"], rel=1e-9)


def test_any_number_of_half_turns_stays_in_the_plane():
    """Also with a natural bend, and by rolls of −π, 3π and 20 turns; the bevel's roll is from −π, excluded, to π."""
    needle = plant(IDEAL, bend=0.5)
    needle.step(np.array(Control(db_x=40.0)))
    turns = 0
    for half_turns in (1, 1, -1, 3, 1, 40, 1, 1, 5):
        for _ in range(4):
            needle.step(np.array(Control(db_x=0.25, dg_y=0.02)))
        needle.step(np.array(Control(db_x=0.25, roll=half_turns * math.pi)))
        turns += half_turns
        assert needle.roll == pytest.approx(math.pi * (turns % 2), abs=1e-13)
        assert not needle.nodes[:, 2].any()
        assert abs(needle.state["tangent"][2]) == 0.0
    assert needle.converged
    assert abs(needle.tip[1]) > 0.1


def test_a_roll_at_rest_turns_the_bevel_and_moves_nothing():
    """Without bend and friction; the path had bent towards the bevel, whose spring keeps its offset."""
    needle = Inserted(roll=-2.0).move(db_x=0.25, times=200)
    tip, offset = needle.tip, needle.s["offset"].copy()
    assert math.atan2(tip[2], tip[1]) == pytest.approx(-2.0, abs=1e-6)
    needle.move(roll=1.0)
    np.testing.assert_allclose(needle.tip, tip, atol=1e-9)
    np.testing.assert_allclose(needle.s["offset"], offset, atol=1e-9)
    y, z = needle.bevel[1:]
    assert math.atan2(z, y) == pytest.approx(-1.0, abs=2e-3)  # but for the slope of the tip


# ---- spins


def spun(step, rate, depth=40.0):
    """Return the needle after an insertion that spins by `rate` (rad/mm) from the skin on."""
    needle = Inserted().move(db_x=1.0, times=28)
    return needle.move(db_x=step, spin=rate * step, times=round(depth / step))


@pytest.mark.parametrize("rate", [1.0, 2.0 * math.pi])
def test_a_spin_does_not_depend_on_the_step(rate):
    """Up to a turn per mm, in steps of a turn and of an eighth: within 10 µm."""
    tips = np.array([spun(step, rate).tip for step in (1.0, 0.5, 0.125)])
    assert (np.linalg.norm(tips[:-1] - tips[-1], axis=1) < 1e-2).all()


# ---- friction against rotation


def lag(needle):
    """Return the lag (rad) of the roll at the tip behind the roll of the base."""
    return -float(needle.s["twist"])


def test_the_tips_roll_lags_by_the_twist_of_the_shaft():
    """c l²/2GJ in the tissue and c l over the free length, l = 40 mm: sliding all along, either way and again."""
    needle = inserted_straight()
    inside, expected = needle.tip[0], largest_lag(needle)
    assert inside == pytest.approx(40.0)
    assert expected > 0.02
    for turn in (1.5, -3.0, 2.0):
        needle.move(roll=turn / 20, times=20)
        assert lag(needle) == pytest.approx(math.copysign(expected, turn), rel=1e-9)
        assert needle.s["base_moment"][0] == pytest.approx(math.copysign(0.02 * inside, turn), rel=1e-9)
    assert needle.roll == pytest.approx(0.5 - expected, rel=1e-9)
    energy = float(needle.s["energy"])
    assert needle.move(roll=0.5).s["energy"] == pytest.approx(energy, rel=1e-9)  # all work is dissipated


def test_a_small_roll_does_not_reach_the_tip_and_the_lag_has_no_jump():
    """The part that slides grows from the skin: the lag grows evenly up to its largest, then the tip follows."""
    needle, lags = inserted_straight(), [0.0]
    largest = largest_lag(needle)
    for _ in range(60):
        needle.move(roll=0.05 * largest)
        lags.append(lag(needle))
    steps = np.diff(lags)
    assert abs(needle.roll) == pytest.approx(2.0 * largest, rel=1e-2)
    assert lags[10] == pytest.approx(0.5 * largest, rel=0.05)  # the tip has hardly moved
    assert (steps > -1e-9).all()
    assert steps.max() < 0.051 * largest
    assert steps[-1] == pytest.approx(0.0, abs=1e-9)


def test_the_number_of_parts_of_a_roll_does_not_matter():
    """Three turns in one command, or in sixty."""
    one, many = inserted_straight(), inserted_straight()
    one.move(roll=6.0 * math.pi)
    many.move(roll=0.1 * math.pi, times=60)
    np.testing.assert_allclose(one.tip, many.tip, atol=1e-9)
    assert one.roll == pytest.approx(many.roll, abs=1e-9)


def test_a_bevel_turns_by_the_spin_that_reaches_it():
    """If the shaft takes up all of the base's spin, the rest point lags only behind the drift of the tip."""
    scenario = IDEAL.with_values({"phantom.rotation_friction_mn": 1000.0})
    needle = Inserted(scenario).move(db_x=0.25, times=200)
    assert needle.s["offset"] @ needle.bevel > 3.0
    needle.move(db_x=0.25, spin=0.4)
    assert lag(needle) == pytest.approx(0.4, abs=1e-3)
    ratio = 0.25 / IDEAL.needle.bevel.length_mm
    assert needle.s["offset"][2] == pytest.approx(needle.tip[2] * math.expm1(-ratio) / ratio, abs=1e-3)


# ---- work and energy


def bent():
    """Return a needle 31 mm deep on a path that leaves the plane, drawn back by 3.75 mm: nothing there cuts."""
    needle = Inserted(IDEAL, bend=0.5)
    for k in range(240):
        across = 0.02 if k < 200 else -0.01
        needle.move(db_x=0.25, dg_y=across, dg_z=0.6 * across, roll=1.2 if k == 180 else 0.0)
    return needle.move(db_x=-0.1875, times=20)


def held(needle):
    """Return forces and moment of base and guide, and the positions and frame that they move."""
    s = needle.s
    forces = s["base_force"].copy(), s["guide_force"].copy(), s["base_moment"].copy()
    return forces, (s["base"].copy(), s["guide"].copy(), np.array(PLAIN.clamp(Record(s))))


def travel(before, now):
    """Return the motions that do the work of the forces and of the moment."""
    (base, guide, frame), (base_now, guide_now, frame_now) = before[1], now[1]
    return base_now - base, guide_now - guide, angle_between(frame, frame_now)


MOVES = {
    "base": {"db_y": -1.0, "db_z": 1.5},
    "tilt": {"db_theta": 0.01, "db_psi": -0.015},
    "guide": {"dg_y": 1.0, "dg_z": -1.5},
    "roll": {"roll": 1.5},
    "all": {"db_y": 1.0, "db_z": -0.5, "db_psi": 0.01, "dg_y": -0.5, "dg_z": 1.0, "roll": -1.0},
}


@pytest.mark.parametrize("name", MOVES)
def test_the_work_of_base_and_guide_is_the_stored_energy(name):
    """Forces, moment and guide in space, by the trapezoid rule; without cutting."""
    gaps = []
    for steps in (20, 40):
        needle = bent()
        before, energy, done = held(needle), float(needle.s["energy"]), 0.0
        for _ in range(steps):
            needle.move(**{column: value / steps for column, value in MOVES[name].items()})
            now = held(needle)
            moves = zip(before[0], now[0], travel(before, now), strict=True)
            done += sum(0.5 * (a + b) @ moved for a, b, moved in moves)
            before = now
        stored = float(needle.s["energy"]) - energy
        assert abs(stored) > 1e-3
        gaps.append(done / stored - 1.0)
    assert abs(gaps[1]) < 5e-4
    assert abs(gaps[1]) < abs(gaps[0]) / 2.5 or abs(gaps[0]) < 2e-6


def test_the_plants_pose_is_the_pose_of_its_last_segment():
    """Tilted by √(θ² + ψ²) in the direction (θ, ψ), after its roll."""
    needle, row = plant(IDEAL), np.array(Control(db_x=0.25, roll=0.01))
    for _ in range(200):
        needle.step(row)
    np.testing.assert_array_equal(needle.tip[:3], needle.nodes[-1])
    assert needle.tip[Z] != 0.0
    assert abs(needle.tip[PSI]) > 1e-3
    found = kirchhoff.frame_of(needle.tip[[THETA, PSI]], needle.roll)
    frame = Rotation.from_quat(needle.state["frame"], scalar_first=True)
    assert (found.inv() * frame).magnitude() < 1e-12
    assert needle.roll == pytest.approx(2.0, abs=1e-3)
