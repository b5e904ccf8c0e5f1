"""The constants of a needle whose tissue, bevel and bend an observer has estimated."""

import numpy as np
import pytest

from flexneedle.mechanics import spring
from flexneedle.mechanics.law import tables
from flexneedle.mechanics.model import (
    CONTACT,
    GUIDE,
    Adaptation,
    Model,
    adapt,
    contact_nodes,
    tissue_layers,
)
from flexneedle.scenario.tissue.ogden import Ogden

THICKNESS = (6.0, 3.5, np.inf)
MU = np.array([1e-3, 4e-3, 2e-3])
HEIGHT, WIDTH = 20.0, np.array([5.0, 2.0, 4.0])
ALPHAS = (8.0, -3.0, 5.0)
LAWS = tables(
    [
        Ogden(alpha=alpha, shear_modulus_kpa=1.0, compression_length_mm=1.0, engaged_width_mm=1.0)
        for alpha in ALPHAS
    ]
)


def tissue(thickness=THICKNESS, law=(0, 0, 0), height=(HEIGHT,) * 3):
    return tissue_layers(np.array(thickness), 3.0 * MU, np.array(height), WIDTH, np.array(law))


LAYERS = tissue()
NODES = contact_nodes(LAYERS, np.array([1.0, 0.5, 0.7]), 1.0, 18.0, -41.0)
CONTACTS = NODES["kind"] == CONTACT
MODEL = Model(4000.0, 150.0, 4.0, 3.0, NODES, LAYERS, LAWS, 0.25, 3.0)
NO_SHIFT = np.zeros(2)
ONES = np.ones(3)
CELLS = np.array([1.5, 0.7, 1.2, 0.4, 2.0, 0.9])


def adaptation(shift=(0.0, 0.0), stiffness=(1.0, 1.0, 1.0), cell=1.0, variation=(1.0,), **others):
    return Adaptation(np.array(shift), np.array(stiffness), cell, np.array(variation), **others)


