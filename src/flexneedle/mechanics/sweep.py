"""Sweeps of a solve: one out to the tip, one back to the base (docs/theory.md section 3).

The part of the needle left of x answers a force F and a moment M from the right with

    (y, θ) = a + B (F, M),    B symmetric: its flexibility.

A span adds its own flexibility and a spring is a rank-one update, as in a Kalman filter; the way back
gives forces and positions. Nothing divides by a length, so nodes may be as close as they like, where the
usual stiffness matrix loses digits with the third power of the length.

Lateral quantities are real in the plane and complex in space (`lateral`). The beam is equally flexible in all
directions, and an iteration takes each contact as equally stiff, so B is one real matrix for both axes.

A contact that the running step cuts rests on the path of the tip, whose end is unknown: rest =
cut_y + share (y_tip − cut_y). So a is carried as a + y_tip g, and y_tip found at the tip.

Most nodes are contacts of old tissue well behind the tip, where g = 0: `find_spans` finds them, and they take a short
loop. The others, at the guide, at measured points and near the tip, take a longer one. There a node ahead of the tip of
its needle has no length before it and no stiffness, and so no effect: needles of different depths go together.
"""

import math
from typing import NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lanes import least, load, most, opposite, root, select, some, store
from flexneedle.mechanics.lateral import (
    Lateral,
    direction,
    dot,
    inexact,
    one_stiffness,
    product,
    size,
    square,
    stretch,
    times,
    y_of,
)
from flexneedle.mechanics.law import response
from flexneedle.mechanics.needle import Boundary, Cut, Path
from flexneedle.mechanics.spring import spring_law, spring_rest
from flexneedle.mechanics.work import (
    A1,
    A2,
    B11,
    B12,
    B22,
    CELLS,
    CHANGED,
    CONTACT,
    FIXED,
    FORCE,
    G1,
    G2,
    GUIDE,
    HEIGHT,
    HELD,
    KIND,
    LAW,
    LOAD,
    MOMENT,
    PER_REACH,
    REST,
    SHARE,
    SHARPNESS,
    SHEAR,
    SLOPE,
    STIFFNESS,
    TURNING,
    K,
    Needles,
    U,
    X,
    Y,
)  # fmt: skip


class Tip(NamedTuple):
    """Result of an iteration at the tip; `left` and `fraction` from `judge`."""

    y: Lateral
    slope: Lateral
    force: Lateral
    spring: Lateral
    reaction: Lateral
    left: float
    fraction: float


class Spans(NamedTuple):
    """Numbers of nodes: those from `first` to `last` − 1 take the short loop; `behind` are behind a tip."""

    begin: int  # 0
    first: int
    last: int
    behind: int


class Left(NamedTuple):
    """The part of the needle left of a place: a and B."""

    a1: Lateral
    a2: Lateral
    b11: float
    b12: float
    b22: float


class Follow(NamedTuple):
    """Its g."""

    g1: float
    g2: float


@inner
def find_spans(w: Needles, front: float, tip_x: float, near: int) -> Spans:
    """Return the spans of needles with these tips (mm); the search begins at `near` nodes."""
    total = w.mesh.shape[0]
    count = min(near, total)
    while count < total and some(load(w.mesh, count, X) < tip_x):
        count += 1
    while count > 0 and not some(load(w.mesh, count - 1, X) < tip_x):
        count -= 1
    first = min(w.first, count)
    last = count
    while last > first:
        x = load(w.mesh, last - 1, X)
        if not some((x > front) | ((tip_x - x) * load(w.mesh, last - 1, PER_REACH) < 1.0)):
            break
        last -= 1
    return Spans(0 * total, first, last, count)


@inner
def _span(left: Left, length: float, bend: Lateral, flexibility: float) -> Left:
    """Return the part of the needle that is longer by a span without load."""
    a1, a2, b11, b12, b22 = left
    turn = length * flexibility
    return Left(
        a1 + times(length, a2 + times(0.5 * length, bend)),
        a2 + times(length, bend),
        b11 + length * (2.0 * b12 + length * (b22 + turn * (1.0 / 3.0))),
        b12 + length * (b22 + 0.5 * turn),
        b22 + turn,
    )


@inner
def _spring(left: Left, force: Lateral, k: float, unstrained: Lateral) -> Left:
    """Return the part of the needle with a spring at its end: y changes its force by −k (y − unstrained)."""
    a1, a2, b11, b12, b22 = left
    inverse = 1.0 / (1.0 + k * b11)
    push = times(inverse, force + times(k, unstrained - a1))
    return Left(
        a1 + times(b11, push),
        a2 + times(b12, push),
        b11 * inverse,
        b12 * inverse,
        b22 - k * inverse * b12 * b12,
    )


