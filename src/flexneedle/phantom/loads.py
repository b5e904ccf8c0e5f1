"""Loads and hinges of the exact needle, with their first and second derivatives (docs/theory.md section 11).

Loads: guide, tissue along the channel, bevel, friction. Hinges between the segments: bending and twist by any angle.

A load adds the gradient of its energy in the node p_i and in the rotation of segment i, a vector δ with t → t + δ × t,
and its Hessian. `curved` is 1 for the full Hessian, 0 for its positive semidefinite Gauss-Newton part.
"""

import math
from typing import NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.law import CELLS, PER_UNIT, response, stored_energy
from flexneedle.phantom.rod import Records, Rod, State
from flexneedle.phantom.space import (
    Floats,
    Turn,
    Vector,
    accumulate,
    add_dyad,
    add_product,
    after,
    carry,
    cross,
    dot,
    inverse,
    length,
    logarithm,
    minus,
    normal_to,
    plus,
    put,
    roll_about_x,
    second_axis,
    third_axis,
    tilt_turn,
    times,
    turn,
    vector,
)

_STEADY = 0.1  # of a segment: distance of a foot point outside of its segment before the segment changes
_STICK_RAD = 1e-3  # rotation of the needle in the tissue at which friction against rotation is full
_NO_DIRECTION_MM = 1e-9  # shorter displacements have no direction


class Before(NamedTuple):
    """Tip position (mm), tangent and twist (rad) before a step; rotation of the base in it, and during its motion."""

    tip: Vector
    tangent: Vector
    twist: float
    rotation: float
    spin: float


@inner
def _law(table: Floats, height: float, stiffness: float, u: float) -> tuple[float, float, float, float]:
    """Return W′/u (N/mm), W″ (N/mm), W (mJ) and stretch of tissue displaced by u ≥ 0 (mm)."""
    e, per_unit = u / height, table[CELLS, PER_UNIT]
    place = e * per_unit
    law = response(table, 0.0, place)
    width = height / per_unit
    stored = stiffness * width * width * stored_energy(table, 0.0, place)
    return stiffness * law.secant, stiffness * law.tangent, stored, 1.0 - e


@inner
def _add_form(row: Records, k: float, a: Vector, b: Vector) -> None:
    """Add the second derivatives of ½k (a·δp + b·δ)²."""
    add_product(row.pp, k, a, a)
    add_dyad(row.pt, k, a, b)
    add_product(row.tt, k, b, b)


@inner
def add_guide(rod: Rod, s: State, w: Records, curved: float) -> float:
    """Add the guide: a stiff round wall beyond its clearance, across the needle. Returns its energy (mJ)."""
    s.guide_force[0] = s.guide_force[1] = 0.0
    if math.isnan(rod.guide_x) or w[len(w) - 1].node[0] <= rod.guide_x:
        return 0.0
    i = s.guide_segment
    if s.held == 0.0:
        i = 0
        while w[i + 1].node[0] <= rod.guide_x:
            i += 1
        s.guide_segment = i
    node, t = vector(w[i].node), vector(w[i].tangent)
    along = (rod.guide_x - node[0]) / t[0]
    y, z = node[1] + along * t[1] - s.guide[0], node[2] + along * t[2] - s.guide[1]
    off = math.sqrt(y * y + z * z)
    excess = off - rod.clearance
    if excess <= 0.0:
        return 0.0
    k = s.softening * rod.guide_stiffness
    f = k * excess
    y, z = y / off, z / off
    # Change of the distance from the centre with the needle's point there.
    out = (-(y * t[1] + z * t[2]) / t[0], y, z)
    across = ((z * t[1] - y * t[2]) / t[0], -z, y)
    arm = cross(t, out)
    accumulate(w[i].force, f, out)
    accumulate(w[i].couple, f * along, arm)
    _add_form(w[i], k, out, times(along, arm))
    _add_form(w[i], f / off, across, times(along, cross(t, across)))
    f *= curved
    x = (1.0, 0.0, 0.0)
    add_dyad(w[i].pt, -f / t[0], x, arm)
    add_product(w[i].tt, -2.0 * f * along / t[0], arm, cross(t, x))
    add_product(w[i].tt, f * along, t, out)
    s.guide_force[0], s.guide_force[1] = -k * excess * y, -k * excess * z
    return float(0.5 * k * excess * excess)


@inner
def _foot(rod: Rod, s: State, w: Records, point: Vector, first: int) -> tuple[int, float]:
    """Return the segment nearest to a channel point, and the distance along it (mm); the search starts at `first`."""
    n = len(w) - 1
    i = min(max(first, 0), n - 1)
    low, high = -_STEADY * rod.segment, (1.0 + _STEADY) * rod.segment
    if s.held > 0.0:
        low, high = -rod.segment, 2.0 * rod.segment
    along = dot(minus(point, vector(w[i].node)), vector(w[i].tangent))
    while along < low and i > 0:
        i -= 1
        along = dot(minus(point, vector(w[i].node)), vector(w[i].tangent))
    while along > high and i < n - 1:
        i += 1
        along = dot(minus(point, vector(w[i].node)), vector(w[i].tangent))
    return i, along


