"""The sweep from the tip back to the base: positions, forces and compressions (docs/theory.md section 3).

Force and moment follow from the equilibrium of each span, position and slope from eq. 6.
"""

from typing import NamedTuple

from flexneedle.mechanics.compile import inner, shared
from flexneedle.mechanics.iteration import Iteration, judge
from flexneedle.mechanics.lanes import least, load, most, opposite, select, some, store
from flexneedle.mechanics.lateral import Lateral, dot, square, times
from flexneedle.mechanics.sweep_out import Tip

from flexneedle.mechanics.work import (  # isort: skip
    A1, A2, B11, B12, B22, CHANGED, CONTACT, FIXED, FORCE, G1, G2, HEIGHT, HELD, K, KIND, LOAD, MOMENT,
    REST, SHARE, SHARPNESS, SHEAR, SLOPE, TURNING, U, X, Y, Needles,
)  # fmt: skip


class Right(NamedTuple):
    """The part of the needle right of x: loads and slope at x, and of all of it shortening and worst `judge`."""

    x: float
    slope: Lateral
    shear: Lateral
    moment: Lateral
    shortening: float  # times 15 during the sweep
    error: float
    fraction: float


class Node(NamedTuple):
    """Solution of an iteration at a node: position, slope, force (N) and compression (mm)."""

    y: Lateral
    slope: Lateral
    force: Lateral
    u: Lateral


@inner
def _add_span(right: Right, x: float, slope: Lateral, bend: Lateral, flexibility: float) -> Right:
    """Return the part of the needle that is longer by a span without load, from x with this slope.

    Its y' is a parabola, for which the shortening ½∫|y'|² dx is exact.
    """
    length = right.x - x
    half = 0.5 * length
    middle = (
        right.slope
        - times(half * flexibility, right.moment)
        - times(0.125 * length * length * flexibility, right.shear)
        - times(half, bend)
    )
    shortening = length * (
        square(slope)
        + 4.0 * square(middle)
        + square(right.slope)
        + dot(middle, slope + right.slope)
        - 0.5 * dot(slope, right.slope)
    )
    return Right(
        x,
        slope,
        right.shear,
        right.moment + times(length, right.shear),
        right.shortening + shortening,
        right.error,
        right.fraction,
    )


@inner
def _add_node(right: Right, force: Lateral, error: float, fraction: float) -> Right:
    """Return the part of the needle with a node's force at its end."""
    return Right(
        right.x,
        right.slope,
        right.shear + force,
        right.moment,
        right.shortening,
        most(right.error, error),
        least(right.fraction, fraction),
    )


@inner
def _pose(w: Needles, i: int, a1: Lateral, a2: Lateral, right: Right, x: float) -> tuple[Lateral, Lateral]:
    """Return y and slope at node i at x: a + B (F, M)."""
    b12, shear, moment = load(w.reals, i, B12), right.shear, right.moment + times(right.x - x, right.shear)
    return (
        a1 + times(load(w.reals, i, B11), shear) + times(b12, moment),
        a2 + times(b12, shear) + times(load(w.reals, i, B22), moment),
    )


@inner
def _force(w: Needles, i: int, u: Lateral, new_u: Lateral) -> Lateral:
    """Return the force of contact i (N), linear about the compression u."""
    return load(w.laterals, i, FORCE) - times(load(w.reals, i, K), new_u - u)


@inner
def _judge(w: Needles, i: int, u: Lateral, new_u: Lateral) -> tuple[float, float]:
    """Return `judge` of contact i."""
    return judge(load(w.mesh, i, HEIGHT), load(w.reals, i, SHARPNESS), load(w.reals, i, TURNING), u, new_u)


@inner
def _keep(w: Needles, i: int, live: bool, y: Lateral, right: Right, force: Lateral) -> None:
    """Keep the solution at a node for outputs, of the needles that still search; `right` begins at the node."""
    if w.keeps_shape:
        store(w.laterals, i, Y, select(live, y, load(w.laterals, i, Y)))
        store(w.laterals, i, SLOPE, select(live, right.slope, load(w.laterals, i, SLOPE)))
    if w.keeps_loads:
        store(w.laterals, i, SHEAR, select(live, right.shear, load(w.laterals, i, SHEAR)))
        store(w.laterals, i, MOMENT, select(live, right.moment, load(w.laterals, i, MOMENT)))
        store(w.laterals, i, LOAD, select(live, force, load(w.laterals, i, LOAD)))


