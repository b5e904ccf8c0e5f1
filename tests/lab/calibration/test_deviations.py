"""The Gaussian process of deviations against draws of its recursion, and its noise against drawn noise."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from flexneedle.lab.calibration.deviations import KINDS, Deviations, Noise, Whitened, estimate_noise

DEPTH = np.array([0.0, 4.0, 9.0, 15.0, 22.0, 30.0])
SLOPE = np.array([0.0, 0.05, -0.02, -0.02, 0.04, 0.03])
POSITION = np.array([0.0, 0.3, 0.2, 0.5, 0.4, 0.9])
QUIET = dict.fromkeys(KINDS, 0.0)


def path(known=None):
    moved = np.append(False, np.diff(SLOPE) != 0.0)
    deviations = Deviations(DEPTH, POSITION, SLOPE, moved)
    return Whitened(deviations, np.ones(12, dtype=bool) if known is None else known, np.ones(6))


def noise(**sd):
    return Noise(np.array([{**QUIET, **sd}[kind] for kind in KINDS]))


def drawn(rng, *, turn=0.0, response=0.0, shift=0.0, gain=0.0, curvature=0.0, position=0.0, slope=0.0):
    """Return residuals by the recursion of the module's docstring: e ← e + ξ dx + a, ξ ← ξ + b."""
    e = xi = 0.0
    found = [(0.0, 0.0)]
    u = np.diff(POSITION) - SLOPE[:-1] * np.diff(DEPTH)
    v = np.diff(SLOPE)
    whole = gain * rng.standard_normal()
    for dx, lateral, turned in zip(np.diff(DEPTH), u, v, strict=True):
        a = b = 0.0
        t, r, s = rng.standard_normal(3)
        a += turn * t * turned * dx + response * r * lateral + shift * s * turned + whole * lateral
        b += turn * t * turned + response * r * turned + whole * turned
        e, xi = e + xi * dx + a, xi + b
        found.append((e, xi))
    values = np.array(found).T
    x = DEPTH - DEPTH[0]
    bend = curvature * rng.standard_normal()
    values += np.stack([0.5 * bend * x**2, bend * x])
    values += np.array([[position], [slope]]) * rng.standard_normal((2, 6))
    return values.ravel()


@pytest.mark.parametrize(
    "sd",
    [
        {"turn": 0.3}, {"response": 0.4}, {"shift": 8.0}, {"gain": 0.2}, {"curvature": 1e-3},
        {"position": 0.1, "slope": 2e-3}, {"turn": 0.2, "shift": 5.0, "gain": 0.3, "position": 0.05},
    ],
)  # fmt: skip
def test_covariances_are_those_of_drawn_paths(sd):
    rng = np.random.default_rng(3)
    draws = np.array([drawn(rng, **sd) for _ in range(4000)])
    whitened = path()
    expected = whitened.covariance(noise(**sd)) - whitened.start
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected))) + 1e-12
    assert np.abs(np.cov(draws.T) - expected).max() < 0.12 * scale.max()
    np.testing.assert_allclose(np.diag(np.cov(draws.T)), np.diag(expected), rtol=0.12, atol=1e-9)


def test_a_random_walk_of_the_heading_spreads_with_the_cube_of_the_advance():
    covariance = path().covariance(noise(heading=2e-3)) - path().start
    np.testing.assert_allclose(np.diag(covariance)[:6], 2e-3**2 * DEPTH**3 / 3.0, atol=1e-15)
    np.testing.assert_allclose(np.diag(covariance)[6:], 2e-3**2 * DEPTH, atol=1e-15)


def test_noise_of_drawn_residuals_is_found_again():
    rng = np.random.default_rng(5)
    sd = {"response": 0.3, "position": 0.03, "slope": 1e-3}
    residuals = [drawn(rng, **sd) for _ in range(60)]
    found = dict(zip(KINDS, estimate_noise([path()] * 60, residuals, Noise.first()).sd, strict=True))
    for kind, value in sd.items():
        assert found[kind] == pytest.approx(value, rel=0.25), kind


def test_the_estimate_is_a_maximum_of_the_likelihood():
    rng = np.random.default_rng(6)
    residuals = [drawn(rng, shift=6.0, position=0.05, slope=1e-3) for _ in range(10)]
    found = estimate_noise([path()] * 10, residuals, Noise.first())

    def loss(logs):
        total = 0.0
        for left in residuals:
            covariance = path().covariance(Noise(np.exp(logs)))
            total += left @ np.linalg.solve(covariance, left) + np.linalg.slogdet(covariance)[1]
        return total

    slope = approx_fprime(np.log(found.sd), loss, 1e-5)
    free = found.sd > 2e-3  # the others end at their lower bounds
    assert np.abs(slope[free]).max() < 0.5


def test_an_interval_with_a_large_error_gets_a_larger_factor():
    rng = np.random.default_rng(7)
    residuals = drawn(rng, position=0.02, slope=1e-3)
    residuals[3:6] += 3.0  # a jump of the path in the third interval
    sd = noise(lateral=0.03, position=0.02, slope=1e-3)
    factors = path().with_factors_for(sd, residuals).factors
    assert factors[3] > 5.0
    assert factors[[1, 2, 4, 5]].max() < 2.0


def test_missing_readings_leave_the_others_covariance():
    known = np.ones(12, dtype=bool)
    known[[2, 8, 9]] = False
    sd = noise(turn=0.2, position=0.05, slope=1e-3)
    np.testing.assert_allclose(path(known).covariance(sd), path().covariance(sd)[known][:, known])