@inner
def _contact(w: Needles, i: int, u: Lateral, grown: float, radial_weight: float) -> tuple[Lateral, float]:
    """Return force (N) and stiffness (N/mm) of a contact that has `grown` in, 0 to 1; store how exact they are.

    The stiffness is for an iteration, by the weight of `one_stiffness`; the inexact part is the share of a change for
    which the stiffness is not exact.
    """
    cells = load(w.mesh, i, CELLS)
    law = response(w.laws, load(w.mesh, i, LAW), size(u) * cells)
    scale = load(w.mesh, i, STIFFNESS) * grown
    store(w.reals, i, SHARPNESS, law.sharpness * cells)
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
def _sweep_any(
    w: Needles,
    cut: Cut,
    wall: Lateral,
    path: Path,
    tip_x: float,
    begin: int,
    end: int,
    radial_weight: float,
    bend: Lateral,
    x: float,
    left: Left,
    follow: Follow,
) -> tuple[float, Left, Follow]:
    """Sweep over nodes of any kind, from `x`."""
    per_length = 1.0 / (tip_x - cut.tip.x)
    path_y = times(1.0 - path.coupling, path.y)
    g1, g2 = follow
    for i in range(begin, end):
        node_x = load(w.mesh, i, X)
        here, behind = least(node_x, tip_x), tip_x - node_x
        length = here - x
        x = here
        left = _span(left, length, bend, w.constants.flexibility)
        g1 += length * g2
        u = load(w.laterals, i, U)
        grown = least(1.0, most(0.0, behind * load(w.mesh, i, PER_REACH)))
        force, k = _contact(w, i, u, grown, radial_weight)
        fresh = (node_x > cut.channel.front) & (behind > 0.0)
        share = select(fresh, (node_x - cut.tip.x) * per_length, 0.0)
        fixed = select(fresh, cut.tip.y + times(share, path_y - cut.tip.y), load(w.laterals, i, REST))
        share *= path.coupling
        push_g = k * (share - g1) / (1.0 + k * left.b11)
        g1, g2 = g1 + left.b11 * push_g, g2 + left.b12 * push_g
        left = _spring(left, force, k, u + fixed)
        _keep(w, i, left, force, k)
        store(w.reals, i, G1, g1)
        store(w.reals, i, G2, g2)
        store(w.reals, i, SHARE, share)
        store(w.reals, i, HELD, 0.0)
        held, y = _essential(w, i, wall, behind)
        if some(held):
            a1, a2, b11, b12, b22 = left
            gain = b12 / select(held, b11, 1.0)
            left = select(
                held,
                Left(y, a2 + times(gain, y - a1), 0.0 * b11, 0.0 * b12, b22 - gain * b12),
                left,
            )
            g2 = select(held, g2 - gain * g1, g2)
            g1 = select(held, 0.0, g1)
            store(w.laterals, i, A2, left.a2)
            store(w.reals, i, B22, left.b22)
            store(w.reals, i, G2, g2)
            store(w.reals, i, HELD, select(held, 1.0, 0.0))
            fixed = select(held, y, fixed)
        store(w.laterals, i, FIXED, fixed)
    return x, left, Follow(g1, g2)


@inner
def sweep_out(
    w: Needles,
    boundary: Boundary,
    cut: Cut,
    wall: Lateral,
    path: Path,
    tip_x: float,
    spans: Spans,
    radial_weight: float,
) -> tuple[Left, Follow]:
    """Sweep from the base to the tip: fill `w`; return the needle just left of the tip spring."""
    zero, x = 0.0 * tip_x, boundary.base.x
    bend = product(w.constants.curvature, boundary.bevel)
    left, follow = Left(boundary.base.y, boundary.base.slope, zero, zero, zero), Follow(zero, zero)
    x, left, follow = _sweep_any(
        w, cut, wall, path, tip_x, spans.begin, spans.first, radial_weight, bend, x, left, follow
    )
    for i in range(spans.first, spans.last):
        here = load(w.mesh, i, X)
        left = _span(left, here - x, bend, w.constants.flexibility)
        x = here
        u = load(w.laterals, i, U)
        force, k = _contact(w, i, u, 1.0, radial_weight)
        left = _spring(left, force, k, u + load(w.laterals, i, REST))
        _keep(w, i, left, force, k)
    x, left, follow = _sweep_any(
        w, cut, wall, path, tip_x, spans.last, spans.behind, radial_weight, bend, x, left, follow
    )
    length = tip_x - x
    return _span(left, length, bend, w.constants.flexibility), Follow(
        follow.g1 + length * follow.g2, follow.g2
    )


