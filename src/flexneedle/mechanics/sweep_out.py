"""The sweep from the base out to the tip (docs/theory.md section 3, eq. 6).

The part of the needle left of x answers a force F and a moment M from the right with

    (y, θ) = a + B (F, M),    B symmetric: its flexibility.

A span adds its own flexibility and a spring is a rank-one update, as in a Kalman filter; the way back
(`sweep_back`) gives forces and positions. Nothing divides by a length, so nodes may be as close as they like, where the
usual stiffness matrix loses digits with the third power of the length.

Lateral quantities are real in the plane and complex in space (`lateral`). The beam is equally flexible in all
directions, and an iteration takes each contact as equally stiff, so B is one real matrix for both axes.

A contact that the running step cuts rests on the path of the tip, whose end is unknown: rest =
fixed + share y_tip. So a is carried as a + y_tip g, and y_tip found at the tip. Contacts of old tissue have g = 0.
"""

from typing import NamedTuple

from flexneedle.mechanics.compile import inner, shared
from flexneedle.mechanics.contact import contact_law, contact_rest, contact_weight
from flexneedle.mechanics.iteration import Iteration, judge
from flexneedle.mechanics.lanes import least, load, opposite, select, some, store
from flexneedle.mechanics.lateral import (
    Lateral,
    direction,
    inexact,
    one_stiffness,
    size,
    stretch,
    times,
    y_of,
)
from flexneedle.mechanics.spring import spring_law, spring_rest

from flexneedle.mechanics.work import (  # isort: skip
    A1, A2, B11, B12, B22, CELLS, CONTACT, FIXED, FORCE, G1, G2, GUIDE, HELD, K, KIND, REST, SHARE,
    SHARPNESS, STIFFNESS, TURNING, U, X, Needles,
)  # fmt: skip


class Left(NamedTuple):
    """The part of the needle left of x: a and B."""

    x: float
    a1: Lateral
    a2: Lateral
    b11: float
    b12: float
    b22: float


class Follow(NamedTuple):
    """Its g."""

    g1: float
    g2: float


class Tip(NamedTuple):
    """Result of an iteration at the tip; `error` and `fraction` from `judge`."""

    y: Lateral
    slope: Lateral
    force: Lateral
    spring: Lateral
    reaction: Lateral
    couple: Lateral
    error: float
    fraction: float


@inner
def _add_span(left: Left, x: float, bend: Lateral, flexibility: float) -> Left:
    """Return the part of the needle that is longer by a span without load, up to x."""
    begin, a1, a2, b11, b12, b22 = left
    length = x - begin
    turn = length * flexibility
    return Left(
        x,
        a1 + times(length, a2 + times(0.5 * length, bend)),
        a2 + times(length, bend),
        b11 + length * (2.0 * b12 + length * (b22 + turn * (1.0 / 3.0))),
        b12 + length * (b22 + 0.5 * turn),
        b22 + turn,
    )


@inner
def _add_spring(left: Left, force: Lateral, k: float, unstrained: Lateral) -> Left:
    """Return the part of the needle with a spring at its end: y changes its force by −k (y − unstrained)."""
    x, a1, a2, b11, b12, b22 = left
    inverse = 1.0 / (1.0 + k * b11)
    push = times(inverse, force + times(k, unstrained - a1))
    return Left(
        x,
        a1 + times(b11, push),
        a2 + times(b12, push),
        b11 * inverse,
        b12 * inverse,
        b22 - k * inverse * b12 * b12,
    )


@inner
def _linearize(w: Needles, i: int, u: Lateral, weight: float, radial_weight: float) -> tuple[Lateral, float]:
    """Return force (N) and stiffness (N/mm) of a contact with its weight; store how exact they are.

    The stiffness is for an iteration, by the weight of `one_stiffness`; the inexact part is the share of a change for
    which the stiffness is not exact.
    """
    law = contact_law(w, i, u)
    scale = load(w.mesh, i, STIFFNESS) * weight
    store(w.reals, i, SHARPNESS, law.sharpness * load(w.mesh, i, CELLS))
    store(w.reals, i, TURNING, inexact(u, law.tangent, law.secant, radial_weight))
    return times(-scale * law.secant, u), scale * one_stiffness(u, law.tangent, law.secant, radial_weight)


