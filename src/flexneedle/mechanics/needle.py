"""Equilibrium of the needle: one sweep out to the tip, one sweep back (docs/theory.md section 3).

The part of the needle left of x answers a force F and a moment M from the right with

    (y, θ) = a + B (F, M),    B symmetric: its flexibility.

A span adds its own flexibility and a spring is a rank-one update, as in a Kalman filter; the way back
gives forces and positions. Nothing divides by a length, so nodes may be as close as they like, where the
usual stiffness matrix loses digits with the third power of the length.

Lateral quantities are real in the plane and complex in space (`lateral`). The beam is equally flexible in all
directions, and an iteration takes each contact as equally stiff, so B is one real matrix for both axes.

A contact that the running step cuts rests on the path of the tip, whose end is unknown: rest =
cut_y + share (y_tip − cut_y). So a is carried as a + y_tip g, and y_tip found at the tip.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lateral import (
    Lateral,
    dot,
    inexact,
    lateral,
    one_stiffness,
    size,
    square,
    steady,
    stretched,
    times,
    turned,
)
from flexneedle.mechanics.law import response, stored_energy
from flexneedle.mechanics.model import CONTACT, GUIDE, Model

Laterals = NDArray[Any]
Work = NDArray[Any]

Plain = tuple[Any, ...]

COUPLED_ITERATIONS = 15
BEARING_LOOKS = 15  # at the needle in its guide, in an iteration without coupling
MAX_ITERATIONS = 100


class NodePose(NamedTuple):
    """Position x along the axis and y across it (mm), and slope dy/dx."""

    x: float
    y: Lateral
    slope: Lateral


class Boundary(NamedTuple):
    """What is imposed on the needle: pose of the base, the guide (mm), the bevel's direction, a tip load (N).

    The bevel is ±1 in the plane and a unit number in space.
    """

    base: NodePose
    guide: Lateral
    bevel: Lateral
    load: Lateral


class CutChannel(NamedTuple):
    """The end of the cut: its deepest point `front` and the rest position of the tip spring (mm)."""

    front: float
    rest: Lateral


class Cut(NamedTuple):
    """Where the running step began to cut: tip, channel, and by how much the bevel turns in the step (rad)."""

    tip: NodePose
    channel: CutChannel
    spin: float


class Bearing(NamedTuple):
    """A needle in a guide with clearance: wall, the unit vector to that on which it bears, 0 for none.

    give: displacement of the needle there per force (mm/N); y, force: of the iteration before, from the guide's middle.
    """

    wall: Lateral
    give: float
    y: Lateral
    force: Lateral


class Iterate(NamedTuple):
    """Where an iteration begins: compression of the tip spring, shortening (mm), and the needle in its guide.

    behind: number of nodes behind the tip.
    """

    spring: Lateral
    shortening: float
    guide: Bearing
    behind: int


class Loads(NamedTuple):
    """Lateral force on the tip (N), reaction of a held tip, shear and moment (N·mm) of the needle at the base."""

    tip: Lateral
    reaction: Lateral
    shear: Lateral
    moment: Lateral


class Equilibrium(NamedTuple):
    """Equilibrium, and how it was found; residual: estimated distance from it (mm)."""

    tip: NodePose
    last: Iterate
    loads: Loads
    iterations: int
    residual: float
    converged: bool


class NeedleState(NamedTuple):
    """State of a needle besides the rest positions and compressions of its contacts; the input of the next step."""

    boundary: Boundary
    cut: Cut
    channel: CutChannel
    solution: Equilibrium


@inner
def to_plain(needle: NeedleState) -> Plain:
    """A needle as tuples without names; `from_plain` makes it again.

    Kernels return these. Compiled code that makes a named tuple for Python calls Python: if a signal's handler raises
    there, as Ctrl-C does, the process crashes.
    """
    boundary, cut, solution = needle.boundary, needle.cut, needle.solution
    base, begun, tip, last, loads = boundary.base, cut.tip, solution.tip, solution.last, solution.loads
    guide, channel = last.guide, needle.channel
    return (
        (base.x, base.y, base.slope),
        (boundary.guide, boundary.bevel, boundary.load),
        (begun.x, begun.y, begun.slope),
        (cut.channel.front, cut.channel.rest, cut.spin),
        (channel.front, channel.rest),
        (tip.x, tip.y, tip.slope),
        (last.spring, last.shortening, last.behind),
        (guide.wall, guide.give, guide.y, guide.force),
        (loads.tip, loads.reaction, loads.shear, loads.moment),
        (solution.iterations, solution.residual, solution.converged),
    )


def from_plain(plain: Plain) -> NeedleState:
    """The needle of `to_plain`."""
    base, imposed, begun, cut, channel, tip, last, guide, loads, found = plain
    (front, rest, spin), (spring, shortening, behind) = cut, last
    return NeedleState(
        Boundary(NodePose(*base), *imposed),
        Cut(NodePose(*begun), CutChannel(front, rest), spin),
        CutChannel(*channel),
        Equilibrium(
            NodePose(*tip), Iterate(spring, shortening, Bearing(*guide), behind), Loads(*loads), *found
        ),
    )


def start(base: NodePose, tip: NodePose, bevel: Lateral, guide: Lateral) -> NeedleState:
    """The straight needle in air, before a solve, with the guide on it."""
    none = 0.0 * bevel
    channel = CutChannel(0.0, none)
    solution = Equilibrium(
        tip,
        Iterate(none, 0.0, Bearing(none, 0.0, none, none), 0),
        Loads(none, none, none, none),
        0,
        0.0,
        True,
    )
    return NeedleState(Boundary(base, guide, bevel, none), Cut(tip, channel, 0.0), channel, solution)


class Path(NamedTuple):
    """End of the path that is being cut: coupled (1) to the unknown y of the tip, or (0) at a given one."""

    coupling: float
    y: Lateral


class Tip(NamedTuple):
    """Result of an iteration at the tip; `left` and `fraction` as of `_judge`."""

    y: Lateral
    slope: Lateral
    force: Lateral
    spring: Lateral
    reaction: Lateral
    left: float
    fraction: float


def work_array(rest: Laterals) -> Work:
    """The solver's array (n,) for rest positions (n,), by node: left of it (a, g, B), of it, and the solution at it.

    a1, g1, b11, b12 are those before an essential node, all else after.
    """
    real, across = np.dtype(np.float64), rest.dtype
    reals = [
        (name, real)
        for name in ("g1", "g2", "b11", "b12", "b22", "stiffness", "share", "sharpness", "turning")
    ]
    laterals = [
        (name, across) for name in ("a1", "a2", "fixed", "force", "new_u", "y", "slope", "shear", "moment")
    ]
    return np.zeros(rest.size, np.dtype([*reals, *laterals]))


@inner
def _prescribed(model: Model, wall: Lateral, rest: Lateral, kind: int) -> Lateral:
    """Lateral position (mm) of an essential node; NaN at a guide with clearance that the needle does not touch."""
    if kind == GUIDE and model.clearance > 0.0:
        rest = rest + times(model.clearance, wall) if size(wall) > 0.0 else times(math.nan, rest)
    return rest


@inner
def _contact(model: Model, i: int, u: Lateral, behind: float, radial_weight: float) -> tuple[Any, ...]:
    """Force (N) of a contact so far (mm) behind the tip, over which it grows in; its stiffness (N/mm) in an iteration,
    by the weight of `one_stiffness`; its sharpness (1/mm); the part of a change for which the stiffness is not exact.
    """
    node = model.nodes[i]
    law = response(model.laws[node.law], size(u) / node.height)
    scale = node.stiffness
    if behind < node.reach:
        scale *= behind / node.reach
    k = scale * one_stiffness(u, law.tangent, law.secant, radial_weight)
    turning = inexact(u, law.tangent, law.secant, radial_weight)
    return times(-scale * law.secant, u), k, law.sharpness / node.height, turning


@inner
def _sweep_out(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    wall: Lateral,
    path: Path,
    rest: Laterals,
    u: Laterals,
    w: Work,
    tip_x: float,
    count: int,
    fresh: int,
    radial_weight: float,
) -> tuple[Any, ...]:
    """From the base to the tip: fill `w`, return (a1, a2, g1, g2, b11, b12) just left of the tip spring."""
    nodes = model.nodes
    flexibility = 1.0 / model.bending_stiffness
    x, a1, a2 = boundary.base.x, boundary.base.y, boundary.base.slope
    g1, g2, b11, b12, b22 = 0.0, 0.0, 0.0, 0.0, 0.0
    bend = model.curvature * boundary.bevel
    per_length = 1.0 / (tip_x - cut.tip.x) if fresh < count else 0.0
    path_y = times(1.0 - path.coupling, path.y)
    for i in range(count + 1):
        length = (nodes[i].x if i < count else tip_x) - x
        x += length
        a1 += times(length, a2 + times(0.5 * length, bend))
        a2 += times(length, bend)
        g1 += length * g2
        turn = length * flexibility
        b11 += length * (2.0 * b12 + length * (b22 + turn * (1.0 / 3.0)))
        b12 += length * (b22 + 0.5 * turn)
        b22 += turn
        if i == count:
            break
        node, out = nodes[i], w[i]
        if node.kind != CONTACT:
            out.a1, out.g1, out.b11, out.b12 = a1, g1, b11, b12
            fixed = _prescribed(model, wall, rest[i], node.kind)
            out.fixed = fixed
            if not math.isnan(fixed.real):
                gain = b12 / b11
                a2 += times(gain, fixed - a1)
                g2 -= gain * g1
                b22 -= gain * b12
                a1, g1, b11, b12 = fixed, 0.0, 0.0, 0.0
        else:
            force, k, out.sharpness, out.turning = _contact(model, i, u[i], tip_x - x, radial_weight)
            share, fixed = 0.0, rest[i]
            if i >= fresh:
                share = (x - cut.tip.x) * per_length
                fixed = cut.tip.y + times(share, path_y - cut.tip.y)
                share *= path.coupling
            inverse = 1.0 / (1.0 + k * b11)
            push = times(inverse, force + times(k, u[i] + fixed - a1))
            push_g = k * (share - g1) * inverse
            a1 += times(b11, push)
            a2 += times(b12, push)
            g1 += b11 * push_g
            g2 += b12 * push_g
            b22 -= k * inverse * b12 * b12
            b11 *= inverse
            b12 *= inverse
            out.a1, out.g1, out.b11, out.b12 = a1, g1, b11, b12
            out.stiffness, out.force, out.share, out.fixed = k, force, share, fixed
        out.a2, out.g2, out.b22 = a2, g2, b22
    return a1, a2, g1, g2, b11, b12


@inner
def spring_rest(model: Model, bevel: Lateral, cut: Cut, path: Path, tip_x: float) -> tuple[Lateral, float]:
    """(fixed, slope): the tip spring rests at fixed + (1 − slope) y_tip; docs/theory.md eq. 8."""
    length = tip_x - cut.channel.front
    if length <= 0.0:
        return cut.channel.rest, 1.0
    rate = cut.spin / (tip_x - cut.tip.x) if tip_x > cut.tip.x else 0.0
    goal = times(model.bevel_offset, steady(bevel, rate, model.bevel_length))
    front_y = cut.tip.y + times(cut.channel.front - cut.tip.x, cut.tip.slope)
    line = front_y + times(length, cut.tip.slope)
    lag = times(0.0, goal)
    if cut.channel.front > 0.0:
        before = goal if cut.spin == 0.0 else turned(-rate * length, goal)
        lag = cut.channel.rest - front_y - before
    ratio = length / model.bevel_length
    slope = -math.expm1(-ratio) / ratio
    fixed = line + goal + times(math.exp(-ratio), lag) - times(1.0 - slope, line)
    if path.coupling == 0.0:
        return fixed + times(1.0 - slope, path.y), 1.0
    return fixed, slope


@inner
def spring_law(model: Model, front: float, tip_x: float, u: Lateral) -> tuple[float, ...]:
    """Secant and tangent stiffness (N/mm) of the tip spring over its layers; its sharpness (1/mm), and what of the
    compression is left to the limit of the first law to reach it (mm)."""
    layers = model.layers
    start, stop = max(0.0, max(front, tip_x) - model.bevel_length), tip_x
    amount = size(u)
    secant, tangent, sharpness, height = 0.0, 0.0, 0.0, math.inf
    top = 0.0
    for j in range(layers.size):
        layer = layers[j]
        part = min(stop, layer.end) - max(start, top)
        top = layer.end
        if part > 0.0:
            law = response(model.laws[layer.law], amount / layer.height)
            secant += layer.stiffness * part * law.secant
            tangent += layer.stiffness * part * law.tangent
            sharpness = max(sharpness, law.sharpness / layer.height)
            height = min(height, layer.height)
    return secant, tangent, sharpness, height


@inner
def spring_energy(model: Model, front: float, tip_x: float, u: Lateral) -> float:
    """Energy (mJ) that the tip spring stores in its layers."""
    layers = model.layers
    start, stop = max(0.0, max(front, tip_x) - model.bevel_length), tip_x
    total, top = 0.0, 0.0
    for j in range(layers.size):
        layer = layers[j]
        part = min(stop, layer.end) - max(start, top)
        top = layer.end
        if part > 0.0:
            stored = stored_energy(model.laws[layer.law], size(u) / layer.height)
            total += layer.stiffness * part * layer.height * layer.height * stored
    return total


@inner
def _judge(
    height: float, sharpness: float, turning: float, u: Lateral, new_u: Lateral
) -> tuple[float, float]:
    """(left, fraction): what is left after this step (mm), and how much of the step may be taken.

    Newton's method converges quadratically, so about |Δu|² W‴/2W″ is left, and in space the part of Δu for which the
    stiffness is not exact; a step may use half the stretch that is left.
    """
    change = size(new_u - u)
    if sharpness == math.inf:
        return change, 1.0
    left = min(change, change * (change * sharpness + turning))
    limit = 0.5 * (height + size(u))
    if square(new_u) <= limit * limit:
        return left, 1.0
    along = dot(u, new_u - u)
    reach = math.sqrt(along * along + change * change * (limit * limit - square(u))) - along
    return change, reach / (change * change)


@inner
def _tip(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    u: Lateral,
    path: Path,
    tip_x: float,
    held: Lateral,
    ahead: tuple[Any, ...],
) -> Tip:
    """Solve the tip, `ahead` from the base; a `held` y (mm) is an essential condition, NaN leaves it free.

    The two stiffnesses of the tip spring, along its compression and across it, are both exact.
    """
    a1, a2, g1, g2, b11, b12 = ahead
    fixed, slope = spring_rest(model, boundary.bevel, cut, path, tip_x)
    secant, tangent, sharpness, height = spring_law(model, cut.channel.front, tip_x, u)
    amount = size(u)
    along = times(1.0 / amount, u) if amount > 0.0 else times(1.0, lateral(u, 1.0, 0.0))
    at_zero = boundary.load - times(secant, u) + stretched(along, u + fixed, tangent, secant)
    if math.isnan(held.real):
        free = 1.0 - g1
        y = stretched(
            along,
            a1 + times(b11, at_zero),
            1.0 / (free + b11 * tangent * slope),
            1.0 / (free + b11 * secant * slope),
        )
        total = at_zero - stretched(along, y, tangent * slope, secant * slope)
        reaction = times(0.0, y)
    else:
        y = held
        total = times(1.0 / b11, y - a1 - times(g1, y))
        reaction = total - at_zero + stretched(along, y, tangent * slope, secant * slope)
    new_u = times(slope, y) - fixed
    left, fraction = _judge(height, sharpness, 0.0, u, new_u) if secant > 0.0 else (0.0, 1.0)
    return Tip(y, a2 + times(g2, y) + times(b12, total), total, new_u, reaction, left, fraction)


@inner
def _sweep_back(
    model: Model, boundary: Boundary, u: Laterals, w: Work, tip_x: float, tip: Tip, count: int
) -> tuple[Lateral, Lateral, float, float, float]:
    """From the tip to the base: positions, loads and new compressions into `w`.

    Returns shear and moment at the base, the shortening ½∫|y'|² (mm), and the worst (left, fraction) of `_judge`.
    """
    nodes = model.nodes
    flexibility = 1.0 / model.bending_stiffness
    bend = model.curvature * boundary.bevel
    x, y, turn, shear = tip_x, tip.y, tip.slope, tip.force
    moment = times(0.0, shear)
    left, fraction = tip.left, tip.fraction
    shortening = 0.0
    for i in range(count - 1, -2, -1):
        length = x - (nodes[i].x if i >= 0 else boundary.base.x)
        x -= length
        middle = (
            turn
            - times(0.5 * length * flexibility, moment)
            - times(0.125 * length * length * flexibility, shear)
            - times(0.5 * length, bend)
        )
        moment += times(length, shear)
        right = turn
        if i < 0:
            turn = boundary.base.slope
        else:
            out = w[i]
            y = out.a1 + times(out.g1, tip.y) + times(out.b11, shear) + times(out.b12, moment)
            fixed = nodes[i].kind != CONTACT and not math.isnan(out.fixed.real)
            if fixed:
                free, y = y, out.fixed
                turn = out.a2 + times(out.g2, tip.y) + times(out.b22, moment)
                out.force = times(1.0 / out.b11, y - free)
            else:
                turn = out.a2 + times(out.g2, tip.y) + times(out.b12, shear) + times(out.b22, moment)
            out.shear, out.moment, out.y, out.slope = shear, moment, y, turn
            if fixed:
                shear += out.force
            elif nodes[i].kind != CONTACT:
                out.force = times(0.0, y)
            else:
                new_u = y - out.fixed - times(out.share, tip.y)
                out.new_u = new_u
                shear += out.force - times(out.stiffness, new_u - u[i])
                rest, part = _judge(nodes[i].height, out.sharpness, out.turning, u[i], new_u)
                left, fraction = max(left, rest), min(fraction, part)
        shortening += length * (
            square(turn)
            + 4.0 * square(middle)
            + square(right)
            + dot(middle, turn + right)
            - 0.5 * dot(turn, right)
        )
    return shear, moment, shortening / 15.0, left, fraction


@inner
def _overshoot(
    model: Model,
    front: float,
    spring: Lateral,
    u: Laterals,
    w: Work,
    count: int,
    tip_x: float,
    new_spring: Lateral,
    t: float,
) -> float:
    """Slope of the energy along an iteration's step at `t`, less the beam's part (never negative) of 1 − t."""
    nodes = model.nodes
    change = new_spring - spring
    here = spring + times(t, change)
    secant, tangent, _, _ = spring_law(model, front, tip_x, spring)
    amount = size(spring)
    along = times(1.0 / amount, spring) if amount > 0.0 else times(1.0, lateral(spring, 1.0, 0.0))
    linear = times(secant, spring) + stretched(along, change, tangent, secant)
    slope = dot(times(spring_law(model, front, tip_x, here)[0], here) - linear, change)
    for i in range(count):
        node, out = nodes[i], w[i]
        if node.kind == CONTACT:
            change = out.new_u - u[i]
            here = u[i] + times(t, change)
            law = response(model.laws[node.law], size(here) / node.height)
            scale = node.stiffness * min(1.0, (tip_x - node.x) / node.reach)
            slope += dot(out.force - times(out.stiffness, change) + times(scale * law.secant, here), change)
    return float(slope)


@inner
def _line_search(
    model: Model,
    front: float,
    spring: Lateral,
    u: Laterals,
    w: Work,
    count: int,
    tip_x: float,
    new_spring: Lateral,
) -> float:
    """The fraction of an iteration's step at which the convex energy still falls: no cycle can form."""
    if _overshoot(model, front, spring, u, w, count, tip_x, new_spring, 1.0) <= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        if _overshoot(model, front, spring, u, w, count, tip_x, new_spring, middle) > 0.0:
            high = middle
        else:
            low = middle
    return low if low > 0.0 else high


