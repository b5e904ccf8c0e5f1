"""Positions of contact points, and their division at the end of a layer."""

import numpy as np
import pytest

from flexneedle.mechanics.model import contact_nodes, insert_essential, tissue_layers
from flexneedle.mechanics.work import CONTACT

MU = np.array([1.0e-3, 4.0e-3])
LAW = np.array([0, 1])
HEIGHT = np.array([20.0, 10.0])
WIDTH = np.array([5.0, 2.0])


def nodes(spacing, depth, thickness, guide_x=None):
    """Return the contact points of two layers."""
    layers = tissue_layers(np.array([thickness, np.inf]), 3.0 * MU, HEIGHT, WIDTH, LAW)
    return contact_nodes(layers, np.array([1.0, 0.5]), spacing, depth, guide_x)


def test_points_are_in_the_middle_of_intervals():
    """Of Δ/4 down to Δ, of Δ/2 down to 3Δ, of Δ below; growing in over half of them."""
    grid = nodes(2.0, 13.0, 4.0)
    np.testing.assert_allclose(grid["x"][:4], [0.25, 0.75, 1.25, 1.75])
    np.testing.assert_allclose(grid["reach"][:4], 0.25)
    np.testing.assert_allclose(grid["x"][4:8], [2.5, 3.5, 4.5, 5.5])
    np.testing.assert_allclose(grid["reach"][4:8], 0.5)
    np.testing.assert_allclose(grid["x"][8:12], [7.0, 9.0, 11.0, 13.0])
    np.testing.assert_allclose(grid["reach"][8:], 1.0)
    assert grid["x"][-1] > 13.0


def test_layer_end_divides_an_interval():
    """Two points, each in the middle of its part, with its layer's law, weight and length."""
    grid = nodes(2.0, 15.0, 10.5)
    np.testing.assert_allclose(grid["x"][9:13], [9.0, 10.25, 11.25, 13.0])
    np.testing.assert_allclose(grid["reach"][9:13], [1.0, 0.25, 0.75, 1.0])
    np.testing.assert_array_equal(grid["law"][9:13], [0, 0, 1, 1])
    np.testing.assert_array_equal(grid["height"][9:13], [20.0, 20.0, 10.0, 10.0])
    length = np.array([2.0, 0.5, 1.5, 2.0])
    stiffness = np.repeat(3 * MU * WIDTH / HEIGHT, 2)
    np.testing.assert_allclose(grid["stiffness"][9:13], stiffness * length)
    np.testing.assert_allclose(grid["weight"][9:13], [1.0, 1.0, 0.5, 0.5])


@pytest.mark.parametrize("spacing", [0.3, 2.0, 3.7])
@pytest.mark.parametrize("thickness", [0.05, 4.5, 7.77])
def test_stiffness_of_a_layer_is_exact_at_any_spacing(spacing, thickness):
    """The points above a layer's end carry 3μw/h times its thickness."""
    grid = nodes(spacing, 20.0, thickness)
    first = grid["stiffness"][grid["law"] == 0].sum()
    assert first == pytest.approx(3 * MU[0] * WIDTH[0] / HEIGHT[0] * thickness, rel=1e-9)
    assert 2 * grid["reach"].sum() == pytest.approx(grid["x"][-1] + grid["reach"][-1], rel=1e-12)


def test_guide_and_measured_points_are_essential_nodes_in_order():
    """The guide is before the skin, a measured point among the contacts."""
    grid = insert_essential(nodes(1.0, 3.0, 2.0, guide_x=-41.0), np.array([-5.0, 1.7]))
    assert np.all(np.diff(grid["x"]) > 0)
    np.testing.assert_array_equal(grid["x"][grid["kind"] != CONTACT], [-41.0, -5.0, 1.7])
    assert (grid["kind"] == CONTACT).sum() == grid.size - 3