@inner
def judge(height: float, sharpness: float, turning: float, u: Lateral, new_u: Lateral) -> tuple[float, float]:
    """Return (left, fraction): distance left after this step (mm), and fraction of the step that may be taken.

    Newton's method converges quadratically, so about |Δu|² W‴/2W″ is left, and in space the part of Δu for which the
    stiffness is not exact; a step may use half the stretch that is left.
    """
    change = size(new_u - u)
    left = least(change, change * (change * sharpness + turning))
    limit = 0.5 * (height + size(u))
    over = (square(new_u) > limit * limit) & (sharpness < math.inf)
    fraction = 1.0 + 0.0 * change
    if some(over):
        along, squared = dot(u, new_u - u), select(over, change * change, 1.0)
        reach = root(select(over, along * along + squared * (limit * limit - square(u)), 1.0)) - along
        left, fraction = select(over, change, left), select(over, reach / squared, 1.0)
    return left, fraction


@inner
def solve_tip(
    w: Needles,
    boundary: Boundary,
    cut: Cut,
    u: Lateral,
    path: Path,
    tip_x: float,
    held: Lateral,
    left: Left,
    follow: Follow,
) -> Tip:
    """Solve the tip, the needle `left` of it; a `held` y (mm) is an essential condition, NaN leaves it free.

    The two stiffnesses of the tip spring, along its compression and across it, are both exact.
    """
    a1, a2, b11, b12, _ = left
    g1, g2 = follow
    fixed, slope = spring_rest(w, boundary.bevel, cut, path, tip_x)
    secant, tangent, sharpness, height = spring_law(w, cut.channel.front, tip_x, u)
    along = direction(u)
    at_zero = boundary.load - times(secant, u) + stretch(along, u + fixed, tangent, secant)
    free = 1.0 - g1
    y = stretch(
        along,
        a1 + times(b11, at_zero),
        1.0 / (free + b11 * tangent * slope),
        1.0 / (free + b11 * secant * slope),
    )
    total = at_zero - stretch(along, y, tangent * slope, secant * slope)
    reaction = times(0.0, y)
    is_held = y_of(held) == y_of(held)
    if some(is_held):
        y = select(is_held, held, y)
        needed = times(1.0 / b11, y - a1 - times(g1, y))
        more = needed - at_zero + stretch(along, y, tangent * slope, secant * slope)
        total, reaction = select(is_held, needed, total), select(is_held, more, reaction)
    new_u = times(slope, y) - fixed
    left_, fraction = judge(height, sharpness, 0.0 * sharpness, u, new_u)
    acts = secant > 0.0
    return Tip(
        y,
        a2 + times(g2, y) + times(b12, total),
        total,
        new_u,
        reaction,
        select(acts, left_, 0.0),
        select(acts, fraction, 1.0),
    )


class Right(NamedTuple):
    """The needle right of a place: slope, shear and moment, and of all of it the shortening and the worst `judge`."""

    slope: Lateral
    shear: Lateral
    moment: Lateral
    shortening: float
    left: float
    fraction: float


@inner
def _span_back(right: Right, length: float, to_left: Lateral, bend: Lateral, flexibility: float) -> float:
    """Return 15 times the shortening ½∫|y'|² dx of the span left of `right`, with this slope at its left end."""
    half = 0.5 * length
    middle = (
        right.slope
        - times(half * flexibility, right.moment)
        - times(0.125 * length * length * flexibility, right.shear)
        - times(half, bend)
    )
    return length * (
        square(to_left)
        + 4.0 * square(middle)
        + square(right.slope)
        + dot(middle, to_left + right.slope)
        - 0.5 * dot(to_left, right.slope)
    )


@inner
def _keep_solution(
    w: Needles,
    i: int,
    live: bool,
    y: Lateral,
    slope: Lateral,
    shear: Lateral,
    moment: Lateral,
    force: Lateral,
) -> None:
    """Keep the solution at a node for outputs, of the needles that are still searching."""
    if w.keeps_shape:
        store(w.laterals, i, Y, select(live, y, load(w.laterals, i, Y)))
        store(w.laterals, i, SLOPE, select(live, slope, load(w.laterals, i, SLOPE)))
    if w.keeps_loads:
        store(w.laterals, i, SHEAR, select(live, shear, load(w.laterals, i, SHEAR)))
        store(w.laterals, i, MOMENT, select(live, moment, load(w.laterals, i, MOMENT)))
        store(w.laterals, i, LOAD, select(live, force, load(w.laterals, i, LOAD)))