@inner
def _behind(model: Model, tip_x: float, near: int) -> int:
    """Number of nodes behind `tip_x`, counted from a number `near` it."""
    nodes, count = model.nodes, min(near, model.nodes.size)
    while count < nodes.size and nodes[count].x < tip_x:
        count += 1
    while count > 0 and nodes[count - 1].x >= tip_x:
        count -= 1
    return count


@inner
def _guess(model: Model, boundary: Boundary, cut: Cut, last: Iterate, u: Laterals) -> tuple[Lateral, Lateral]:
    """First guess of the y of the tip, on its own line, and of the tip spring; contacts to be cut are unstrained."""
    tip_x = boundary.base.x + model.length - last.shortening
    y = cut.tip.y + times(tip_x - cut.tip.x, cut.tip.slope)
    front = cut.channel.front
    for i in range(_behind(model, front, last.behind), _behind(model, tip_x + 1.0, last.behind)):
        u[i] = times(0.0, y)
    fixed, slope = spring_rest(model, boundary.bevel, cut, Path(1.0, y), tip_x)
    return y, times(slope, y) - fixed


@inner
def _bearing(
    model: Model, boundary: Boundary, w: Work, count: int, last: Bearing, settled: float
) -> tuple[bool, Bearing]:
    """Whether the needle bears on its guide as was assumed, to `settled` (mm), and what to assume next.

    A wall only pushes, and between the walls nothing does: one inequality of a convex problem, so that few changes do.
    In space the wall is a circle, which pushes towards its middle: the needle bears on the point nearest to where it
    would be without the wall, as far as its displacement per force is known from the last change.
    """
    if count == 0 or model.nodes[0].kind != GUIDE or model.clearance <= 0.0:
        return True, last
    y, force, bears = w[0].y - boundary.guide, w[0].force, size(last.wall) > 0.0
    give, moved = last.give, size(y - last.y)
    if moved > settled:  # not at a first look, where the last y is NaN
        give = min(moved / size(force - last.force), w[0].b11)
    free = y - times(give, force)
    distance = size(free)
    pulls = dot(force, last.wall) > 0.0
    off = distance <= model.clearance and (
        pulls or not bears
    )  # a wall that pushes stays, however little it does
    if off or (pulls and dot(free, last.wall) <= 0.0):
        return not bears, Bearing(times(0.0, y), give, y, force)
    wall = free / distance if distance > 0.0 else last.wall
    agrees = bears and model.clearance * size(wall - last.wall) <= settled
    return agrees, Bearing(wall, give, y, force)


