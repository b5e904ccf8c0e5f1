"""The constants of a needle whose tissue, bevel and bend an observer has estimated."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle.mechanics import law, spring
from flexneedle.mechanics.law import tables
from flexneedle.mechanics.model import Adaptation, Model, adapt, contact_nodes, pack, tissue_layers
from flexneedle.mechanics.work import CONTACT, GUIDE
from flexneedle.scenario.tissue.ogden import Ogden
from reference.interpreted import interpreted

PLAIN = interpreted(law, spring)
THICKNESS = (6.0, 3.5, np.inf)
MU = np.array([1e-3, 4e-3, 2e-3])
WIDTH = np.array([5.0, 2.0, 4.0])
EQUAL, UNLIKE = (20.0, 20.0, 20.0), (20.0, 10.0, 15.0)  # compression lengths
LAWS = tables(
    [
        Ogden(alpha=alpha, shear_modulus_kpa=1.0, compression_length_mm=1.0, engaged_width_mm=1.0)
        for alpha in (8.0, -3.0, 5.0)
    ]
)
CELLS = np.array([1.5, 0.7, 1.2, 0.4, 2.0, 0.9])
DEPTHS = (0.4, 2.0, 5.7, 6.2, 7.9, 10.1, 14.0)


def model_of(thickness=THICKNESS, law=(0, 0, 0), height=EQUAL, guide_x=-41.0):
    """Return a needle in three layers with contact points every mm down to 18 mm."""
    layers = tissue_layers(np.array(thickness), 3.0 * MU, np.array(height), WIDTH, np.array(law))
    nodes = contact_nodes(layers, np.array([1.0, 0.5, 0.7]), 1.0, 18.0, guide_x)
    return Model(4000.0, 150.0, 4.0, 3.0, nodes, layers, LAWS, 0.25, 3.0)


MODEL = model_of()
NODES = MODEL.nodes
CONTACTS = NODES["kind"] == CONTACT


def adaptation(shift=(0.0, 0.0), stiffness=(1.0, 1.0, 1.0), cell=1.0, variation=(1.0,), **others):
    return Adaptation(np.array(shift), np.array(stiffness), cell, np.array(variation), **others)


def ends_of(estimate):
    """Return the depths of the layers' boundaries; one pushes those below before it."""
    return np.maximum.accumulate(np.maximum(0.0, np.cumsum(THICKNESS[:2]) + estimate.shift))


