"""Rigid registration: exact pairs, expected errors, rejection of unsuitable points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import (
    Rigid,
    fiducial_error,
    fit_rigid,
    identity,
    localisation_error,
    target_error,
)

seeds = st.integers(0, 2**32 - 1)


def random_map(rng, shift=1000.0):
    """A random rigid map, by QR of a Gaussian matrix."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return Rigid(q, rng.uniform(-shift, shift, 3))


def rotation_of(vector):
    """Rotation about a vector by its length (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@given(seeds, st.integers(3, 20))
def test_exact_pairs_give_the_exact_map(seed, count):
    rng = np.random.default_rng(seed)
    true, points = random_map(rng), rng.uniform(-50.0, 50.0, (count, 3))
    found = fit_rigid(points, true.apply(points))
    np.testing.assert_allclose(found.apply(points), true.apply(points), atol=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert fiducial_error(found, points, true.apply(points)) < 1e-9


def test_points_in_a_plane_do_not_give_a_reflection():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-50, 50, (6, 2)), np.zeros(6)])
    true = random_map(rng)
    noisy = true.apply(points) + rng.normal(0, 0.1, (6, 3))
    assert np.linalg.det(fit_rigid(points, noisy).rotation) == pytest.approx(1.0)


def test_no_other_rigid_map_has_a_smaller_residual():
    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (8, 3))
    targets = random_map(rng).apply(points) + rng.normal(0, 1.0, (8, 3))
    best = fit_rigid(points, targets)
    least = fiducial_error(best, points, targets)
    for _ in range(200):
        other = Rigid(
            rotation_of(rng.normal(0, 1e-3, 3)) @ best.rotation, best.translation + rng.normal(0, 0.05, 3)
        )
        assert fiducial_error(other, points, targets) >= least


def test_a_map_its_inverse_and_the_identity():
    rng = np.random.default_rng(3)
    first, second, points = random_map(rng), random_map(rng), rng.uniform(-9, 9, (4, 3))
    np.testing.assert_allclose(first.inverse().apply(first.apply(points)), points, atol=1e-9)
    np.testing.assert_allclose(
        second.after(first).apply(points), second.apply(first.apply(points)), atol=1e-9
    )
    np.testing.assert_array_equal(identity().apply(points), points)


def test_known_residual():
    """Four points of a square, one diagonal pair raised and the other lowered by 1 mm: the identity is the best map."""
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 50.0
    lifted = square + np.array([[0, 0, 1.0], [0, 0, -1], [0, 0, 1], [0, 0, -1]])
    found = fit_rigid(lifted, square)
    assert fiducial_error(found, lifted, square) == pytest.approx(1.0, abs=1e-3)


def test_expected_errors_agree_with_simulated_registrations():
    """RMS of FRE and TRE in thousands of registrations with a simulated localisation error, and the formulas."""
    rng = np.random.default_rng(4)
    fiducials = np.array([[0.0, 0, 0], [80, 0, 0], [0, 60, 0], [80, 60, 10], [40, 30, 40]])
    targets = np.array([[40.0, 30, 10], [200, 0, 0], [0, 0, -150]])
    error, runs = 0.3, 4000
    residuals, misses = np.zeros(runs), np.zeros((runs, 3))
    for k in range(runs):
        measured = fiducials + rng.normal(0.0, error / np.sqrt(3.0), fiducials.shape)
        found = fit_rigid(measured, fiducials)
        residuals[k] = fiducial_error(found, measured, fiducials)
        misses[k] = np.linalg.norm(found.apply(targets) - targets, axis=1)
    rms = np.sqrt(np.mean(residuals**2))
    assert localisation_error(rms, 5) == pytest.approx(error, rel=0.03)
    np.testing.assert_allclose(
        np.sqrt(np.mean(misses**2, axis=0)), target_error(fiducials, error, targets), rtol=0.04
    )


@pytest.mark.parametrize(
    ("moving", "message"),
    [
        (np.zeros((2, 3)), "2 pairs of points: a registration needs at least 3"),
        (np.outer([0.0, 1, 2, 3], [1.0, 2, 3]), "points are collinear"),
        (np.full((4, 3), np.nan), "finite"),
        (np.zeros((4, 2)), "pairs of x, y, z"),
    ],
)
def test_unsuitable_points_are_rejected(moving, message):
    with pytest.raises(InputError, match=message):
        fit_rigid(moving, moving.copy())