@inner
def add_channel(rod: Rod, s: State, w: Records, channel: Records, count: int, curved: float) -> float:
    """Add the tissue at the channel's points, across the needle. Returns its energy (mJ)."""
    total, weighted, least = 0.0, 0.0, 1.0
    tip, tangent = vector(s.tip), vector(s.tangent)
    for j in range(count):
        point = vector(channel[j].place)
        behind = dot(minus(tip, point), tangent)
        if behind <= 0.0:
            continue
        i, along = _foot(rod, s, w, point, channel[j].segment)
        channel[j].segment = i
        t = vector(w[i].tangent)
        u = plus(minus(vector(w[i].node), point), times(along, t))
        e = length(u)
        table = rod.laws[channel[j].law]
        secant, tangential, stored, stretch = _law(table, channel[j].height, channel[j].stiffness, e)
        ramp = min(1.0, behind / (0.5 * rod.spacing))
        _add_contact(w[i], ramp * secant, ramp * tangential, t, u, e, along, curved)
        total += ramp * stored
        weighted += channel[j].weight * ramp * stored
        least = min(least, stretch)
    s.strain_energy, s.least_stretch = weighted, least
    return total


@inner
def _add_contact(
    row: Records, secant: float, tangent: float, t: Vector, u: Vector, e: float, along: float, curved: float
) -> None:
    """Add the energy W(e) of a point displaced by u, |u| = e, `along` a segment with the tangent t."""
    accumulate(row.force, secant, u)
    accumulate(row.couple, secant * along, cross(t, u))
    out = times(1.0 / e, u) if e > _NO_DIRECTION_MM else normal_to(t)
    across = cross(t, out)
    _add_form(row, tangent, out, times(along, across))
    _add_form(row, secant, across, times(-along, out))
    f = curved * secant * e
    add_dyad(row.pt, -f, t, across)
    add_product(row.tt, -f * e, across, across)
    add_product(row.tt, f * along, t, out)


@inner
def cut_length(s: State) -> float:
    """Return the distance (mm) of the tip past the front of the channel, in its direction; negative if retracted."""
    if s.cut <= 0.0:  # no channel yet: the front is at the skin
        return float(s.tip[0] / s.tangent[0])
    return dot(minus(vector(s.tip), vector(s.front)), vector(s.front_tangent))


@inner
def new_offset(rod: Rod, s: State, before: Before) -> tuple[Vector, float]:
    """Return (η, g): offset of the bevel's rest point from the tip after the move, and −dη/d(drift).

    The bevel turns evenly over the advance. While the tip lags, only by the part of the spin that reaches it.
    """
    tip, t = vector(s.tip), vector(s.tangent)
    moved = minus(tip, before.tip)
    mean = plus(t, before.tangent)
    mean = times(1.0 / length(mean), mean)
    advance = dot(moved, mean)
    drift = carry(minus(moved, times(advance, mean)), mean, t)
    old = carry(vector(s.offset), before.tangent, t)
    cut = cut_length(s)
    if cut <= 0.0:
        return (minus(old, drift) if tip[0] > 0.0 else (0.0, 0.0, 0.0)), 1.0
    frame = turn(s.frame)
    second, third = second_axis(frame), third_axis(frame)
    spun = before.spin + s.twist - before.twist
    spun = min(max(spun, min(0.0, before.spin)), max(0.0, before.spin)) / max(advance, cut)
    lag, turned = spun * rod.bevel_length, spun * cut
    # As complex numbers in the tip's frame: the goal b, its steady follower while it turns, S = b/(1 + i lag), and
    # both at the start of the cut, b e^(−i turned) and S e^(−i turned).
    re = rod.bevel_offset / (1.0 + lag * lag)
    im = -lag * re
    c, d = math.cos(turned), math.sin(turned)
    if s.cut > 0.0:
        along, across = dot(old, second), dot(old, third)
    else:  # the spring enters the skin fully compressed
        along, across = rod.bevel_offset * c, -rod.bevel_offset * d
    ratio = cut / rod.bevel_length
    left, g = math.exp(-ratio), -math.expm1(-ratio) / ratio
    along = re + (along - (re * c + im * d)) * left
    across = im + (across - (im * c - re * d)) * left
    return minus(plus(times(along, second), times(across, third)), times(g, drift)), g


