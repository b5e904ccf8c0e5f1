"""The constants of a needle whose modulus, bevel and bend an observer has learnt."""

import numpy as np
import pytest

from flexneedle.mechanics.model import CONTACT, ESSENTIAL, Model, adapted, contact_nodes, tissue_layers

LAYERS = tissue_layers(
    np.array([6.0, np.inf]), np.array([1e-3, 4e-3]), np.array([8.0, -3.0]), np.array([20.0, 10.0]),
    np.array([5.0, 2.0]),
)  # fmt: skip
NODES = contact_nodes(LAYERS, np.array([1.0, 0.5]), 1.0, 12.0, -41.0)
MODEL = Model(4000.0, 150.0, 4.0, 3.0, NODES, LAYERS)


def test_modulus_factors_are_those_of_the_points_layers():
    changed = adapted(MODEL, np.array([2.0, 0.5]), 1.0, 0.0)
    factor = np.where(NODES.x < 6.0, 2.0, 0.5)
    np.testing.assert_array_equal(changed.nodes.force, factor * NODES.force)
    np.testing.assert_array_equal(changed.nodes.energy, factor * NODES.energy)
    np.testing.assert_array_equal(changed.layers.force, [2.0, 0.5] * LAYERS.force)
    np.testing.assert_array_equal(changed.layers.energy, [2.0, 0.5] * LAYERS.energy)
    assert (NODES.kind == CONTACT).any()


def test_the_guide_is_no_tissue():
    guide = NODES.kind == ESSENTIAL
    assert guide.sum() == 1
    np.testing.assert_array_equal(adapted(MODEL, np.full(2, 9.0), 1.0, 0.0).nodes.force[guide], 0.0)


def test_bevel_offset_is_multiplied_and_the_bend_becomes_a_curvature():
    """A free needle of curvature κ = 2w/L² is w off the straight at its tip."""
    changed = adapted(MODEL, np.ones(2), 1.5, 0.45)
    assert changed.bevel_offset == 6.0
    assert changed.curvature == pytest.approx(2.0 * 0.45 / 150.0**2, rel=1e-15)
    assert MODEL.curvature == 0.0


def test_nothing_else_changes_and_the_old_constants_stay():
    before = [array.copy() for array in (*NODES, *LAYERS)]
    changed = adapted(MODEL, np.array([3.0, 0.1]), 0.2, -1.0)
    for kept, now in zip(before, (*NODES, *LAYERS), strict=True):
        np.testing.assert_array_equal(kept, now)
    for name in ("x", "kind", "reach", "alpha", "height", "weight"):
        np.testing.assert_array_equal(getattr(changed.nodes, name), getattr(NODES, name))
    for name in ("end", "alpha", "height"):
        np.testing.assert_array_equal(getattr(changed.layers, name), getattr(LAYERS, name))
    assert (changed.bending_stiffness, changed.length, changed.bevel_length) == (4000.0, 150.0, 3.0)


def test_factors_of_one_change_nothing():
    same = adapted(MODEL, np.ones(2), 1.0, 0.0)
    assert (same.bevel_offset, same.curvature) == (MODEL.bevel_offset, 0.0)
    np.testing.assert_array_equal(same.nodes.force, NODES.force)
