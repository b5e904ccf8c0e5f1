"""Equal arc lengths and beam energy of a curve of cubics."""

import numpy as np
import pytest
from scipy.integrate import quad

from flexneedle.mechanics.shape import beam_energy, equal_arc_nodes


def cubic(x):
    """A needle of slope up to 0.2, and its slope."""
    return 2e-5 * x**3 - 1e-3 * x**2 + 0.05 * x, 6e-5 * x**2 - 2e-3 * x + 0.05


def arc(end):
    """∫(1 + ½y'²) dx from 0."""
    return quad(lambda x: 1 + cubic(x)[1] ** 2 / 2, 0, end, epsabs=1e-12)[0]


@pytest.mark.parametrize("n", [2, 3, 61])
@pytest.mark.parametrize("knots", [[0.0, 80.0], [0.0, 1e-9, 3.0, 3.0, 50.0, 80.0]])
def test_nodes_lie_on_the_curve_at_equal_arc_lengths(n, knots):
    """Also with spans of no length and of a millionth."""
    x = np.array(knots)
    nodes = equal_arc_nodes(x, *cubic(x), n)
    np.testing.assert_allclose(nodes[:, 1:], np.stack(cubic(nodes[:, 0]), axis=1), atol=1e-12)
    np.testing.assert_allclose([arc(end) for end in nodes[:, 0]], np.linspace(0, arc(80.0), n), atol=1e-9)


def test_beam_energy_is_half_the_moment_squared_over_stiffness():
    """Against a numerical integral of a moment that falls along each span."""
    x, shear, moment = np.array([0.0, 2.0, 7.0]), np.array([0.3, -0.2]), np.array([1.5, 0.9])
    pieces = [
        quad(lambda t, v=v, m=m: (m - v * t) ** 2, 0, b - a)[0]
        for a, b, v, m in zip(x[:-1], x[1:], shear, moment, strict=True)
    ]
    assert beam_energy(x, shear, moment, 400.0) == pytest.approx(sum(pieces) / 800.0, rel=1e-12)
