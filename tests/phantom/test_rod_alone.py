"""The exact rod without tissue: elastica, a second solver, helix, buckling, arcs, rotations, guide."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

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
from reference.validation import LOADS, buckling_factor, cantilever_error, order

EULER_LOAD = elastica.buckling_load(LENGTH, EI)


# ---- closed forms and a second solver


@pytest.mark.parametrize(("load", "published"), LOADS.items())
def test_the_elastica_reference_agrees_with_the_published_table(load, published):
    """And with a collocation of EI θ″ = −P cos θ to nine digits."""
    x, y, turn = elastica.cantilever(load)
    assert y == pytest.approx(published, abs=5e-5)

    def slopes(_, state):
        theta, bend, _, _ = state
        return np.array([bend, -load * np.cos(theta), np.cos(theta), np.sin(theta)])

    s = np.linspace(0.0, 1.0, 51)
    guess = np.array([turn * s, turn * (1.0 - s), s, y * s])
    ends = solve_bvp(
        slopes, lambda a, b: np.array([a[0], b[1], a[2], a[3]]), s, guess, tol=1e-10, max_nodes=20_000
    )
    np.testing.assert_allclose([*ends.y[2:, -1], ends.y[0, -1]], (x, y, turn), atol=1e-9)


@pytest.mark.parametrize("load", LOADS)
def test_a_cantilever_bends_as_the_elastica_and_converges_at_second_order(load):
    """Tip x, y and θ under a dead load; the error is quadratic in the segment length."""
    counts = np.array([16, 32, 64, 128])
    errors = np.array([cantilever_error(load, segments) for segments in counts.tolist()])
    assert np.abs(errors[-1]).max() < 3e-5
    for error in errors.T:
        assert order(1.0 / counts, error) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3, 4))])
def test_a_second_solver_finds_the_same_bent_and_twisted_rod(seed):
    """Tip and its axes, with a second-order error; the last segment is half a segment before the tip."""
    rod = drawn(seed)
    gaps, turns = np.array([solver_gap(rod, segments) for segments in SEGMENTS]).T
    assert gaps[-1] < 5e-3
    assert order([4.0, 2.0, 1.0], gaps) == pytest.approx(2.0, abs=0.15)
    assert turns[-1] < abs(rod.curvature) * LENGTH / 128 + 1e-3
    bench = loaded(rod, 32)
    assert abs(float(bench.s["twist"])) > 1e-3
    assert np.linalg.norm(bench.nodes[-1, 1:]) > 10.0


def test_a_helix_is_in_equilibrium_with_its_wrench():
    """The residual decreases with the square of the segment."""
    left = [helix_residual(segments) for segments in HELIX_SEGMENTS]
    assert left[-1] < 1e-4
    assert order([4.0, 2.0, 1.0], left) == pytest.approx(2.0, abs=0.1)


def test_the_length_is_exact_and_the_clamp_holds_the_load_and_its_moment():
    """The first hinge represents the half segment at the clamp, so that its moment is the moment of the base."""
    load = np.array([-0.1, 0.4])
    bench = Bench(segments=64).loaded(*load)
    np.testing.assert_allclose(np.linalg.norm(np.diff(bench.nodes, axis=0), axis=1), 100 / 64, rtol=1e-12)
    x, y, _ = bench.tip
    np.testing.assert_allclose(bench.s["base_force"][:2], -load, atol=1e-12)
    assert bench.s["base_moment"][2] == pytest.approx(-(x * load[1] - y * load[0]), rel=1e-9)


# ---- buckling


def test_a_straight_column_buckles_at_eulers_load():
    """π²EI/4L²: stable 3 % below, reported as unstable 3 % above; the limit itself within 1e-4."""
    assert Bench(segments=64).loaded(x=-0.97 * EULER_LOAD).converged
    assert not Bench(segments=64).loaded(x=-1.03 * EULER_LOAD).converged
    assert buckling_factor(64) == pytest.approx(1.0, abs=1e-4)
    assert buckling_factor(16) - 1.0 == pytest.approx(16.0 * (buckling_factor(64) - 1.0), rel=0.3)


@pytest.mark.parametrize("roll", [0.0, math.pi, 0.7, -2.0])
def test_a_bent_column_bows_out_above_eulers_load(roll):
    """To the side of its bend, by the deflection of the elastica: P/P_E = (2K(k)/π)², k = sin θ_t/2."""
    bench = Bench(segments=64, curvature=1e-6).step(roll=roll).loaded(x=-0.97 * EULER_LOAD)
    assert bench.converged
    assert 0.0 < np.hypot(*bench.nodes[-1, 1:]) < 0.5
    for _ in range(5):  # the deflection exceeds half its length: more than one solve is needed
        bench.loaded(x=-1.03 * EULER_LOAD)
    assert bench.converged
    y, z = bench.nodes[-1, 1:]
    assert math.cos(math.atan2(z, y) - roll) == pytest.approx(1.0, abs=1e-12)
    k = math.sin(0.5 * math.acos(bench.s["tangent"][0]))
    assert (2.0 * ellipk(k**2) / np.pi) ** 2 == pytest.approx(1.03, abs=5e-4)


def test_greenhills_moment_is_that_in_the_closed_form():
    """T L/EI = 8.987 without an axial load, 0 at Euler's load of a rod clamped at both ends."""
    moments = [
        elastica.twisted_buckling_moment(LENGTH, EI, share * EULER) for share in (0.0, 1e-3, 0.5, 0.97)
    ]
    assert moments[0] == pytest.approx(8.987 * EI / LENGTH, rel=1e-4)
    assert moments[1] == pytest.approx(moments[0], rel=1e-3)
    assert (np.diff(moments) < 0.0).all()
    assert moments[-1] < 0.25 * moments[0]