@inner
def _iterate(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    at: Iterate,
    path: Path,
    rest: Laterals,
    u: Laterals,
    w: Work,
    held: Lateral,
    radial_weight: float,
) -> tuple[NodePose, Iterate, Loads, int, float, bool]:
    """One iteration, in place; returns tip, where the next begins, loads, first node being cut, what is left (mm), and
    whether the needle bears on its guide as it began.

    Without coupling it first finds where in the guide its own quadratic energy is least: a line search towards that
    point descends, so that the needle cannot go from wall to wall in a cycle.
    """
    nodes = model.nodes
    tip_x = boundary.base.x + model.length - at.shortening
    count = _behind(model, tip_x, at.behind)
    fresh = count
    while fresh > 0 and nodes[fresh - 1].x > cut.channel.front:
        fresh -= 1
    looks, settled, guide = 1, model.slide, at.guide
    if path.coupling == 0.0:
        unknown = times(math.nan, boundary.guide)
        looks, settled = BEARING_LOOKS, 0.1 * model.tolerance
        guide = Bearing(guide.wall, guide.give, unknown, unknown)
    for _ in range(looks):
        ahead = _sweep_out(
            model, boundary, cut, guide.wall, path, rest, u, w, tip_x, count, fresh, radial_weight
        )
        tip = _tip(model, boundary, cut, at.spring, path, tip_x, held, ahead)
        shear, moment, shortening, left, fraction = _sweep_back(model, boundary, u, w, tip_x, tip, count)
        agrees, guide = _bearing(model, boundary, w, count, guide, settled)
        if agrees:
            break
    if path.coupling == 0.0 and left > model.tolerance:
        front, spring = cut.channel.front, at.spring
        fraction = min(fraction, _line_search(model, front, spring, u, w, count, tip_x, tip.spring))
    for i in range(count):
        if nodes[i].kind == CONTACT:
            u[i] = w[i].new_u if fraction == 1.0 else u[i] + times(fraction, w[i].new_u - u[i])
    spring = tip.spring if fraction == 1.0 else at.spring + times(fraction, tip.spring - at.spring)
    return (
        NodePose(tip_x, tip.y, tip.slope),
        Iterate(spring, shortening, guide, count),
        Loads(tip.force, tip.reaction, shear, moment),
        fresh,
        left if fraction == 1.0 else math.inf,
        agrees,
    )