@inner
def _pass_contact(w: Needles, it: Iteration, i: int, right: Right) -> Right:
    """Return the part of the needle with a contact of old tissue at its end."""
    x, u = load(w.mesh, i, X), load(w.laterals, i, U)
    y, slope = _pose(w, i, load(w.laterals, i, A1), load(w.laterals, i, A2), right, x)
    new_u = y - load(w.laterals, i, REST)
    store(w.laterals, i, CHANGED, new_u)
    force = _force(w, i, u, new_u)
    error, fraction = _judge(w, i, u, new_u)
    right = _add_span(right, x, slope, it.bend, w.constants.flexibility)
    _keep(w, i, it.live, y, right, force)
    return _add_node(right, force, error, fraction)


@inner
def _pass_node(w: Needles, it: Iteration, tip_y: Lateral, i: int, right: Right) -> Right:
    """Return the part of the needle with a node of any kind at its end, or the same part if the node is ahead."""
    node_x = load(w.mesh, i, X)
    active, x = node_x < it.tip_x, least(node_x, it.tip_x)
    a1 = load(w.laterals, i, A1) + times(load(w.reals, i, G1), tip_y)
    a2 = load(w.laterals, i, A2) + times(load(w.reals, i, G2), tip_y)
    y, slope = _pose(w, i, a1, a2, right, x)
    u, new_u = load(w.laterals, i, U), y - load(w.laterals, i, FIXED) - times(load(w.reals, i, SHARE), tip_y)
    force = _force(w, i, u, new_u)
    error, fraction = _judge(w, i, u, new_u)
    contact = load(w.mesh, i, KIND) == CONTACT
    node = Node(y, slope, force, new_u)
    if some(opposite(contact)):
        node = _react(w, i, node, contact, a2, right.moment + times(right.x - x, right.shear))
    store(w.laterals, i, CHANGED, select(active, node.u, u))
    right = _add_span(right, x, node.slope, it.bend, w.constants.flexibility)
    _keep(w, i, it.live & active, node.y, right, node.force)
    acts = active & contact
    return _add_node(right, node.force, select(acts, error, 0.0), select(acts, fraction, 1.0))


@inner
def _react(w: Needles, i: int, node: Node, contact: bool, a2: Lateral, moment: Lateral) -> Node:
    """Return the solution with the nodes that are not contacts: with the reaction at a given y, or without a force."""
    y, slope, force, u = node
    held, fixed, b11 = load(w.reals, i, HELD) > 0.0, load(w.laterals, i, FIXED), load(w.reals, i, B11)
    reaction = times(1.0 / select(held, b11, 1.0), fixed - y)
    force = select(held, reaction, select(contact, force, times(0.0, force)))
    y = select(held, fixed, y)
    slope = select(held, a2 + times(load(w.reals, i, B22), moment), slope)
    store(w.laterals, i, FORCE, select(contact, load(w.laterals, i, FORCE), force))
    return Node(y, slope, force, select(contact, u, y))


@shared
def _pass_nodes(w: Needles, it: Iteration, tip_y: Lateral, begin: int, end: int, right: Right) -> Right:
    for i in range(end - 1, begin - 1, -1):
        right = _pass_node(w, it, tip_y, i, right)
    return right


@inner
def sweep_back(w: Needles, it: Iteration, tip: Tip) -> Right:
    """Sweep from the tip to the base: new compressions into `w`, and the solution of the `live` needles if it is kept.

    Returns the needle at the base.
    """
    zero, spans, base = 0.0 * it.tip_x, it.spans, it.boundary.base
    right = Right(it.tip_x, tip.slope, tip.force, tip.couple, zero, tip.error, tip.fraction)
    right = _pass_nodes(w, it, tip.y, spans.last, spans.behind, right)
    for i in range(spans.last - 1, spans.first - 1, -1):
        right = _pass_contact(w, it, i, right)
    right = _pass_nodes(w, it, tip.y, 0, spans.first, right)
    right = _add_span(right, base.x, base.slope, it.bend, w.constants.flexibility)
    x, slope, shear, moment, fifteenfold, error, fraction = right
    return Right(x, slope, shear, moment, fifteenfold / 15.0, error, fraction)
