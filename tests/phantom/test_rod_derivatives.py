"""Gradient and Hessian of the exact rod bent in space, and directions of its loads."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle.phantom.loads import Before
from reference.bent_rods import (
    PLAIN,
    SEGMENTS,
    TISSUE,
    assemble,
    assembled,
    crooked,
    differences,
    gradient_and_hessian,
    parts,
)
from reference.rods import Bench


def is_definite(bench, curved=1.0):
    """Assemble and sweep; return whether the Hessian is positive definite."""
    assemble(bench, curved)
    return PLAIN.sweep(*parts(bench), curved)


def newton_slope(bench):
    """Return the largest displacement in a Newton step, and the slope of the energy along it."""
    constants, _, w = parts(bench)
    return PLAIN.newton_step(constants, w), PLAIN.slope(constants, w)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0999, 0.1001, 1.0, 3.0, 3.14])
def test_the_logarithm_agrees_with_scipy(angle):
    axis = np.array([0.36, -0.48, 0.8])
    q = Rotation.from_rotvec(angle * axis).as_quat(scalar_first=True)
    for sign in (1.0, -1.0):
        phi, beta, slope = PLAIN.logarithm(tuple(sign * q))
        np.testing.assert_allclose(phi, angle * axis, atol=1e-15)
    if angle > 0.05:
        half = 0.5 * angle
        assert beta == pytest.approx((1.0 - half / np.tan(half)) / angle**2, rel=1e-12)
        shifted = [(1.0 - a / np.tan(a)) / (4.0 * a * a) for a in (half + 5e-6, half - 5e-6)]
        assert slope == pytest.approx((shifted[0] - shifted[1]) / 2e-5 / (2.0 * half), rel=1e-4)
    else:
        assert (beta, slope) == pytest.approx((1.0 / 12.0, 1.0 / 360.0), rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_forces_and_a_newton_step_are_derivatives_of_the_energy(seed):
    """Of needle, guide, tissue and load together, at angles of up to a radian; the step is −H⁻¹g."""
    bench = crooked(seed)
    frames, tangents = bench.segments["frame"][:-1].copy(), bench.segments["tangent"][:-1]
    assert (np.ptp(tangents, axis=0)[1:] > 0.1).all()
    gradient, hessian = gradient_and_hessian(bench)
    assert np.linalg.norm(bench.s["guide_force"]) > 0.3
    found = differences(lambda e: assembled(bench, frames, e.reshape(-1, 3))[0], 3 * SEGMENTS)
    np.testing.assert_allclose(gradient, found, rtol=1e-6, atol=1e-7 * np.abs(gradient).max())
    bench.segments["frame"][:-1] = frames
    assert is_definite(bench) == (np.linalg.eigvalsh(hessian)[0] > 0.0)
    if not is_definite(bench):
        return
    largest, slope = newton_slope(bench)
    step = bench.segments["step"][:-1]
    np.testing.assert_allclose(step.ravel(), -np.linalg.solve(hessian, gradient), rtol=1e-5, atol=1e-7)
    assert slope == pytest.approx(step.ravel() @ gradient, rel=1e-9)
    moved = np.cumsum(np.cross(step, bench.rod.segment * tangents), axis=0)
    rolls = np.abs((step * tangents).sum(axis=1))
    assert largest == pytest.approx(max(np.linalg.norm(moved, axis=1).max(), rolls.max()), rel=1e-9)


def test_most_crooked_rods_are_stable():
    """So that the steps above are compared."""
    assert sum(is_definite(crooked(seed)) for seed in range(3)) >= 2


@pytest.mark.parametrize("seed", range(2))
def test_the_gauss_newton_part_is_definite(seed):
    """Under a load many times the load in the other tests, with which the full Hessian is not."""
    bench = crooked(seed, load=(-60.0, 20.0, 10.0))
    assert not is_definite(bench)
    assert is_definite(bench, curved=0.0)
    assert newton_slope(bench)[1] < 0.0


def test_without_its_geometric_part_the_hessian_gives_a_descent_direction():
    """At three times Euler's load the full Hessian of a straight rod is indefinite."""
    bench = Bench(length=100.0, segments=SEGMENTS, curvature=1e-3)
    bench.s["load"] = -3.0 * np.pi**2 * 1000.0 / (4.0 * 100.0**2), 0.0, 0.0
    assert not is_definite(bench)
    assert is_definite(bench, curved=0.0)
    assert newton_slope(bench)[1] < 0.0


def test_forces_of_tissue_and_guide_are_normal_to_the_needle():
    """On each segment the force has no tangential component."""
    bench = crooked(1, load=(0.0, 0.0, 0.0))
    assemble(bench)
    force, tangent = bench.segments["force"][:-1], bench.segments["tangent"][:-1]
    assert (np.abs(force).max(axis=0) > 0.1).all()
    np.testing.assert_allclose((force * tangent).sum(axis=1), 0.0, atol=1e-12)


def test_the_bevels_force_is_normal_to_the_tip():
    """Law of the length in the tissue, ρ = b at the tip during insertion; zero 5 mm behind the front."""
    bench = crooked(2, guide=False, channel=False, load=(0.0, 0.0, 0.0))
    assemble(bench)
    np.testing.assert_array_equal(bench.segments["force"][-1], 0.0)
    bench.s["cut"] = 0.0
    assemble(bench)
    tangent, depth = bench.segments["tangent"][-2], bench.s["tip"][0]
    top = depth - 3.0 * tangent[0]
    cuts = [*(c for c in (14.0, 28.0) if top < c < depth)]
    expected = 0.0
    for above, below in zip([top, *cuts], [*cuts, depth], strict=True):
        c, length = int(0.5 * (above + below) / 14.0), (below - above) / tangent[0]
        table = TISSUE["laws"][TISSUE["law"][c]]
        secant, *_ = PLAIN._law(table, TISSUE["height"][c], TISSUE["foundation"][c] * length, 2.0)
        expected += 2.0 * secant
    direction = Rotation.from_quat(bench.segments["frame"][-2], scalar_first=True).apply([0.0, 1.0, 0.0])
    # The gradient: the tissue pushes the tip towards the bevel.
    np.testing.assert_allclose(bench.segments["force"][-1], -expected * direction, rtol=1e-9)
    assert expected > 0.1


def test_the_bevels_stiffness_is_the_derivative_of_its_force_across_the_tip():
    """By differences in a step that cuts 1 mm, with a rest point in another direction than the bevel."""
    bench = crooked(2, guide=False, channel=False, load=(0.0, 0.0, 0.0))
    bench.rod = bench.rod._replace(cell=1e3)
    s, w = bench.s, bench.segments
    t = s["tangent"].copy()
    across = np.linalg.svd(t[None])[2][1:]
    s["cut"], s["front"], s["front_tangent"] = 30.0, s["tip"] - t, t
    s["offset"] = 1.5 * across[0] - 0.8 * across[1]
    begun = Before(tuple(s["tip"] - t), tuple(t), float(s["twist"]), 0.0, 0.0)
    base = s["base"].copy()

    def force(shift):
        s["base"] = base + shift
        assemble(bench, begun=begun)
        return w["force"][-1].copy()

    found = np.array([(force(1e-5 * d) - force(-1e-5 * d)) / 2e-5 for d in across])
    force(0.0)
    xx, xy, xz, yy, yz, zz = w["pp"][-1]
    stiffness = across @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ across.T
    np.testing.assert_allclose(found @ across.T, stiffness, rtol=1e-6)
    apart = np.linalg.eigvalsh(stiffness)
    assert apart[1] > 1.01 * apart[0] > 0.0  # along the offset and across it