def along(top, bottom, estimate, height=EQUAL):
    """Return ∫3μw/h dx over an interval, piece by piece between boundaries and cells."""
    ends, cells = ends_of(estimate), estimate.cell * np.arange(1, len(estimate.variation))
    cuts = [top, *(cut for cut in np.sort([*ends, *cells]) if top < cut < bottom), bottom]
    total = 0.0
    for first, last in pairwise(cuts):
        middle = 0.5 * (first + last)
        layer = int((middle >= ends).sum())
        cell = min(int(middle // estimate.cell), len(estimate.variation) - 1)
        factor = estimate.stiffness[layer] * estimate.variation[cell]
        total += 3.0 * MU[layer] * WIDTH[layer] / height[layer] * factor * (last - first)
    return total


def tip_spring(model, depth, u=0.7):
    """Return energy and both stiffnesses of the tip spring with the tip at a depth, sharpest law and least height."""
    packed = pack([model])
    w = SimpleNamespace(constants=model, layers=packed.layers[0], laws=packed.laws)
    return PLAIN.spring_energy(w, depth, depth, u), *PLAIN.spring_law(w, depth, depth, u)


ESTIMATES = {
    "boundary moved within an interval": adaptation(shift=(0.3, 0.0)),
    "both boundaries": adaptation(shift=(-1.4, 2.2), stiffness=(1.0, 1.3, 0.6)),
    "a boundary past the skin": adaptation(shift=(-7.0, 0.6), stiffness=(5.0, 1.3, 0.6)),
    "both past the skin": adaptation(shift=(-7.0, -20.0), stiffness=(5.0, 7.0, 0.6)),
    "a boundary past the next": adaptation(shift=(5.25, 0.0), stiffness=(0.8, 9.0, 0.6)),
    "the last cell has no end": adaptation(cell=2.0, variation=(1.0, 0.25)),
    "cells that divide intervals": adaptation(cell=2.4, variation=CELLS),
    "cells and boundaries": adaptation((0.6, -0.85), (2.0, 0.5, 1.5), 2.5, CELLS),
    "cells shorter than an interval": adaptation(shift=(0.45, 0.0), cell=0.3, variation=np.tile(CELLS, 8)),
}


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_contacts_and_tip_spring_have_the_tissue_along_their_intervals(estimate):
    """Stiffness ∫3μw/h dx, however the interval is divided; the spring is linear in that over the bevel's length."""
    changed = adapt(MODEL, estimate)
    expected = [
        along(node["x"] - node["reach"], node["x"] + node["reach"], estimate) for node in NODES[CONTACTS]
    ]
    np.testing.assert_allclose(changed.nodes["stiffness"][CONTACTS], expected, rtol=1e-9)
    one = np.array(tip_spring(model_of((30.0, 1.0, np.inf)), 10.0)[:3])
    for depth in DEPTHS:
        share = along(max(0.0, depth - 3.0), depth, estimate) / (3.0 * 3.0 * MU[0] * WIDTH[0] / 20.0)
        np.testing.assert_allclose(tip_spring(changed, depth)[:3], share * one, rtol=1e-9)
    end = changed.layers["end"]
    assert end[0] >= 0.0
    assert (end[1:] >= end[:-1]).all()
    assert end[-1] == np.inf


@pytest.mark.parametrize("cell", [0.35, 2.5, 40.0])
def test_no_shift_and_factors_of_one_are_the_model(cell):
    """Contacts and tip spring, however many cells divide the layers, with a separate law for each layer."""
    model = model_of(law=(0, 1, 2), height=UNLIKE)
    same = adapt(model, adaptation(cell=cell, variation=np.ones(9)))
    for name in model.nodes.dtype.names:
        np.testing.assert_allclose(same.nodes[name], model.nodes[name], rtol=1e-12, atol=1e-18, err_msg=name)
    assert (same.bevel_offset, same.curvature) == (model.bevel_offset, 0.0)
    for depth in DEPTHS:
        np.testing.assert_allclose(tip_spring(same, depth), tip_spring(model, depth), rtol=1e-12)


def test_the_law_of_a_contact_is_the_law_of_the_layer_at_its_middle():
    """Its stiffness is the stiffness of all layers in its interval."""
    estimate = adaptation(shift=(1.7, -1.0))
    changed = adapt(model_of(law=(0, 1, 2), height=UNLIKE, guide_x=None), estimate).nodes
    layer = np.searchsorted([7.7, 8.5], changed["x"], side="right")
    np.testing.assert_array_equal(changed["law"], layer)
    np.testing.assert_array_equal(changed["height"], np.array(UNLIKE)[layer])
    expected = [
        along(node["x"] - node["reach"], node["x"] + node["reach"], estimate, UNLIKE) for node in changed
    ]
    np.testing.assert_allclose(changed["stiffness"], expected, rtol=1e-9)


def test_bevel_offset_is_multiplied_and_the_bend_becomes_a_curvature():
    """A free needle of curvature κ = 2w/L² is w off the straight at its tip."""
    changed = adapt(MODEL, adaptation(bevel=1.5, bend=0.45))
    assert changed.bevel_offset == 6.0
    assert changed.curvature == pytest.approx(2.0 * 0.45 / 150.0**2, rel=1e-15)
    assert MODEL.curvature == 0.0


def test_nothing_else_changes_and_the_old_constants_stay():
    before = NODES.copy(), MODEL.layers.copy()
    estimate = adaptation((1.0, 1.0), (3.0, 0.1, 1.0), 2.0, CELLS, bevel=0.2, bend=-1.0)
    known = [array.copy() for array in (estimate.shift, estimate.stiffness, estimate.variation)]
    changed, guide = adapt(MODEL, estimate), NODES["kind"] == GUIDE
    now = NODES, MODEL.layers, estimate.shift, estimate.stiffness, estimate.variation
    for kept, array in zip((*before, *known), now, strict=True):
        np.testing.assert_array_equal(kept, array)
    assert guide.sum() == 1
    np.testing.assert_array_equal(changed.nodes[guide], NODES[guide])
    for name in ("x", "kind", "reach", "weight"):
        np.testing.assert_array_equal(changed.nodes[name], NODES[name])
    np.testing.assert_array_equal(changed.laws, LAWS)
    assert (changed.bending_stiffness, changed.length, changed.bevel_length) == (4000.0, 150.0, 3.0)


def test_a_single_layer_has_no_boundary():
    layers = tissue_layers(*(np.array([value]) for value in (np.inf, 3.0 * MU[0], 20.0, WIDTH[0], 0)))
    nodes = contact_nodes(layers, np.ones(1), 1.0, 8.0, None)
    estimate = Adaptation(np.zeros(0), np.array([2.0]), 4.0, np.array([1.0, 3.0]))
    changed = adapt(MODEL._replace(nodes=nodes, layers=layers), estimate)
    factor = np.where(nodes["x"] < 4.0, 2.0, 6.0)
    np.testing.assert_allclose(changed.nodes["stiffness"], factor * nodes["stiffness"], rtol=1e-12)
    np.testing.assert_array_equal(changed.layers["end"], [4.0, np.inf])