@inner
def _keep(w: Needles, i: int, left: Left, force: Lateral, k: float) -> None:
    store(w.laterals, i, A1, left.a1)
    store(w.laterals, i, A2, left.a2)
    store(w.laterals, i, FORCE, force)
    store(w.reals, i, B11, left.b11)
    store(w.reals, i, B12, left.b12)
    store(w.reals, i, B22, left.b22)
    store(w.reals, i, K, k)


@inner
def _pass_contact(w: Needles, it: Iteration, i: int, left: Left) -> Left:
    """Return the part of the needle with a contact of old tissue at its end."""
    left = _add_span(left, load(w.mesh, i, X), it.bend, w.constants.flexibility)
    u = load(w.laterals, i, U)
    force, k = _linearize(w, i, u, 1.0, it.radial_weight)
    left = _add_spring(left, force, k, u + load(w.laterals, i, REST))
    _keep(w, i, left, force, k)
    return left


@inner
def _pass_node(
    w: Needles, it: Iteration, wall: Lateral, i: int, left: Left, follow: Follow
) -> tuple[Left, Follow]:
    """Return the part of the needle with a node of any kind at its end, or the same part if the node is ahead."""
    x = load(w.mesh, i, X)
    here, behind = least(x, it.tip_x), it.tip_x - x
    g1, g2 = follow
    g1 += (here - left.x) * g2
    left = _add_span(left, here, it.bend, w.constants.flexibility)
    u = load(w.laterals, i, U)
    force, k = _linearize(w, i, u, contact_weight(w, i, it.tip_x), it.radial_weight)
    fresh = (x > it.cut.channel.front) & (behind > 0.0)
    fixed, share = contact_rest(it.cut, it.path, it.tip_x, x)
    fixed, share = select(fresh, fixed, load(w.laterals, i, REST)), select(fresh, share, 0.0)
    push = k * (share - g1) / (1.0 + k * left.b11)
    follow = Follow(g1 + left.b11 * push, g2 + left.b12 * push)
    left = _add_spring(left, force, k, u + fixed)
    _keep(w, i, left, force, k)
    store(w.reals, i, SHARE, share)
    store(w.reals, i, G1, follow.g1)
    left, follow, fixed = _prescribe(w, i, wall, behind, left, follow, fixed)
    store(w.reals, i, G2, follow.g2)
    store(w.laterals, i, FIXED, fixed)
    return left, follow


@inner
def _essential(w: Needles, i: int, wall: Lateral, behind: float) -> tuple[bool, Lateral]:
    """Return whether a node has a prescribed lateral position, and the position (mm).

    A needle that does not touch its guide with clearance has none there.
    """
    kind, fixed = load(w.mesh, i, KIND), load(w.laterals, i, REST)
    clearance = w.constants.clearance
    loose = (kind == GUIDE) & (clearance > 0.0)
    fixed = select(loose, fixed + times(clearance, wall), fixed)
    return (kind != CONTACT) & (behind > 0.0) & opposite(loose & (size(wall) == 0.0)), fixed


@inner
def _prescribe(
    w: Needles, i: int, wall: Lateral, behind: float, left: Left, follow: Follow, fixed: Lateral
) -> tuple[Left, Follow, Lateral]:
    """Return the part of the needle, its g and the rest position with y given at the node, where it is."""
    held, y = _essential(w, i, wall, behind)
    store(w.reals, i, HELD, select(held, 1.0, 0.0))
    if some(held):
        x, a1, a2, b11, b12, b22 = left
        gain = b12 / select(held, b11, 1.0)
        given = Left(x, y, a2 + times(gain, y - a1), 0.0 * b11, 0.0 * b12, b22 - gain * b12)
        left = select(held, given, left)
        g1, g2 = follow
        follow = Follow(select(held, 0.0, g1), select(held, g2 - gain * g1, g2))
        store(w.laterals, i, A2, left.a2)
        store(w.reals, i, B22, left.b22)
        fixed = select(held, y, fixed)
    return left, follow, fixed