def modulus_width(x, estimate):
    """Modulus times width at a depth, layer by layer and cell by cell; a boundary pushes those below before it."""
    boundary, layer = 0.0, 0
    for k in range(2):
        boundary = max(boundary, sum(THICKNESS[: k + 1]) + estimate.shift[k])
        layer = k + 1 if x >= boundary else layer
    cell = min(int(x // estimate.cell), len(estimate.variation) - 1)
    return MU[layer] * WIDTH[layer] * estimate.stiffness[layer] * estimate.variation[cell]


def along(top, bottom, estimate, parts=4000):
    """Its integral over an interval by the rule of the middle, to 1e-3 of the interval's value or so."""
    width = (bottom - top) / parts
    return sum(modulus_width(top + (k + 0.5) * width, estimate) for k in range(parts)) * width


ESTIMATES = {
    "boundary moved within an interval": adaptation(shift=(0.3, 0.0)),
    "both boundaries": adaptation(shift=(-1.4, 2.2), stiffness=(1.0, 1.3, 0.6)),
    "a boundary past the skin": adaptation(shift=(-7.0, 0.6), stiffness=(5.0, 1.3, 0.6)),
    "both past the skin": adaptation(shift=(-7.0, -20.0), stiffness=(5.0, 7.0, 0.6)),
    "a boundary past the next": adaptation(shift=(5.25, 0.0), stiffness=(0.8, 9.0, 0.6)),
    "cells that divide intervals": adaptation(cell=2.4, variation=CELLS),
    "cells and boundaries": adaptation(
        shift=(0.6, -0.85), stiffness=(2.0, 0.5, 1.5), cell=2.5, variation=CELLS
    ),
    "cells shorter than an interval": adaptation(shift=(0.45, 0.0), cell=0.3, variation=np.tile(CELLS, 8)),
}


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_a_contact_has_the_tissue_along_its_interval(estimate):
    """Stiffness ∫3μw/h dx, whatever divides the interval."""
    nodes = adapt(MODEL, estimate).nodes
    for node, stiffness in zip(NODES[CONTACTS], nodes["stiffness"][CONTACTS], strict=True):
        expected = along(node["x"] - node["reach"], node["x"] + node["reach"], estimate, 1000)
        assert stiffness == pytest.approx(3.0 / HEIGHT * expected, rel=4e-3)


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_all_contacts_together_have_all_of_the_tissue(estimate):
    end = NODES["x"][-1] + NODES["reach"][-1]
    expected = 3.0 / HEIGHT * along(0.0, end, estimate, 38_000)
    assert adapt(MODEL, estimate).nodes["stiffness"][CONTACTS].sum() == pytest.approx(expected, rel=2e-4)


def tip_spring(model, depth, u=0.7):
    """Energy and both stiffnesses of the tip spring with the tip at a depth, the sharpest law and least height."""
    return spring.spring_energy(model, depth, depth, u), *spring.spring_law(model, depth, depth, u)


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_the_tip_spring_is_that_of_the_tissue_along_the_bevel(estimate):
    """It is linear in ∫μw dx over the bevel's length, in which any number of boundaries may lie."""
    model = adapt(MODEL, estimate)
    one = tip_spring(MODEL._replace(layers=tissue((30.0, 1.0, np.inf))), 10.0)
    per_tissue = np.array(one[:3]) / (3.0 * MU[0] * WIDTH[0])
    for depth in (0.4, 2.0, 5.7, 6.2, 7.9, 10.1, 14.0):
        expected = per_tissue * along(max(0.0, depth - 3.0), depth, estimate)
        np.testing.assert_allclose(tip_spring(model, depth)[:3], expected, rtol=3e-3)


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_no_layer_begins_above_the_skin_or_ends_before_it_begins(estimate):
    end = adapt(MODEL, estimate).layers["end"]
    assert end[0] >= 0.0
    assert (end[1:] >= end[:-1]).all()
    assert end[-1] == np.inf


@pytest.mark.parametrize("cell", [0.35, 1.0, 2.5, 7.0, 40.0])
def test_no_shift_and_factors_of_one_are_the_model(cell):
    """Contacts and tip spring, however many cells divide the layers, laws of the layers' own included."""
    layers = tissue(law=(0, 1, 2), height=(20.0, 10.0, 15.0))
    nodes = contact_nodes(layers, np.array([1.0, 0.5, 0.7]), 1.0, 18.0, -41.0)
    model = MODEL._replace(nodes=nodes, layers=layers)
    same = adapt(model, adaptation(cell=cell, variation=np.ones(9)))
    for name in nodes.dtype.names:
        np.testing.assert_allclose(same.nodes[name], nodes[name], rtol=1e-12, atol=1e-18, err_msg=name)
    assert (same.bevel_offset, same.curvature) == (model.bevel_offset, 0.0)
    for depth in (0.3, 2.9, 6.5, 8.0, 9.6, 10.5, 17.0):
        np.testing.assert_allclose(tip_spring(same, depth), tip_spring(model, depth), rtol=1e-12)


def test_modulus_factors_are_those_of_the_points_layers():
    factors = np.array([2.0, 0.5, 3.0])
    changed = adapt(MODEL, adaptation(stiffness=factors))
    factor = factors[np.searchsorted([6.0, 9.5], NODES["x"])]
    np.testing.assert_allclose(changed.nodes["stiffness"], factor * NODES["stiffness"], rtol=1e-12)
    np.testing.assert_array_equal(changed.layers["end"], LAYERS["end"])
    np.testing.assert_array_equal(changed.layers["stiffness"], factors * LAYERS["stiffness"])


def test_the_last_cell_goes_on():
    changed = adapt(MODEL, adaptation(cell=2.0, variation=(1.0, 0.25)))
    deep = CONTACTS & (NODES["x"] > 2.0)
    np.testing.assert_allclose(changed.nodes["stiffness"][deep], 0.25 * NODES["stiffness"][deep], rtol=1e-12)
    assert changed.layers["end"][-1] == np.inf
    assert changed.layers["stiffness"][-1] == 0.25 * LAYERS["stiffness"][-1]


def test_the_law_of_a_contact_is_that_of_the_layer_at_its_middle():
    layers = tissue(law=(0, 1, 2), height=(20.0, 10.0, 15.0))
    nodes = contact_nodes(layers, ONES, 1.0, 18.0, None)
    changed = adapt(MODEL._replace(nodes=nodes, layers=layers), adaptation(shift=(1.7, -1.0))).nodes
    layer = np.searchsorted([7.7, 8.5], changed["x"], side="right")
    np.testing.assert_array_equal(changed["law"], layer)
    np.testing.assert_array_equal(changed["height"], np.array([20.0, 10.0, 15.0])[layer])


def test_the_guide_is_no_tissue():
    guide = NODES["kind"] == GUIDE
    assert guide.sum() == 1
    changed = adapt(MODEL, adaptation(shift=(-7.0, 0.0), stiffness=np.full(3, 9.0))).nodes
    np.testing.assert_array_equal(changed[guide], NODES[guide])


def test_bevel_offset_is_multiplied_and_the_bend_becomes_a_curvature():
    """A free needle of curvature κ = 2w/L² is w off the straight at its tip."""
    changed = adapt(MODEL, adaptation(bevel=1.5, bend=0.45))
    assert changed.bevel_offset == 6.0
    assert changed.curvature == pytest.approx(2.0 * 0.45 / 150.0**2, rel=1e-15)
    assert MODEL.curvature == 0.0


def test_nothing_else_changes_and_the_old_constants_stay():
    before = NODES.copy(), LAYERS.copy()
    estimate = adaptation((1.0, 1.0), (3.0, 0.1, 1.0), 2.0, CELLS, bevel=0.2, bend=-1.0)
    known = [array.copy() for array in (estimate.shift, estimate.stiffness, estimate.variation)]
    changed = adapt(MODEL, estimate)
    for kept, now in zip(before, (NODES, LAYERS), strict=True):
        np.testing.assert_array_equal(kept, now)
    for kept, now in zip(known, (estimate.shift, estimate.stiffness, estimate.variation), strict=True):
        np.testing.assert_array_equal(kept, now)
    for name in ("x", "kind", "reach", "weight"):
        np.testing.assert_array_equal(changed.nodes[name], NODES[name])
    np.testing.assert_array_equal(changed.laws, LAWS)
    assert (changed.bending_stiffness, changed.length, changed.bevel_length) == (4000.0, 150.0, 3.0)


def test_a_single_layer_has_no_boundary():
    layers = tissue_layers(*(np.array([value]) for value in (np.inf, 3.0 * MU[0], HEIGHT, WIDTH[0], 0)))
    nodes = contact_nodes(layers, np.ones(1), 1.0, 8.0, None)
    model = MODEL._replace(nodes=nodes, layers=layers)
    changed = adapt(model, Adaptation(np.zeros(0), np.array([2.0]), 4.0, np.array([1.0, 3.0])))
    factor = np.where(nodes["x"] < 4.0, 2.0, 6.0)
    np.testing.assert_allclose(changed.nodes["stiffness"], factor * nodes["stiffness"], rtol=1e-12)
    np.testing.assert_array_equal(changed.layers["end"], [4.0, np.inf])


@pytest.mark.parametrize("unlike", [{"law": (0, 2, 2)}, {"height": (20.0, 10.0, 15.0)}, {"law": (0, 1, 2)}])
def test_a_contact_between_unlike_layers_has_the_stiffness_of_both(unlike):
    """∫3μw/h dx in the interval that a displaced boundary divides."""
    layers = tissue(**unlike)
    nodes = contact_nodes(layers, ONES, 1.0, 18.0, None)
    changed = adapt(MODEL._replace(nodes=nodes, layers=layers), adaptation(shift=(0.4, 0.0))).nodes
    i = int(np.flatnonzero(np.isclose(changed["x"], 6.5))[0])
    height = unlike.get("height", (HEIGHT,) * 3)
    expected = 3.0 * (0.4 * MU[0] * WIDTH[0] / height[0] + 0.6 * MU[1] * WIDTH[1] / height[1])
    assert changed["stiffness"][i] == pytest.approx(expected, rel=1e-9)