@inner
def add_bevel(rod: Rod, s: State, w: Records, before: Before) -> float:
    """Add the bevel's spring, across the tip, in the tissue around it. Returns its energy (mJ)."""
    if not s.tip[0] > 0.0:  # NaN included
        return 0.0
    offset, g = new_offset(rod, s, before)
    e, t = length(offset), vector(s.tangent)
    front = s.tip[0] - min(0.0, cut_length(s)) * t[0]
    top, bottom = max(0.0, front - rod.bevel_length * t[0]), s.tip[0]
    secant, tangent, stored = 0.0, 0.0, 0.0
    first = int(top / rod.cell)
    for c in range(first, min(int(bottom / rod.cell), rod.law.size - 1) + 1):
        inside = (min(bottom, (c + 1) * rod.cell) - max(top, c * rod.cell)) / t[0]
        if inside > 0.0:
            k, kt, w0, _ = _law(rod.laws[rod.law[c]], rod.height[c], rod.foundation[c] * inside, e)
            secant, tangent, stored = secant + k, tangent + kt, stored + w0
    row = w[len(w) - 1]
    accumulate(row.force, -secant, offset)
    out = times(1.0 / e, offset) if e > _NO_DIRECTION_MM else normal_to(t)
    across = cross(t, out)
    add_product(row.pp, g * tangent, out, out)
    add_product(row.pp, g * secant, across, across)
    return stored


@inner
def set_friction(rod: Rod, s: State, w: Records) -> None:
    """Set friction opposite to the last sliding direction, on the part of each segment that is inside the tissue."""
    for i in range(len(w) - 1):
        left, right = w[i].node[0], w[i + 1].node[0]
        inside = 0.0
        if right > 0.0 and right > left:
            inside = rod.segment * min(1.0, right / (right - left))
        w[i].inside = inside
        put(w[i].friction, times(-s.slide * rod.friction * inside, vector(w[i].tangent)))


@inner
def slip_angle(w: Records, i: int, rotation: float) -> float:
    """Return the rotation (rad) of a segment from where friction does not act; beyond the largest one it slides."""
    angle: float = w[i].slip + rotation + roll_about_x(after(inverse(turn(w[i].rest)), turn(w[i].frame)))
    return min(max(angle, -_STICK_RAD), _STICK_RAD)


@inner
def add_rotation_friction(rod: Rod, w: Records, rotation: float) -> None:
    """Add friction against rotation of the shaft: elastic up to a small angle, then constant."""
    for i in range(len(w) - 1):
        couple = rod.rotation_friction * w[i].inside
        if couple <= 0.0:
            continue
        angle, t = slip_angle(w, i, rotation), vector(w[i].tangent)
        accumulate(w[i].couple, couple * angle / _STICK_RAD, t)
        if abs(angle) < _STICK_RAD:
            add_product(w[i].tt, couple / _STICK_RAD, t, t)


@inner
def clamp(s: State) -> Turn:
    """Return the frame of the base."""
    return after(tilt_turn(s.tilt[0], s.tilt[1]), (s.half_roll[0], s.half_roll[1], 0.0, 0.0))


@inner
def _add_hinge(
    rod: Rod, row: Records, span: float, last: Turn, frame: Turn, curved: float
) -> tuple[float, float]:
    """Add moment and stiffness of a hinge for `span` mm of needle. Returns its energy (mJ) and twist (rad)."""
    phi, beta, dbeta = logarithm(after(frame, inverse(last)))
    t = vector(row.tangent)
    bend, twist = rod.stiffness / span, (rod.torsion - rod.stiffness) / span
    natural = minus(times(rod.curvature, third_axis(frame)), times(rod.curvature_across, second_axis(frame)))
    strain = minus(phi, times(span, natural))
    along = dot(strain, t)
    mu = plus(times(bend, strain), times(twist * along, t))
    turned = cross(phi, mu)
    moment = plus(mu, plus(times(-0.5, turned), times(beta, cross(phi, turned))))
    put(row.moment, moment)
    turned_t = cross(phi, t)
    axis = plus(t, plus(times(-0.5, turned_t), times(beta, cross(phi, turned_t))))
    a, work = dot(phi, phi), dot(mu, phi)
    q = 2.0 * beta - 0.25 - beta * beta * a
    # Second derivative of the logarithm: I times `one` and φ cᵀ + c φᵀ, which cancel for a rotation in a plane.
    one = curved * work * (beta * (1.0 - beta * a) - 0.25)
    c = plus(times(0.25 - dbeta * a - 2.0 * beta, mu), times(beta, moment))
    c = plus(c, plus(times(-0.5 * beta, turned), times((dbeta + beta * beta) * work, phi)))
    one += bend * (1.0 - q * a)
    row.hinge[0] = row.hinge[3] = row.hinge[5] = one
    row.hinge[1] = row.hinge[2] = row.hinge[4] = 0.0
    add_product(row.hinge, twist, axis, axis)
    add_product(row.hinge, 1.0, phi, plus(times(bend * q, phi), times(curved, c)))
    return 0.5 * dot(mu, strain), dot(phi, t)


@inner
def add_hinges(rod: Rod, s: State, w: Records, curved: float) -> float:
    """Add bending and twist between base and tip. Returns the energy (mJ)."""
    total, twist, last = 0.0, 0.0, clamp(s)
    for i in range(len(w) - 1):
        frame = turn(w[i].frame)
        span = 0.5 * rod.segment if i == 0 else rod.segment  # half a segment from the clamp
        energy, turned = _add_hinge(rod, w[i], span, last, frame, curved)
        total, twist, last = total + energy, twist + turned, frame
    s.twist = twist
    return total
