"""The constants of a needle in layered tissue, as flat arrays for the kernels (docs/theory.md section 2)."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.ogden import law_scales

Floats = NDArray[np.float64]

CONTACT, ESSENTIAL, GUIDE = (
    0,
    1,
    2,
)  # kinds of node: a tissue spring, a prescribed lateral position, the guide's
# Edges of the intervals of the contact points just below the skin, in spacings. There the free needle is held by little
# but its tip: with even intervals and steps a thin one ends up to 0.3 mm off, with these 0.04 mm (decision 0014).
_SKIN_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5)
SKIN_ZONE = 3.0  # spacings from the skin in which a step is carried out in parts,
SKIN_PART = 0.25  # of this length, in spacings


class Nodes(NamedTuple):
    """What can load the needle, by increasing x: the guide, then the contact points (each array (n,)).

    x: position (mm); kind: CONTACT, ESSENTIAL or GUIDE; reach: length over which a contact grows in behind
    the tip (mm); alpha, height, force, energy: its law (`ogden`); weight: layer weight w_c.
    """

    x: Floats
    kind: NDArray[np.int8]
    reach: Floats
    alpha: Floats
    height: Floats
    force: Floats
    energy: Floats
    weight: Floats


class Layers(NamedTuple):
    """Tissue layers for the tip spring: depth of each layer's end (mm), its law for 1 mm of needle length."""

    end: Floats
    alpha: Floats
    height: Floats
    force: Floats
    energy: Floats


class Model(NamedTuple):
    """A needle in layered tissue: bending stiffness (N·mm²), length (mm), bevel offset and length (mm).

    curvature: of the free needle (1/mm), for bevel +1; it turns with the bevel. part, zone: length (mm) of the parts
    of a step down to the depth `zone` (mm); clearance: of the needle in the guide, to either side (mm);
    tolerance: estimated distance from equilibrium at which a solve ends (mm).
    """

    bending_stiffness: float
    length: float
    bevel_offset: float
    bevel_length: float
    nodes: Nodes
    layers: Layers
    part: float
    zone: float
    curvature: float = 0.0
    clearance: float = 0.0
    tolerance: float = 1e-7


def tissue_layers(
    thickness: Floats, shear_modulus: Floats, alpha: Floats, height: Floats, width: Floats
) -> Layers:
    """Layers from arrays (k,) in mm and MPa; the last one has no end, so its thickness is ignored."""
    end = np.append(np.cumsum(thickness[:-1]), np.inf)
    force, energy = law_scales(shear_modulus, alpha, height, width * height)
    return Layers(end, alpha, height, force, energy)


def contact_nodes(
    layers: Layers, weight: Floats, spacing: float, depth: float, guide_x: float | None
) -> Nodes:
    """The guide, if any, and a contact point in the middle of every `spacing` down to `depth` (all mm).

    Below the skin the intervals are shorter. An interval that a layer's end divides becomes two, so that the stiffness
    per length is exact at any spacing.
    """
    grid = (
        np.concatenate([_SKIN_EDGES, np.arange(SKIN_ZONE, max(np.ceil(depth / spacing), SKIN_ZONE) + 1.5)])
        * spacing
    )
    ends = layers.end[layers.end < grid[-1]]
    edges = np.union1d(grid, ends[np.abs(ends[:, None] - grid).min(axis=1, initial=np.inf) > 1e-6 * spacing])
    x, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    layer = np.searchsorted(layers.end, x, side="right")
    contacts = Nodes(
        x,
        np.full(x.size, CONTACT, dtype=np.int8),
        0.5 * length,
        layers.alpha[layer],
        layers.height[layer],
        layers.force[layer] * length,
        layers.energy[layer] * length,
        weight[layer],
    )
    return contacts if guide_x is None else insert_essential(contacts, np.array([guide_x]), GUIDE)


def insert_essential(nodes: Nodes, x: Floats, kind: int = ESSENTIAL) -> Nodes:
    """`nodes` with essential nodes of a kind added at `x` (mm), in order of x."""
    place = np.searchsorted(nodes.x, x)
    values: tuple[Any, ...] = (x, kind, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    arrays: tuple[Any, ...] = nodes
    return Nodes(*(np.insert(array, place, value) for array, value in zip(arrays, values, strict=True)))


class Adaptation(NamedTuple):
    """What an observer has estimated of a model's constants.

    shift (k − 1,): of the ends of all layers but the last (mm); stiffness (k,): factor on the modulus of each layer;
    cell: length (mm) of cells along the depth from the skin; variation (c,): further factor on the modulus in each,
    the last one has no end; bevel: factor on the bevel offset; bend: distance (mm) of the free needle's tip from the
    straight, for bevel +1, with which it turns; clearance: of the needle in the guide, to either side (mm).
    """

    shift: Floats
    stiffness: Floats
    cell: float = 1.0
    variation: Floats = np.ones(1)
    bevel: float = 1.0
    bend: float = 0.0
    clearance: float = 0.0


def adapted(model: Model, adaptation: Adaptation) -> Model:
    """The model with other constants, its contact points where they were.

    A contact is as stiff as the tissue along its interval; its law is that of the layer at its middle.
    """
    old, nodes = model.layers, model.nodes
    ends = np.maximum.accumulate(np.maximum(0.0, old.end[:-1] + adaptation.shift))
    cells = adaptation.cell * np.arange(1, adaptation.variation.size)
    bottoms = np.sort(np.concatenate([ends, cells]))
    tops = np.append(-np.inf, bottoms)
    layer = ends.searchsorted(tops, side="right")
    factor = adaptation.stiffness[layer] * adaptation.variation[cells.searchsorted(tops, side="right")]
    scales = old.force[layer] * factor, old.energy[layer] * factor
    at = ends.searchsorted(nodes.x, side="right")
    contact = nodes.kind == CONTACT
    law = old.alpha / old.height  # a force scale times this is a stiffness, which adds up whatever the laws
    force = _integral(bottoms, scales[0] * law[layer], nodes) / law[at]
    energy = force * (old.energy / old.force)[at]
    return model._replace(
        bevel_offset=model.bevel_offset * adaptation.bevel,
        nodes=nodes._replace(
            alpha=np.where(contact, old.alpha[at], nodes.alpha),
            height=np.where(contact, old.height[at], nodes.height),
            force=np.where(contact, force, nodes.force),
            energy=np.where(contact, energy, nodes.energy),
        ),
        layers=Layers(np.append(bottoms, np.inf), old.alpha[layer], old.height[layer], scales[0], scales[1]),
        curvature=2.0 * adaptation.bend / model.length**2,
        clearance=adaptation.clearance,
    )


def _integral(bottoms: Floats, density: Floats, nodes: Nodes) -> Floats:
    """Integral (n,) along the intervals of the contact points of a density (l,), constant in each layer."""
    tops = np.append(0.0, bottoms)
    before = np.append(0.0, np.cumsum(density[:-1] * np.diff(tops)))

    def up_to(x: Floats) -> Floats:
        inside = bottoms.searchsorted(x, side="right")
        total: Floats = before[inside] + density[inside] * (x - tops[inside])
        return total

    return up_to(nodes.x + nodes.reach) - up_to(nodes.x - nodes.reach)