@pytest.mark.parametrize("share", SHARES)
def test_a_twisted_rod_buckles_at_greenhills_moment(share):
    """With and without an axial load; straight up to the limit. The hold in the tissue is elastic: a softer clamp."""
    assert buckling_twist(share) == pytest.approx(1.0, abs=0.015)
    bench = twisted(share, 0.95 * elastica.twisted_buckling_moment(LENGTH, EI, share * EULER) * LENGTH / GJ)
    np.testing.assert_allclose(bench.nodes[:, 1:], 0.0, atol=1e-7)


# ---- symmetries of space


@pytest.mark.parametrize("seed", range(2))
def test_base_and_load_turned_together_turn_the_rod(seed):
    """Frame indifference: by any rotation, of a rod with natural bend; energy, moment in the clamp and twist."""
    rod, rng = drawn(seed), np.random.default_rng(seed)
    about = Rotation.from_rotvec(rng.normal(0.0, 0.5, 3))
    one = loaded(rod, 32)
    pose = about * kirchhoff.frame_of(rod.tilt, rod.roll)
    tangent = pose.apply([1.0, 0.0, 0.0])
    tilt = np.arccos(tangent[0]) * tangent[1:] / np.hypot(*tangent[1:])
    roll = (kirchhoff.frame_of(tilt, 0.0).inv() * pose).as_rotvec()[0]
    other = loaded(rod._replace(tilt=tuple(tilt), roll=roll, load=about.apply(rod.load)), 32)
    np.testing.assert_allclose(other.nodes, about.apply(one.nodes), atol=1e-9)
    np.testing.assert_allclose(other.s["base_moment"], about.apply(one.s["base_moment"]), atol=1e-9)
    assert other.s["energy"] == pytest.approx(one.s["energy"], rel=1e-10)
    assert other.s["twist"] == pytest.approx(one.s["twist"], abs=1e-10)


@pytest.mark.parametrize("tilt", [(1.0, 0.0), (-2.0, 0.0), (0.4, -0.3)])
def test_a_moved_and_tilted_base_carries_a_free_needle_with_it(tilt):
    """Including its bend; no force and no energy are left."""
    bench = Bench(segments=50, curvature=2e-3).step()
    before = bench.nodes
    bench.step(db_x=1.0, db_y=-0.7)
    np.testing.assert_allclose(bench.s["base"], [-999.0, -0.7, 0.0])
    np.testing.assert_allclose(bench.nodes, before, atol=1e-12)
    for _ in range(20):
        bench.step(db_theta=tilt[0] / 20, db_psi=tilt[1] / 20)
        assert bench.converged
    np.testing.assert_allclose(bench.nodes, kirchhoff.frame_of(tilt, 0.0).apply(before), atol=1e-8)
    assert bench.s["energy"] == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose([*bench.s["base_force"], *bench.s["base_moment"]], 0.0, atol=1e-8)