@shared
def _pass_nodes(
    w: Needles, it: Iteration, wall: Lateral, begin: int, end: int, left: Left, follow: Follow
) -> tuple[Left, Follow]:
    for i in range(begin, end):
        left, follow = _pass_node(w, it, wall, i, left, follow)
    return left, follow


@inner
def sweep_out(w: Needles, it: Iteration, wall: Lateral) -> tuple[Left, Follow]:
    """Sweep from the base to the tip: fill `w`; return the needle just left of the tip spring."""
    zero, base, spans = 0.0 * it.tip_x, it.boundary.base, it.spans
    left, follow = Left(base.x, base.y, base.slope, zero, zero, zero), Follow(zero, zero)
    left, follow = _pass_nodes(w, it, wall, 0, spans.first, left, follow)
    for i in range(spans.first, spans.last):
        left = _pass_contact(w, it, i, left)
    left, follow = _pass_nodes(w, it, wall, spans.last, spans.behind, left, follow)
    g1 = follow.g1 + (it.tip_x - left.x) * follow.g2
    return _add_span(left, it.tip_x, it.bend, w.constants.flexibility), Follow(g1, follow.g2)


@inner
def solve_tip(w: Needles, it: Iteration, u: Lateral, left: Left, follow: Follow) -> Tip:
    """Solve the tip, the needle `left` of it, with the compression `u` of its spring before the iteration.

    The two stiffnesses of the tip spring, along its compression and across it, are both exact.
    """
    _, a1, a2, b11, b12, b22 = left
    g1, g2 = follow
    fixed, slope = spring_rest(w, it.boundary.bevel, it.cut, it.path, it.tip_x)
    secant, tangent, sharpness, height = spring_law(w, it.cut.channel.front, it.tip_x, u)
    along, free = direction(u), 1.0 - g1
    # Force on the tip at y = 0.
    at_zero = it.boundary.load - times(secant, u) + stretch(along, u + fixed, tangent, secant)
    y = stretch(
        along,
        a1 + times(b11, at_zero),
        1.0 / (free + b11 * tangent * slope),
        1.0 / (free + b11 * secant * slope),
    )
    total = at_zero - stretch(along, y, tangent * slope, secant * slope)
    reaction = couple = times(0.0, y)
    held = y_of(it.held.y) == y_of(it.held.y)
    if some(held):
        y = select(held, it.held.y, y)
        off = y - a1 - times(g1, y)
        needed = times(1.0 / b11, off)
        turned = held & (y_of(it.held.slope) == y_of(it.held.slope))
        if some(turned):
            off_slope = it.held.slope - a2 - times(g2, y)
            inverse = 1.0 / select(turned, b11 * b22 - b12 * b12, 1.0)
            needed = select(turned, times(inverse, times(b22, off) - times(b12, off_slope)), needed)
            couple = select(turned, times(inverse, times(b11, off_slope) - times(b12, off)), couple)
        more = needed - at_zero + stretch(along, y, tangent * slope, secant * slope)
        total, reaction = select(held, needed, total), select(held, more, reaction)
    new_u = times(slope, y) - fixed
    error, fraction = judge(height, sharpness, 0.0 * sharpness, u, new_u)
    error, fraction = select(secant > 0.0, error, 0.0), select(secant > 0.0, fraction, 1.0)
    tip_slope = a2 + times(g2, y) + times(b12, total) + times(b22, couple)
    return Tip(y, tip_slope, total, new_u, reaction, couple, error, fraction)
