"""The constants of a needle in layered tissue, as flat arrays for the kernels (docs/theory.md section 2)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import make_refusal
from flexneedle.mechanics.law import CELLS, PER_UNIT, ROWS
from flexneedle.mechanics.needle import to_parts
from flexneedle.mechanics.rollout import Models
from flexneedle.mechanics.work import CONTACT, ESSENTIAL, GUIDE

Floats = NDArray[np.float64]

# Edges of the intervals of the contact points just below the skin, in spacings. There the free needle is held by little
# but its tip: with even intervals and steps a thin one ends up to 0.3 mm off, with these 0.04 mm (decision 0014).
_SKIN_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5)
SKIN_ZONE = 3.0  # spacings from the skin in which a step is carried out in parts,
SKIN_PART = 0.25  # of this length, in spacings

Nodes = NDArray[Any]
"""Possible loads of the needle, by increasing x: the guide, then the contact points; an array (n,) of `NODE`."""
NODE = np.dtype(
    [
        ("x", np.float64),  # position (mm)
        ("reach", np.float64),  # length over which a contact grows in behind the tip (mm)
        ("height", np.float64),  # compression length (mm)
        ("stiffness", np.float64),  # initial stiffness (N/mm)
        ("weight", np.float64),  # layer weight w_c
        ("law", np.int64),  # index of its table
        ("kind", np.float64),  # CONTACT, ESSENTIAL or GUIDE
    ]
)

Layers = NDArray[Any]
"""Tissue layers from the skin down, for the tip spring; an array (l,) of `LAYER`."""
LAYER = np.dtype(
    [
        ("end", np.float64),  # depth (mm)
        ("height", np.float64),  # compression length (mm)
        ("stiffness", np.float64),  # initial stiffness of 1 mm of needle (N/mm)
        ("law", np.int64),  # index of its table
        ("channel", np.int64),  # index of the table along the channel
    ]
)


class Model(NamedTuple):
    """A needle in layered tissue."""

    bending_stiffness: float  # bending stiffness (N·mm²)
    length: float  # length (mm)
    bevel_offset: float  # offset of the bevel (mm)
    bevel_length: float  # length of the bevel (mm)
    nodes: Nodes  # possible loads
    layers: Layers
    laws: Floats  # tables of `law`
    part: float  # length (mm) of the parts of a step down to the depth `zone`
    zone: float  # depth (mm) to which steps have parts
    # lateral curvature of the free needle (1/mm), relative to the bevel's direction, with which it turns
    curvature: Any = 0.0
    clearance: float = 0.0  # clearance of the needle in the guide, to either side (mm)
    tolerance: float = 1e-7  # estimated distance from equilibrium at which a solve ends (mm)
    # largest distance (mm) by which a solved tip is moved along its own line to its depth
    slide: float = 2e-5


def records(dtype: np.dtype[Any], /, **columns: Any) -> NDArray[Any]:
    """Return an array of records (k,) from its columns."""
    array = np.zeros(np.broadcast_shapes(*(np.shape(column) for column in columns.values())), dtype)
    for name, column in columns.items():
        array[name] = column
    return array


def tissue_layers(
    thickness: Floats,
    modulus: Floats,
    height: Floats,
    width: Floats,
    law: NDArray[Any],
    channel: NDArray[Any] | None = None,
) -> Layers:
    """Return layers from arrays (k,) in mm and MPa; the last one has no end, so its thickness is ignored.

    modulus: initial modulus of compression; law: index of each layer's table, for the tip spring; channel: index of
    its table along the channel (default: the same).
    """
    end, along = np.append(np.cumsum(thickness[:-1]), np.inf), law if channel is None else channel
    return records(LAYER, end=end, height=height, stiffness=modulus * width / height, law=law, channel=along)


def contact_nodes(
    layers: Layers, weight: Floats, spacing: float, depth: float, guide_x: float | None
) -> Nodes:
    """Return the guide, if any, and a contact point in the middle of every `spacing` down to `depth` (all mm).

    Below the skin the intervals are shorter. An interval that a layer's end divides becomes two, so that the stiffness
    per length is exact at any spacing.
    """
    grid = (
        np.concatenate([_SKIN_EDGES, np.arange(SKIN_ZONE, max(np.ceil(depth / spacing), SKIN_ZONE) + 1.5)])
        * spacing
    )
    ends = layers["end"][layers["end"] < grid[-1]]
    edges = np.union1d(grid, ends[np.abs(ends[:, None] - grid).min(axis=1, initial=np.inf) > 1e-6 * spacing])
    x, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    at = layers["end"].searchsorted(x, side="right")
    layer = layers[at]
    contacts = records(
        NODE,
        x=x,
        reach=0.5 * length,
        height=layer["height"],
        stiffness=layer["stiffness"] * length,
        weight=weight[at],
        law=layer["channel"],
        kind=CONTACT,
    )
    return contacts if guide_x is None else insert_essential(contacts, np.array([guide_x]), GUIDE)


def with_channel_laws(model: Model, laws: Floats, place: Sequence[int]) -> Model:
    """Return the model with further laws, tables of `law`, at its contacts; the tip spring keeps its own.

    place: for each layer the index of its law.
    """
    nodes, layers = model.nodes.copy(), model.layers.copy()
    layers["channel"] = len(model.laws) + np.array(place)
    contact = nodes["kind"] == CONTACT
    at = layers["end"].searchsorted(nodes["x"][contact], side="right")
    nodes["law"][contact] = layers["channel"][at]
    return model._replace(nodes=nodes, layers=layers, laws=np.concatenate([model.laws, laws]))


def insert_essential(nodes: Nodes, x: Floats, kind: float = ESSENTIAL) -> Nodes:
    """Return `nodes` with essential nodes of a kind added at `x` (mm), in order of x."""
    added = records(NODE, x=x, reach=1.0, height=1.0, kind=kind)
    return np.insert(nodes, nodes["x"].searchsorted(x), added)


class Adaptation(NamedTuple):
    """Changes of a model's constants.

    shift (k − 1,): of the ends of all k layers but the last, mm. stiffness (k,): factors on the moduli. cell: length of
    cells along the depth from the skin, mm. variation (c,): further factors in the cells, of which the last has no end.
    bevel: factor on the bevel's offset. bend: lateral distance of the free needle's tip from the straight, mm (in space
    y + iz), relative to the bevel's direction, with which it turns. clearance: of the needle in the guide, to either
    side, mm; None: as before.
    """

    shift: Floats
    stiffness: Floats
    cell: float = 1.0
    variation: Floats = np.ones(1)
    bevel: float = 1.0
    bend: Any = 0.0
    clearance: float | None = None


def check_adaptation(model: Model, adaptation: Adaptation) -> Adaptation:
    """Return changes with values of floats; InputError, with the rule, for changes that the model cannot take."""
    layers, space = model.layers.size, isinstance(model.curvature, complex)
    shapes = {"shift": (layers - 1,), "stiffness": (layers,), "variation": None}
    checked: dict[str, Any] = {}
    for name, given in adaptation._asdict().items():
        if name == "clearance" and given is None:
            continue
        shape = shapes.get(name, ())
        try:
            values = np.array(given, dtype=complex if name == "bend" and space else float)
        except (TypeError, ValueError):
            rule = "must be numbers" if name == "bend" and space else "must be real numbers"
            raise make_refusal(name, given, rule) from None
        if values.shape != shape if shape is not None else values.ndim != 1 or not values.size:
            rule = "must be a number" if shape == () else f"must be an array {shape or '(c,), c at least 1'}"
            raise make_refusal(name, given, rule)
        if not np.isfinite(values).all():
            raise make_refusal(name, given, "must be finite")
        if name in ("stiffness", "variation", "cell") and not (values > 0.0).all():
            raise make_refusal(name, given, "must be above 0")
        if name in ("bevel", "clearance") and values < 0.0:
            raise make_refusal(name, given, "must be at least 0")
        checked[name] = values if shape != () else values.item()
    return Adaptation(**checked)


def adapt(model: Model, adaptation: Adaptation) -> Model:
    """Return the model with other constants and its contact points in place."""
    same = (
        not adaptation.shift.any()
        and (adaptation.stiffness == 1.0).all()
        and (adaptation.variation == 1.0).all()
    )
    tissue = model if same else _adapt_tissue(model, adaptation)
    return adapt_needle(tissue, adaptation.bevel, adaptation.bend, adaptation.clearance)


def adapt_needle(model: Model, bevel: float, bend: Any, clearance: float | None) -> Model:
    """Return the model with another needle; arguments as of `Adaptation`."""
    return model._replace(
        bevel_offset=model.bevel_offset * bevel,
        # Of one type with and without an adaptation, so that kernels are compiled once.
        curvature=type(model.curvature)(2.0 * bend / model.length**2),
        clearance=model.clearance if clearance is None else usable_clearance(clearance, model.slide),
    )


def usable_clearance(clearance: float, tolerance: float) -> float:
    """Return a clearance (mm), or 0 below the tolerance of a solve: the side that the needle bears on is rounding."""
    return clearance if clearance > tolerance else 0.0


def _adapt_tissue(model: Model, adaptation: Adaptation) -> Model:
    """Return the model with other tissue.

    A contact is as stiff as the tissue along its interval; its law is the law of the layer at its middle.
    """
    old, nodes = model.layers, model.nodes
    ends = np.maximum.accumulate(np.maximum(0.0, old["end"][:-1] + adaptation.shift))
    cells = adaptation.cell * np.arange(1, adaptation.variation.size)
    bottoms = np.sort(np.concatenate([ends, cells]))
    tops = np.concatenate([[-np.inf], bottoms])
    layer = ends.searchsorted(tops, side="right")
    layers = old[layer]
    variation = adaptation.variation[cells.searchsorted(tops, side="right")]
    layers["stiffness"] *= adaptation.stiffness[layer] * variation
    layers["end"][:-1], layers["end"][-1] = bottoms, np.inf
    at, contact = old[ends.searchsorted(nodes["x"], side="right")], nodes["kind"] == CONTACT
    changed, stiffness = nodes.copy(), _integral(bottoms, layers["stiffness"], nodes)
    for name, values in (("stiffness", stiffness), ("height", at["height"]), ("law", at["channel"])):
        changed[name] = np.where(contact, values, nodes[name])
    return model._replace(nodes=changed, layers=layers)


def _integral(bottoms: Floats, density: Floats, nodes: Nodes) -> Floats:
    """Return the integral (n,) along the intervals of the contact points of a density (l,), constant in each layer."""
    tops = np.concatenate([[0.0], bottoms])
    before = np.concatenate([[0.0], np.cumsum(density[:-1] * (bottoms - tops[:-1]))])
    ends = nodes["x"] + np.multiply.outer((-1.0, 1.0), nodes["reach"])
    inside = bottoms.searchsorted(ends, side="right")
    first, last = before[inside] + density[inside] * (ends - tops[inside])
    return last - first


# ---- models as arrays of numbers, for kernels


def pack(models: Sequence[Model]) -> Models:
    """Return models, M of them, as arrays of kernels; those with few nodes or layers get more that have no effect."""
    n, depth = max(one.nodes.size for one in models), max(one.layers.size for one in models)
    laws, first, rows = [], {}, 0
    for one in models:
        if id(one.laws) not in first:
            first[id(one.laws)] = rows
            laws.append(one.laws.reshape(-1, one.laws.shape[-1]))
            rows += len(laws[-1])
    apart = {(id(one.nodes), id(one.layers), id(one.laws)): one for one in models}
    tissues = {
        key: (_node_columns(one, n, first[key[2]]), _layer_columns(one, depth, first[key[2]]))
        for key, one in apart.items()
    }
    nodes, layers = zip(
        *(tissues[id(one.nodes), id(one.layers), id(one.laws)] for one in models), strict=True
    )
    axes = 2 if isinstance(models[0].curvature, complex) else 1
    return Models(
        np.array([_constants(one) for one in models]),
        to_parts(np.array([one.curvature for one in models]), axes),
        np.array(nodes),
        np.array(layers),
        np.concatenate(laws) if len(laws) > 1 else laws[0],
    )


_BEYOND = (np.inf, 1.0, 1.0, 0.0, 1.0, 0.0, CONTACT, 0.0)  # a node that no tip comes to


def _constants(one: Model) -> tuple[float, ...]:
    bevel = one.bevel_offset, one.bevel_length
    exact = one.clearance, one.tolerance, one.slide
    return 1.0 / one.bending_stiffness, one.length, *bevel, one.part, one.zone, *exact


def _node_columns(one: Model, size: int, first: int) -> Floats:
    """Return the nodes (size, 8) in the columns of `work`; added ones are beyond any tip."""
    nodes, columns = one.nodes, np.empty((size, 8))
    law, contact = nodes["law"], nodes["kind"] == CONTACT
    columns[nodes.size :] = _BEYOND
    own = columns[: nodes.size].T
    own[0], own[1], own[2] = nodes["x"], 1.0 / nodes["reach"], nodes["height"]
    own[3] = nodes["stiffness"] * contact
    own[4] = one.laws[law, CELLS, PER_UNIT] / nodes["height"] * contact
    own[5], own[6], own[7] = first + ROWS * law, nodes["kind"], nodes["weight"]
    return columns


def _layer_columns(one: Model, size: int, first: int) -> Floats:
    """Return the layers (size, 5) in the columns of `work`; added ones are below the last, which has no end."""
    layers, columns = one.layers, np.empty((size, 5))
    columns[layers.size :] = np.inf, 1.0, 0.0, 1.0, 0.0
    own = columns[: layers.size].T
    own[0], own[1], own[2] = layers["end"], layers["height"], layers["stiffness"]
    own[3] = one.laws[layers["law"], CELLS, PER_UNIT] / layers["height"]
    own[4] = first + ROWS * layers["law"]
    return columns