@inner
def solve(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    last: Iterate,
    rest: Laterals,
    u: Laterals,
    w: Work,
    held: Lateral,
) -> tuple[Equilibrium, Path, int]:
    """Find the equilibrium; a `held` tip (mm, NaN if free) is an essential condition.

    The shortening and the end of the path being cut are found with it. Where that does not converge, both are
    taken from the start of the step: what is left is the minimum of a convex energy, found with a line search.

    `rest` and `u` (n,) are lateral arrays, updated in place; `w` is a `work_array`. Returns also the path that was cut
    and the index of the first node on it.
    """
    y, spring = _guess(model, boundary, cut, last, u)
    unknown = times(math.nan, y)
    guide_before = Bearing(last.guide.wall, last.guide.give, unknown, unknown)
    at = Iterate(spring, last.shortening, guide_before, last.behind)
    path = Path(1.0, y)
    for iteration in range(1, MAX_ITERATIONS + 1):
        if iteration == COUPLED_ITERATIONS + 1:
            for i in range(model.nodes.size):
                if not math.isfinite(size(u[i])):  # the coupled iterations ran away
                    u[i] = times(0.0, boundary.base.y)
            y, spring = _guess(model, boundary, cut, last, u)
            at = Iterate(spring, last.shortening, guide_before, last.behind)
            path = Path(0.0, y)
        radial_weight = 0.5 if path.coupling > 0.0 else float(iteration % 2)
        tip, new, loads, fresh, left, agrees = _iterate(
            model, boundary, cut, at, path, rest, u, w, held, radial_weight
        )
        slide = at.shortening - new.shortening if path.coupling > 0.0 else 0.0
        found = left <= model.tolerance and abs(slide) <= model.slide
        guide, shortening = new.guide, new.shortening
        if found and agrees:
            at = new
            break
        if path.coupling == 0.0:
            shortening = at.shortening
        elif not found and size(guide.wall) > 0.0 and size(at.guide.wall) > 0.0:
            # On the circle the needle moves on from a solution: before it, the displacement per force is not known.
            guide = at.guide
        at = Iterate(new.spring, shortening, guide, new.behind)
    on = times(slide, tip.slope) if math.isnan(held.real) else times(0.0, tip.slope)
    tip = NodePose(tip.x + slide, tip.y + on, tip.slope)
    finite = math.isfinite(size(tip.y)) and math.isfinite(tip.x)
    return (
        Equilibrium(tip, at, loads, iteration, max(left, abs(slide)), finite and found and agrees),
        path,
        fresh,
    )
