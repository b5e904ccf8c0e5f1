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
"""

import math
from typing import Any, NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lateral import (
    Lateral,
    dot,
    inexact,
    lateral,
    one_stiffness,
    size,
    square,
    stretch,
    times,
)
from flexneedle.mechanics.law import response
from flexneedle.mechanics.model import CONTACT, GUIDE, Model
from flexneedle.mechanics.needle import Boundary, Cut, Laterals, Path, Work
from flexneedle.mechanics.spring import spring_law, spring_rest


class Tip(NamedTuple):
    """Result of an iteration at the tip; `left` and `fraction` from `judge`."""

    y: Lateral
    slope: Lateral
    force: Lateral
    spring: Lateral
    reaction: Lateral
    left: float
    fraction: float


@inner
def _prescribe_lateral(model: Model, wall: Lateral, rest: Lateral, kind: int) -> Lateral:
    """Return the lateral position (mm) of an essential node; NaN at a guide with clearance that is not touched."""
    if kind == GUIDE and model.clearance > 0.0:
        rest = rest + times(model.clearance, wall) if size(wall) > 0.0 else times(math.nan, rest)
    return rest


@inner
def _contact(model: Model, i: int, u: Lateral, behind: float, radial_weight: float) -> tuple[Any, ...]:
    """Return force (N), stiffness (N/mm), sharpness (1/mm) and inexact part of a contact.

    The contact grows in over its reach, and is `behind` (mm) the tip. The stiffness is for an iteration, by the weight
    of `one_stiffness`; the inexact part is the share of a change for which the stiffness is not exact.
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
def sweep_out(
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
    """Sweep from the base to the tip: fill `w`, return (a1, a2, g1, g2, b11, b12) just left of the tip spring."""
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
            fixed = _prescribe_lateral(model, wall, rest[i], node.kind)
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
def judge(height: float, sharpness: float, turning: float, u: Lateral, new_u: Lateral) -> tuple[float, float]:
    """Return (left, fraction): distance left after this step (mm), and fraction of the step that may be taken.

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
def solve_tip(
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
    at_zero = boundary.load - times(secant, u) + stretch(along, u + fixed, tangent, secant)
    if math.isnan(held.real):
        free = 1.0 - g1
        y = stretch(
            along,
            a1 + times(b11, at_zero),
            1.0 / (free + b11 * tangent * slope),
            1.0 / (free + b11 * secant * slope),
        )
        total = at_zero - stretch(along, y, tangent * slope, secant * slope)
        reaction = times(0.0, y)
    else:
        y = held
        total = times(1.0 / b11, y - a1 - times(g1, y))
        reaction = total - at_zero + stretch(along, y, tangent * slope, secant * slope)
    new_u = times(slope, y) - fixed
    left, fraction = judge(height, sharpness, 0.0, u, new_u) if secant > 0.0 else (0.0, 1.0)
    return Tip(y, a2 + times(g2, y) + times(b12, total), total, new_u, reaction, left, fraction)


@inner
def sweep_back(
    model: Model, boundary: Boundary, u: Laterals, w: Work, tip_x: float, tip: Tip, count: int
) -> tuple[Lateral, Lateral, float, float, float]:
    """Sweep from the tip to the base: positions, loads and new compressions into `w`.

    Returns shear and moment at the base, the shortening ½∫|y'|² (mm), and the worst (left, fraction) of `judge`.
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
                rest, part = judge(nodes[i].height, out.sharpness, out.turning, u[i], new_u)
                left, fraction = max(left, rest), min(fraction, part)
        shortening += length * (
            square(turn)
            + 4.0 * square(middle)
            + square(right)
            + dot(middle, turn + right)
            - 0.5 * dot(turn, right)
        )
    return shear, moment, shortening / 15.0, left, fraction
