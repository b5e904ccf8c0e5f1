"""The exact rod without tissue: elastica, buckling, arcs, rotations, guide."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.special import ellipk

from reference import elastica
from reference.rods import Bench
from reference.validation import LOADS, buckling_factor, cantilever_error, order

SEGMENTS = (16, 32, 64, 128)
GUIDED = {"guide_x": -960.0, "length": 100.0, "segments": 100}


def turned(angle):
    """Rotation (3, 3) about z."""
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )


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
    errors = np.array([cantilever_error(load, segments) for segments in SEGMENTS])
    assert np.abs(errors[-1]).max() < 3e-5
    for error in errors.T:
        assert order(1.0 / np.array(SEGMENTS), error) == pytest.approx(2.0, abs=0.02)


def test_the_tip_deflection_agrees_with_published_values():
    """0.3017 L, 0.4935 L, 0.7138 L."""
    for load, published in LOADS.items():
        bench = Bench(length=100.0, segments=256).loaded(y=load * 1000.0 / 100.0**2)
        assert bench.tip[1] / 100.0 == pytest.approx(published, abs=1e-4)


def test_the_length_is_exact():
    bench = Bench(segments=40).loaded(y=0.7, x=-0.2)
    lengths = np.linalg.norm(np.diff(bench.nodes, axis=0), axis=1)
    np.testing.assert_allclose(lengths, 2.5, rtol=1e-12)


def test_the_clamp_holds_the_load_and_its_moment():
    """Base force and moment balance the load at the deflected tip."""
    load = np.array([-0.1, 0.4])
    bench = Bench(segments=64).loaded(*load)
    x, y, _ = bench.tip
    np.testing.assert_allclose(bench.s["base_force"][:2], -load, atol=1e-12)
    # The first hinge represents the half segment at the clamp, so that its moment is that at the base.
    assert bench.s["base_moment"][2] == pytest.approx(-(x * load[1] - y * load[0]), rel=1e-9)


def test_energy_is_the_work_of_the_load():
    """∫ P dy by the trapezoid rule, with a quadratic error."""
    gap = []
    for parts in (10, 20, 40):
        bench, done, last = Bench(segments=32), 0.0, 0.0
        for load in np.linspace(0.0, 0.5, parts + 1)[1:]:
            before = bench.tip[1]
            bench.loaded(y=load)
            done += 0.5 * (load + last) * (bench.tip[1] - before)
            last = load
        gap.append(done / bench.s["energy"] - 1.0)
    assert abs(gap[-1]) < 1e-3
    assert gap[0] / gap[1] == pytest.approx(4.0, abs=0.3)
    assert gap[1] / gap[2] == pytest.approx(4.0, abs=0.3)


def test_a_straight_column_buckles_at_eulers_load():
    """π²EI/4L²: stable 3 % below, reported as unstable 3 % above; the limit itself within 1e-4."""
    euler = elastica.buckling_load(100.0, 1000.0)
    assert Bench(segments=64).loaded(x=-0.97 * euler).converged
    assert not Bench(segments=64).loaded(x=-1.03 * euler).converged
    assert buckling_factor(64) == pytest.approx(1.0, abs=1e-4)
    assert buckling_factor(16) - 1.0 == pytest.approx(16.0 * (buckling_factor(64) - 1.0), rel=0.3)


def test_a_bent_column_bows_out_above_eulers_load():
    """To the side of its bend, by the deflection of the elastica: P/P_E = (2K(k)/π)², k = sin θ_t/2."""
    euler = elastica.buckling_load(100.0, 1000.0)
    below = Bench(segments=64, curvature=1e-6).loaded(x=-0.97 * euler)
    assert below.converged
    assert 0.0 < below.tip[1] < 0.5
    for side in (1, -1):
        above = Bench(segments=64, curvature=1e-6, roll=0.0 if side > 0 else np.pi)
        for _ in range(5):  # the deflection exceeds half its length: more than one solve is needed
            above.loaded(x=-1.03 * euler)
        assert above.converged
        k = np.sin(0.5 * above.tip[2])
        assert (2.0 * ellipk(k**2) / np.pi) ** 2 == pytest.approx(1.03, abs=5e-4)
        assert np.sign(above.tip[1]) == side


@pytest.mark.parametrize("angle", [0.3, 1.0, -2.0])
def test_a_rotated_base_rotates_a_free_needle_rigidly(angle):
    """Including its bend, in steps or at once."""
    straight = Bench(segments=50, curvature=2e-3).step()
    bench = Bench(segments=50, curvature=2e-3).step()
    for _ in range(20):
        bench.step(db_theta=angle / 20)
        assert bench.converged
    np.testing.assert_allclose(bench.nodes, straight.nodes @ turned(angle).T, atol=1e-9)
    assert bench.tip[2] == pytest.approx(straight.tip[2] + angle, abs=1e-12)
    assert bench.s["energy"] == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose([*bench.s["base_force"], *bench.s["base_moment"]], 0.0, atol=1e-9)


def test_base_and_load_rotated_together_give_the_same_needle():
    load = np.array([-0.1, 0.3])
    one = Bench(segments=40).loaded(*load)
    angle = 0.8
    other = Bench(segments=40, base=(-1000.0, 0.0, angle)).loaded(*(turned(angle)[:2, :2] @ load))
    np.testing.assert_allclose(other.nodes, one.nodes @ turned(angle).T, atol=1e-9)
    assert other.s["base_moment"][2] == pytest.approx(one.s["base_moment"][2], rel=1e-10)


def test_a_translated_base_translates_a_free_needle():
    one = Bench(segments=40, curvature=1e-3).step()
    other = Bench(segments=40, curvature=1e-3).step().step(db_x=1.0, db_y=-0.7)
    np.testing.assert_allclose(other.nodes, one.nodes, atol=1e-12)
    np.testing.assert_allclose(other.s["base"], [-999.0, -0.7, 0.0])


@pytest.mark.parametrize("bevel", [1, -1])
def test_natural_curvature_is_an_arc_that_rolls_with_the_bevel(bevel):
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


def test_rolling_the_bevel_mirrors_the_bend():
    bench = Bench(segments=40, curvature=1e-3).step()
    before = bench.nodes
    bench.step(flip=True)
    assert bench.s["roll"] == np.pi
    np.testing.assert_allclose(bench.nodes, before * [1.0, -1.0, 1.0], atol=1e-12)


def guided(**constants):
    """A needle with a guide 40 mm in front of its base."""
    return Bench(**{**GUIDED, **constants}).step()


def test_guide_moves_the_needle_as_a_beam():
    """Small angles: force 3EI g/a³ at a = 40 mm, tip at g + 60 · 1.5 g/a."""
    bench = guided(guide_stiffness=1e5).step(dg_y=0.01)
    assert bench.converged
    assert bench.s["guide_force"][0] == pytest.approx(3.0 * 1000.0 * 0.01 / 40.0**3, rel=1e-3)
    assert bench.tip[1] == pytest.approx(0.01 * (1.0 + 1.5 * 60.0 / 40.0), rel=1e-3)


def test_guide_is_a_spring_beyond_its_clearance():
    """No force within ±c; beyond, the needle is c behind, except for the compliance of the guide."""
    bench = guided(clearance=0.5)
    for there in (0.49, -0.98, 0.98):
        bench.step(dg_y=there)
        assert abs(bench.s["guide"][0]) < 0.5
        assert bench.s["guide_force"][0] == 0.0
        np.testing.assert_array_equal(bench.tip[1:], 0.0)
    bench.step(dg_y=1.01)  # to 1.5
    at_guide = np.interp(40.0, *bench.nodes[:, :2].T)
    assert bench.s["guide_force"][0] > 0.0
    assert at_guide == pytest.approx(1.0 - bench.s["guide_force"][0] / 1e3, abs=1e-9)
    bench.step(dg_y=-3.0)  # to −1.5: the opposite wall
    assert bench.s["guide_force"][0] < 0.0
    assert np.interp(40.0, *bench.nodes[:, :2].T) == pytest.approx(-1.0, abs=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 2.0, -2.5])
def test_the_clearance_is_a_circle(angle):
    """In any direction no force up to c; beyond, towards the centre, as stiff as in the plane."""
    y, z = np.cos(angle), np.sin(angle)
    bench = guided(clearance=0.5).step(dg_y=0.4999 * y, dg_z=0.4999 * z)
    np.testing.assert_array_equal(bench.nodes[:, 1:], 0.0)
    assert not bench.s["guide_force"].any()
    bench.step(dg_y=0.5 * y, dg_z=0.5 * z)
    assert bench.converged
    flat = guided(clearance=0.5).step(dg_y=0.9999)
    assert flat.s["guide_force"][0] > 0.01
    np.testing.assert_allclose(bench.s["guide_force"], flat.s["guide_force"][0] * np.array([y, z]), rtol=1e-9)
    np.testing.assert_allclose(bench.nodes[:, 1:], flat.nodes[:, 1:2] * [y, z], atol=1e-12)


def test_the_needle_slides_through_its_guide_without_friction():
    """The guide's force is normal to the needle: its x component is −slope times its y component."""
    bench = guided(guide_stiffness=1e3)
    for _ in range(12):
        bench.step(dg_y=1.0)
    i = 0
    while bench.segments["node"][i + 1, 0] <= -960.0:
        i += 1
    push = bench.s["guide_force"][0]
    slope = np.tan(bench.turns[i])
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