@inner
def _back_any(
    w: Needles,
    begin: int,
    end: int,
    bend: Lateral,
    live: bool,
    tip_x: float,
    tip_y: Lateral,
    x: float,
    right: Right,
) -> tuple[float, Right]:
    """Sweep back over nodes of any kind, from `x`."""
    for i in range(end - 1, begin - 1, -1):
        node_x = load(w.mesh, i, X)
        active, here = node_x < tip_x, least(node_x, tip_x)
        length = x - here
        x = here
        shear, moment = right.shear, right.moment + times(length, right.shear)
        b11, b12, g1 = load(w.reals, i, B11), load(w.reals, i, B12), load(w.reals, i, G1)
        y = load(w.laterals, i, A1) + times(g1, tip_y) + times(b11, shear) + times(b12, moment)
        slope = load(w.laterals, i, A2) + times(load(w.reals, i, G2), tip_y)
        bent = slope + times(b12, shear) + times(load(w.reals, i, B22), moment)
        fixed, u = load(w.laterals, i, FIXED), load(w.laterals, i, U)
        new_u = y - fixed - times(load(w.reals, i, SHARE), tip_y)
        force = load(w.laterals, i, FORCE) - times(load(w.reals, i, K), new_u - u)
        left, fraction = judge(
            load(w.mesh, i, HEIGHT), load(w.reals, i, SHARPNESS), load(w.reals, i, TURNING), u, new_u
        )
        contact = load(w.mesh, i, KIND) == CONTACT
        if some(opposite(contact)):
            held = load(w.reals, i, HELD) > 0.0
            force = select(held, times(1.0 / select(held, b11, 1.0), fixed - y), force)
            y = select(held, fixed, y)
            bent = select(held, slope + times(load(w.reals, i, B22), moment), bent)
            new_u = select(contact, new_u, y)
            force = select(contact | held, force, times(0.0, force))
            left, fraction = select(contact, left, 0.0), select(contact, fraction, 1.0)
            store(w.laterals, i, FORCE, select(contact, load(w.laterals, i, FORCE), force))
        bent = select(active, bent, right.slope)
        store(w.laterals, i, CHANGED, select(active, new_u, u))
        right = Right(
            bent,
            select(active, shear + force, shear),
            moment,
            right.shortening + _span_back(right, length, bent, bend, w.constants.flexibility),
            most(right.left, select(active, left, 0.0)),
            least(right.fraction, select(active, fraction, 1.0)),
        )
        _keep_solution(w, i, live & active, y, bent, shear, moment, force)
    return x, right


@inner
def sweep_back(w: Needles, boundary: Boundary, live: bool, tip_x: float, tip: Tip, spans: Spans) -> Right:
    """Sweep from the tip to the base: new compressions into `w`, and the solution of the `live` needles if it is kept.

    Returns the needle at the base.
    """
    bend = product(w.constants.curvature, boundary.bevel)
    zero, x = 0.0 * tip_x, tip_x
    right = Right(tip.slope, tip.force, times(0.0, tip.force), zero, tip.left, tip.fraction)
    x, right = _back_any(w, spans.last, spans.behind, bend, live, tip_x, tip.y, x, right)
    for i in range(spans.last - 1, spans.first - 1, -1):
        here = load(w.mesh, i, X)
        length = x - here
        x = here
        shear, moment = right.shear, right.moment + times(length, right.shear)
        b11, b12 = load(w.reals, i, B11), load(w.reals, i, B12)
        y = load(w.laterals, i, A1) + times(b11, shear) + times(b12, moment)
        slope = load(w.laterals, i, A2) + times(b12, shear) + times(load(w.reals, i, B22), moment)
        u = load(w.laterals, i, U)
        new_u = y - load(w.laterals, i, REST)
        store(w.laterals, i, CHANGED, new_u)
        force = load(w.laterals, i, FORCE) - times(load(w.reals, i, K), new_u - u)
        left, fraction = judge(
            load(w.mesh, i, HEIGHT), load(w.reals, i, SHARPNESS), load(w.reals, i, TURNING), u, new_u
        )
        right = Right(
            slope,
            shear + force,
            moment,
            right.shortening + _span_back(right, length, slope, bend, w.constants.flexibility),
            most(right.left, left),
            least(right.fraction, fraction),
        )
        _keep_solution(w, i, live, y, slope, shear, moment, force)
    x, right = _back_any(w, spans.begin, spans.first, bend, live, tip_x, tip.y, x, right)
    length = x - boundary.base.x
    total = right.shortening + _span_back(right, length, boundary.base.slope, bend, w.constants.flexibility)
    moment = right.moment + times(length, right.shear)
    return Right(boundary.base.slope, right.shear, moment, total / 15.0, right.left, right.fraction)
