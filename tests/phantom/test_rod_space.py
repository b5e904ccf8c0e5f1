"""The exact rod in space without tissue: a second solver, helix, buckling with twist, symmetry of space."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reference import elastica, kirchhoff
from reference.rods import Bench
from reference.space_validation import (
    EI,
    EULER,
    GJ,
    HELIX_SEGMENTS,
    LENGTH,
    SEGMENTS,
    SHARES,
    buckling_twist,
    drawn,
    helix_residual,
    loaded,
    solver_gap,
    twisted,
)
from reference.validation import order


@pytest.mark.parametrize("seed", range(5))
def test_a_second_solver_finds_the_same_bent_and_twisted_rod(seed):
    """Tip and its axes, with a second-order error."""
    rod = drawn(seed)
    position, _ = kirchhoff.tip(rod)
    assert np.linalg.norm(position[1:]) > 10.0
    gaps, turns = np.array([solver_gap(rod, segments) for segments in SEGMENTS]).T
    assert gaps[-1] < 5e-3
    assert order([4.0, 2.0, 1.0], gaps) == pytest.approx(2.0, abs=0.15)
    assert (
        turns[-1] < abs(rod.curvature) * LENGTH / 128 + 1e-3
    )  # the last segment is half a segment before the tip
    assert abs(float(loaded(rod, 32).s["twist"])) > 1e-3


def test_a_helix_is_in_equilibrium_with_its_wrench():
    """What is left falls with the square of the segment."""
    left = [helix_residual(segments) for segments in HELIX_SEGMENTS]
    assert left[-1] < 1e-4
    assert order([4.0, 2.0, 1.0], left) == pytest.approx(2.0, abs=0.1)


def test_greenhills_moment_is_that_of_the_closed_form():
    """T L/EI = 8.987 without an axial load, 0 at Euler's load of a rod clamped at both ends."""
    assert elastica.twisted_buckling_moment(LENGTH, EI) == pytest.approx(8.987 * EI / LENGTH, rel=1e-4)
    moments = [
        elastica.twisted_buckling_moment(LENGTH, EI, share * EULER) for share in (0.0, 1e-3, 0.5, 0.97)
    ]
    assert (np.diff(moments) < 0.0).all()
    assert moments[1] == pytest.approx(moments[0], rel=1e-3)
    assert moments[-1] < 0.25 * moments[0]


@pytest.mark.parametrize("seed", range(3))
def test_base_and_load_turned_together_turn_the_rod(seed):
    """Frame indifference: by any rotation, of a rod with natural bend; energy, moment in the clamp and twist."""
    rod, rng = drawn(seed), np.random.default_rng(seed)
    about = Rotation.from_rotvec(rng.normal(0.0, 0.5, 3))
    one = loaded(rod, 32)
    theta, psi = rod.tilt
    pose = about * Rotation.from_rotvec([0.0, -psi, theta]) * Rotation.from_rotvec([rod.roll, 0.0, 0.0])
    tangent = pose.apply([1.0, 0.0, 0.0])
    tilt = np.arccos(tangent[0]) * tangent[1:] / np.hypot(*tangent[1:])
    roll = (Rotation.from_rotvec([0.0, -tilt[1], tilt[0]]).inv() * pose).as_rotvec()[0]
    other = loaded(rod._replace(tilt=tuple(tilt), roll=roll, load=about.apply(rod.load)), 32)
    np.testing.assert_allclose(other.nodes, about.apply(one.nodes), atol=1e-9)
    np.testing.assert_allclose(other.s["base_moment"], about.apply(one.s["base_moment"]), atol=1e-9)
    assert other.s["energy"] == pytest.approx(one.s["energy"], rel=1e-10)
    assert other.s["twist"] == pytest.approx(one.s["twist"], abs=1e-10)


@pytest.mark.parametrize("share", SHARES)
def test_a_twisted_rod_buckles_at_greenhills_moment(share):
    """With and without an axial load; straight up to the limit. The hold in the tissue is elastic: a softer clamp."""
    assert buckling_twist(share) == pytest.approx(1.0, abs=0.015)
    bench = twisted(share, 0.95 * elastica.twisted_buckling_moment(LENGTH, EI, share * EULER) * LENGTH / GJ)
    np.testing.assert_allclose(bench.nodes[:, 1:], 0.0, atol=1e-7)


@pytest.mark.parametrize("roll", [0.0, 0.7, -2.0])
def test_a_bent_column_bows_out_above_eulers_load_to_the_side_of_its_bend(roll):
    euler = elastica.buckling_load(LENGTH, EI)
    bench = Bench(segments=64, curvature=1e-6).step(roll=roll)
    for _ in range(5):
        bench.loaded(x=-1.03 * euler)
    assert bench.converged
    y, z = bench.nodes[-1, 1:]
    assert math.hypot(y, z) > 20.0
    assert math.atan2(z, y) == pytest.approx(roll, abs=1e-6)


def test_the_natural_bend_turns_with_the_roll():
    """A free needle: its tip on a circle; two quarters are the half turn of a flip, four the start."""
    bench = Bench(segments=50, curvature=2e-3).step()
    straight = bench.nodes[-1].copy()
    for quarter in range(1, 5):
        bench.step(roll=0.5 * math.pi)
        angle = 0.5 * math.pi * quarter
        expected = [straight[0], straight[1] * math.cos(angle), straight[1] * math.sin(angle)]
        np.testing.assert_allclose(bench.nodes[-1], expected, atol=1e-9)
    assert bench.s["roll"] == pytest.approx(2.0 * math.pi)


def test_a_tilt_turns_a_free_needle_rigidly():
    """In any direction, in steps or at once; no force is left."""
    turn = np.array([0.4, -0.3])
    bench = Bench(segments=50, curvature=2e-3).step()
    start = bench.nodes
    for _ in range(10):
        bench.step(db_theta=turn[0] / 10, db_psi=turn[1] / 10)
    rotation = Rotation.from_rotvec([0.0, -turn[1], turn[0]])
    np.testing.assert_allclose(bench.nodes, rotation.apply(start), atol=1e-8)
    np.testing.assert_allclose([*bench.s["base_force"], *bench.s["base_moment"]], 0.0, atol=1e-8)


def test_the_guide_is_a_circle():
    """No force within its clearance in any direction; beyond, the needle is the clearance behind."""
    for angle in (0.0, 0.6, 2.5):
        y, z = math.cos(angle), math.sin(angle)
        bench = Bench(guide_x=-960.0, length=100.0, segments=100, clearance=0.5).step()
        bench.step(dg_y=0.49 * y, dg_z=0.49 * z)
        assert not bench.s["guide_force"].any()
        bench.step(dg_y=1.01 * y, dg_z=1.01 * z)  # to 1.5
        force = bench.s["guide_force"]
        np.testing.assert_allclose(force / np.linalg.norm(force), [y, z], atol=1e-6)
        at = [np.interp(40.0, bench.nodes[:, 0], bench.nodes[:, k]) for k in (1, 2)]
        off = 1.0 - np.linalg.norm(force) / 1e3
        np.testing.assert_allclose(at, [off * y, off * z], atol=1e-8)