@pytest.mark.parametrize("bevel", [1, -1])
def test_natural_curvature_is_an_arc_towards_the_bevel(bevel):
    """Each segment has the slope of the arc at its middle; the error of the nodes is quadratic in its length."""
    errors = []
    for segments in (20, 40, 80):
        bench = Bench(segments=segments, curvature=0.01, roll=0.0 if bevel > 0 else np.pi).step()
        middle = (np.arange(segments) + 0.5) * 100.0 / segments
        np.testing.assert_allclose(bench.turns, bevel * 0.01 * middle, atol=1e-12)
        x, y, _ = elastica.arc_tip(100.0, bevel * 0.01)
        errors.append(np.hypot(bench.tip[0] - x, bench.tip[1] - y))
    assert errors[-1] < 1e-2
    assert order([4.0, 2.0, 1.0], errors) == pytest.approx(2.0, abs=0.01)


def test_the_natural_bend_turns_with_the_roll():
    """The tip of a free needle is on a circle; four quarter rolls lead to the start."""
    bench = Bench(segments=50, curvature=2e-3).step()
    straight = bench.nodes[-1].copy()
    for quarter in range(1, 5):
        bench.step(roll=0.5 * math.pi)
        angle = 0.5 * math.pi * quarter
        expected = [straight[0], straight[1] * math.cos(angle), straight[1] * math.sin(angle)]
        np.testing.assert_allclose(bench.nodes[-1], expected, atol=1e-9)
    assert bench.s["roll"] == pytest.approx(2.0 * math.pi)


# ---- the guide


def guided(**constants):
    """Return a needle with a guide 40 mm in front of its base."""
    return Bench(**{"guide_x": -960.0, "length": 100.0, "segments": 100, **constants}).step()


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 2, np.pi, -2.5])
def test_the_guide_is_a_spring_beyond_a_circle(angle):
    """No force within the clearance c; beyond, the needle is c behind, but for the compliance of the guide."""
    way = np.array([np.cos(angle), np.sin(angle)])
    bench = guided(clearance=0.5)
    for there in (0.4999, -0.9998, 0.9998):
        bench.step(dg_y=there * way[0], dg_z=there * way[1])
        np.testing.assert_array_equal(bench.nodes[:, 1:], 0.0)
        assert not bench.s["guide_force"].any()
    bench.step(dg_y=way[0], dg_z=way[1])
    assert bench.converged
    force = bench.s["guide_force"] @ way
    assert force > 0.01
    np.testing.assert_allclose(bench.s["guide_force"], force * way, atol=1e-9)
    at_guide = [np.interp(40.0, bench.nodes[:, 0], bench.nodes[:, k]) for k in (1, 2)]
    np.testing.assert_allclose(at_guide, (0.9999 - force / 1e3) * way, atol=1e-8)


def test_the_needle_slides_through_its_guide_without_friction():
    """The guide's force is normal to the needle: its x component is −slope times its y component."""
    bench = guided(guide_stiffness=1e3)
    for _ in range(12):
        bench.step(dg_y=1.0)
    i = int(np.flatnonzero(bench.segments["node"][:, 0] > -960.0)[0]) - 1
    push, slope = bench.s["guide_force"][0], np.tan(bench.turns[i])
    assert slope > 0.3
    assert bench.s["base_force"][1] == pytest.approx(-push, rel=1e-9)
    assert bench.s["base_force"][0] == pytest.approx(push * slope, rel=1e-9)


def test_without_a_guide_or_before_it_there_is_no_force():
    assert Bench(segments=40).step(dg_y=3.0).s["guide_force"][0] == 0.0
    behind = Bench(segments=40, guide_x=-900.0).step(dg_y=1e-3)  # the tip is in the plane of the guide
    assert behind.s["tip"][0] == -900.0
    assert behind.s["guide_force"][0] == 0.0
    assert behind.step(db_x=0.01).converged
    assert behind.s["guide_force"][0] > 0.0
