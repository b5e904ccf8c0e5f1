"""Equilibrium of the needle: one sweep out to the tip, one sweep back (docs/theory.md section 3).

The part of the needle left of x answers a force F and a moment M from the right with

    (y, θ) = a + B (F, M),    B symmetric: its flexibility.

A span adds its own flexibility and a spring is a rank-one update, as in a Kalman filter; the way back
gives forces and positions. Nothing divides by a length, so nodes may be as close as they like, where the
usual stiffness matrix loses digits with the third power of the length.

A contact that the running step cuts rests on the path of the tip, whose end is unknown: rest =
cut_y + share (y_tip − cut_y). So a is carried as a + y_tip g, and y_tip found at the tip.
"""

import math

import numpy as np

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.model import CONTACT, GUIDE, Floats, Model
from flexneedle.mechanics.ogden import FLOOR_STRETCH, contact_law

# Scalars of a state: pose of base and guide, tip pose and tip spring now,
# tip pose and tip spring where the last step began to cut.
BASE_X, BASE_Y, BASE_TURN, GUIDE_Y, BEVEL, SHORTENING, TIP_LOAD, TIP_X, TIP_Y, TIP_TURN = range(10)
FRONT, REST, SPRING_U, CUT_X, CUT_Y, CUT_TURN, CUT_FRONT, CUT_REST = range(10, 18)
TIP_FORCE, TIP_REACTION, SPRING_ENERGY, BASE_SHEAR, BASE_MOMENT = range(18, 23)
COUPLING, PATH_Y, ITERATIONS, RESIDUAL, CONVERGED = range(23, 28)
CLAMP_Y, CLAMP_TURN, CLAMP_X = range(28, 31)  # the part of base y, turn and x that no command moved
GUIDE_SIDE = 31  # the wall of a guide with clearance that the needle bears on: 1 upper, −1 lower, 0 none
STATE_SIZE = 32

# Rows of the work array, one column a node. A1, G1, B11, B12 are those before an essential node, all else after.
A1, A2, G1, G2, B11, B12, B22, STIFFNESS, FORCE, ENERGY, SHARE, FIXED = range(12)
NEW_U, Y, TURN, SHEAR, MOMENT = range(12, 17)
WORK_ROWS = 17

COUPLED_ITERATIONS = 15
MAX_ITERATIONS = 100


@inner
def _prescribed(model: Model, s: Floats, rest: Floats, i: int) -> float:
    """Lateral position (mm) of an essential node; NaN at a guide with clearance that the needle does not touch."""
    if model.nodes.kind[i] != GUIDE or model.clearance <= 0.0:
        return float(rest[i])
    return float(rest[i] + s[GUIDE_SIDE] * model.clearance) if s[GUIDE_SIDE] != 0.0 else math.nan


@inner
def _contact(model: Model, u: Floats, i: int, behind: float) -> tuple[float, float, float]:
    """Force (N), stiffness (N/mm) and energy (mJ) of a contact so far (mm) behind the tip, over which it grows in."""
    nodes = model.nodes
    force, k, energy = contact_law(nodes.alpha[i], nodes.height[i], nodes.force[i], nodes.energy[i], u[i])
    if behind < nodes.reach[i]:
        ramp = behind / nodes.reach[i]
        force, k, energy = force * ramp, k * ramp, energy * ramp
    return force, k, energy


@inner
def _sweep_out(
    model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, tip_x: float, count: int, fresh: int
) -> tuple[float, ...]:
    """From the base to the tip: fill `w`, return (a1, a2, g1, g2, b11, b12, b22) just left of the tip spring."""
    nodes = model.nodes
    flexibility = 1.0 / model.bending_stiffness
    x, a1, a2 = s[BASE_X], s[BASE_Y], s[BASE_TURN]
    g1, g2, b11, b12, b22 = 0.0, 0.0, 0.0, 0.0, 0.0
    bend = s[BEVEL] * model.curvature
    per_length = 1.0 / (tip_x - s[CUT_X]) if fresh < count else 0.0
    path_y = (1.0 - s[COUPLING]) * s[PATH_Y]
    for i in range(count + 1):
        length = (nodes.x[i] if i < count else tip_x) - x
        x += length
        a1 += length * (a2 + 0.5 * length * bend)
        a2 += length * bend
        g1 += length * g2
        turn = length * flexibility
        b11 += length * (2.0 * b12 + length * (b22 + turn * (1.0 / 3.0)))
        b12 += length * (b22 + 0.5 * turn)
        b22 += turn
        if i == count:
            break
        if nodes.kind[i] != CONTACT:
            w[A1, i], w[G1, i], w[B11, i], w[B12, i] = a1, g1, b11, b12
            w[FIXED, i] = _prescribed(model, s, rest, i)
            if not math.isnan(w[FIXED, i]):
                gain = b12 / b11
                a2 += gain * (w[FIXED, i] - a1)
                g2 -= gain * g1
                b22 -= gain * b12
                a1, g1, b11, b12 = w[FIXED, i], 0.0, 0.0, 0.0
        else:
            force, k, energy = _contact(model, u, i, tip_x - x)
            share, fixed = 0.0, rest[i]
            if i >= fresh:
                share = (x - s[CUT_X]) * per_length
                fixed = s[CUT_Y] + share * (path_y - s[CUT_Y])
                share *= s[COUPLING]
            inverse = 1.0 / (1.0 + k * b11)
            push = (force + k * (u[i] + fixed - a1)) * inverse
            push_g = k * (share - g1) * inverse
            a1 += b11 * push
            a2 += b12 * push
            g1 += b11 * push_g
            g2 += b12 * push_g
            b22 -= k * inverse * b12 * b12
            b11 *= inverse
            b12 *= inverse
            w[A1, i], w[G1, i], w[B11, i], w[B12, i] = a1, g1, b11, b12
            w[STIFFNESS, i], w[FORCE, i], w[ENERGY, i] = k, force, energy
            w[SHARE, i], w[FIXED, i] = share, fixed
        w[A2, i], w[G2, i], w[B22, i] = a2, g2, b22
    return a1, a2, g1, g2, b11, b12, b22


@inner
def spring_rest(model: Model, s: Floats, tip_x: float) -> tuple[float, float]:
    """(fixed, slope): the tip spring rests at fixed + (1 − slope) y_tip; docs/theory.md eq. 8."""
    cut = tip_x - s[CUT_FRONT]
    if cut <= 0.0:
        return s[CUT_REST], 1.0
    offset = s[BEVEL] * model.bevel_offset
    y_front = s[CUT_Y] + s[CUT_TURN] * (s[CUT_FRONT] - s[CUT_X])
    lag = 0.0 if s[CUT_FRONT] <= 0.0 else s[CUT_REST] - y_front - offset
    ratio = cut / model.bevel_length
    slope = -math.expm1(-ratio) / ratio
    line = y_front + s[CUT_TURN] * cut
    fixed = line + offset + lag * math.exp(-ratio) - (1.0 - slope) * line
    if s[COUPLING] == 0.0:
        return fixed + (1.0 - slope) * s[PATH_Y], 1.0
    return fixed, slope


@inner
def spring_law(model: Model, s: Floats, tip_x: float, u: float) -> tuple[float, ...]:
    """Force (N), stiffness (N/mm) and energy (mJ) of the tip spring over its layers; sharpest α/h and least h."""
    layers = model.layers
    front = max(s[CUT_FRONT], tip_x)
    start, stop = max(0.0, front - model.bevel_length), tip_x
    force, k, energy, sharpness, height = 0.0, 0.0, 0.0, 0.0, np.inf
    top = 0.0
    for j in range(layers.end.size):
        part = min(stop, layers.end[j]) - max(start, top)
        top = layers.end[j]
        if part > 0.0:
            f, kk, e = contact_law(
                layers.alpha[j], layers.height[j], layers.force[j] * part, layers.energy[j] * part, u
            )
            force, k, energy = force + f, k + kk, energy + e
            sharpness = max(sharpness, (abs(layers.alpha[j]) + 2.0) / layers.height[j])
            height = min(height, layers.height[j])
    return force, k, energy, sharpness, height


@inner
def _judge(height: float, sharpness: float, u: float, new_u: float) -> tuple[float, float]:
    """(error, fraction): what is left after this Newton step (mm), and how much of the step may be taken.

    Newton converges quadratically, so about |Δu|² W_uuu/2W_uu is left; a step may use half the remaining stretch.
    """
    change = abs(new_u - u)
    stretch = 1.0 - abs(u) / height
    if stretch <= FLOOR_STRETCH:
        return change, 1.0
    error = min(change, sharpness * change * change / stretch)
    limit = 0.5 * (height + abs(u))
    if abs(new_u) <= limit:
        return error, 1.0
    return change, (math.copysign(limit, new_u) - u) / (new_u - u)


@inner
def _tip(model: Model, s: Floats, tip_x: float, held: float, ahead: tuple[float, ...]) -> tuple[float, ...]:
    """Solve the tip: y, turn, total lateral force, spring u and energy, (error, fraction), reaction if held."""
    a1, a2, g1, g2, b11, b12, _ = ahead
    fixed, slope = spring_rest(model, s, tip_x)
    u = s[SPRING_U]
    force, k, energy, sharpness, height = spring_law(model, s, tip_x, u)
    if math.isnan(held):
        load = s[TIP_LOAD] + force + k * (u + fixed)
        y = (a1 + b11 * load) / (1.0 - g1 + b11 * k * slope)
        total = load - k * slope * y
        reaction = 0.0
    else:
        y = held
        total = (y - a1 - y * g1) / b11
        reaction = total - s[TIP_LOAD] - force + k * (slope * y - fixed - u)
    new_u = slope * y - fixed
    change = new_u - u
    stored = energy - (force - 0.5 * k * change) * change
    error, fraction = _judge(height, sharpness, u, new_u) if k > 0.0 else (0.0, 1.0)
    return y, a2 + y * g2 + b12 * total, total, new_u, stored, error, fraction, reaction


@inner
def _sweep_back(model: Model, s: Floats, u: Floats, w: Floats, tip: tuple[float, ...], count: int) -> float:
    """From the tip to the base: positions, loads and new compressions into `w`, the shortening ½∫y'² (mm) returned."""
    nodes = model.nodes
    flexibility = 1.0 / model.bending_stiffness
    bend = s[BEVEL] * model.curvature
    x, y, turn, shear = tip
    y_tip = y
    moment = 0.0
    shortening = 0.0
    for i in range(count - 1, -2, -1):
        length = x - (nodes.x[i] if i >= 0 else s[BASE_X])
        x -= length
        middle = turn - (0.5 * moment + 0.125 * shear * length) * length * flexibility - 0.5 * length * bend
        moment += shear * length
        right = turn
        if i < 0:
            turn = s[BASE_TURN]
        elif nodes.kind[i] != CONTACT and math.isnan(w[FIXED, i]):
            y = w[A1, i] + y_tip * w[G1, i] + w[B11, i] * shear + w[B12, i] * moment
            turn = w[A2, i] + y_tip * w[G2, i] + w[B12, i] * shear + w[B22, i] * moment
            w[SHEAR, i], w[MOMENT, i], w[Y, i], w[TURN, i], w[FORCE, i] = shear, moment, y, turn, 0.0
        elif nodes.kind[i] != CONTACT:
            y = w[FIXED, i]
            turn = w[A2, i] + y_tip * w[G2, i] + w[B22, i] * moment
            w[SHEAR, i], w[MOMENT, i], w[Y, i], w[TURN, i] = shear, moment, y, turn
            free = w[A1, i] + y_tip * w[G1, i] + w[B11, i] * shear + w[B12, i] * moment
            w[FORCE, i] = (y - free) / w[B11, i]
            shear += w[FORCE, i]
        else:
            y = w[A1, i] + y_tip * w[G1, i] + w[B11, i] * shear + w[B12, i] * moment
            turn = w[A2, i] + y_tip * w[G2, i] + w[B12, i] * shear + w[B22, i] * moment
            compression = y - w[FIXED, i] - w[SHARE, i] * y_tip
            w[SHEAR, i], w[MOMENT, i], w[Y, i], w[TURN, i] = shear, moment, y, turn
            w[NEW_U, i] = compression
            shear += w[FORCE, i] - w[STIFFNESS, i] * (compression - u[i])
        shortening += length * (
            turn * turn + 4.0 * middle * middle + right * right + middle * (turn + right) - 0.5 * turn * right
        )
    s[BASE_SHEAR], s[BASE_MOMENT] = shear, moment
    return shortening / 15.0


@inner
def _limit(
    model: Model, u: Floats, w: Floats, count: int, error: float, fraction: float
) -> tuple[float, float]:
    """(error, fraction) of `_judge`, the worst over all contacts."""
    nodes = model.nodes
    for i in range(count):
        if nodes.kind[i] == CONTACT:
            sharpness = (abs(nodes.alpha[i]) + 2.0) / nodes.height[i]
            left, part = _judge(nodes.height[i], sharpness, u[i], w[NEW_U, i])
            error, fraction = max(error, left), min(fraction, part)
    return error, fraction


@inner
def _move_by(model: Model, u: Floats, w: Floats, count: int, fraction: float) -> None:
    """Take `fraction` of the Newton step; the energies follow to third order in the full step."""
    for i in range(count):
        if model.nodes.kind[i] == CONTACT:
            change = w[NEW_U, i] - u[i]
            w[ENERGY, i] -= (w[FORCE, i] - 0.5 * w[STIFFNESS, i] * change) * change
            u[i] += fraction * change


@inner
def _overshoot(
    model: Model, s: Floats, u: Floats, w: Floats, count: int, tip_x: float, new_u: float, t: float
) -> float:
    """Slope of the energy along the Newton step at `t`, less the beam's part (never negative) of 1 − t."""
    nodes = model.nodes
    change = new_u - s[SPRING_U]
    force, k, _, _, _ = spring_law(model, s, tip_x, s[SPRING_U])
    slope = (force - k * change - spring_law(model, s, tip_x, s[SPRING_U] + t * change)[0]) * change
    for i in range(count):
        if nodes.kind[i] == CONTACT:
            change = w[NEW_U, i] - u[i]
            ramp = min(1.0, (tip_x - nodes.x[i]) / nodes.reach[i])
            force, _, _ = contact_law(
                nodes.alpha[i], nodes.height[i], nodes.force[i], nodes.energy[i], u[i] + t * change
            )
            slope += (w[FORCE, i] - w[STIFFNESS, i] * change - ramp * force) * change
    return float(slope)


@inner
def _line_search(
    model: Model, s: Floats, u: Floats, w: Floats, count: int, tip_x: float, new_u: float
) -> float:
    """The fraction of a Newton step at which the convex energy still falls: no cycle can form."""
    if _overshoot(model, s, u, w, count, tip_x, new_u, 1.0) <= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        if _overshoot(model, s, u, w, count, tip_x, new_u, middle) > 0.0:
            high = middle
        else:
            low = middle
    return low if low > 0.0 else high


@inner
def _count_below(x: Floats, value: float) -> int:
    """How many of the sorted `x` are below `value`."""
    low, high = 0, x.size
    while low < high:
        middle = (low + high) // 2
        if x[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@inner
def _iterate(
    model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, held: float
) -> tuple[int, int, float, float]:
    """One Newton iteration, in place; returns (nodes behind the tip, first one being cut, error, change of x)."""
    x = model.nodes.x
    coupled = s[COUPLING] > 0.0
    tip_x = s[BASE_X] + model.length - s[SHORTENING]
    count = _count_below(x, tip_x)
    fresh = count
    while fresh > 0 and x[fresh - 1] > s[CUT_FRONT]:
        fresh -= 1
    ahead = _sweep_out(model, s, rest, u, w, tip_x, count, fresh)
    y, turn, force, new_u, stored, error, fraction, reaction = _tip(model, s, tip_x, held, ahead)
    shortening = _sweep_back(model, s, u, w, (tip_x, y, turn, force), count)
    error, fraction = _limit(model, u, w, count, error, fraction)
    if not coupled and error > model.tolerance:
        fraction = min(fraction, _line_search(model, s, u, w, count, tip_x, new_u))
    _move_by(model, u, w, count, fraction)
    s[SPRING_U] += fraction * (new_u - s[SPRING_U])
    s[TIP_X], s[TIP_Y], s[TIP_TURN], s[TIP_FORCE] = tip_x, y, turn, force
    s[TIP_REACTION], s[SPRING_ENERGY] = reaction, stored
    slide = 0.0
    if coupled:
        slide = abs(shortening - s[SHORTENING])
        s[SHORTENING] = shortening
    elif error <= model.tolerance:
        s[SHORTENING] = shortening
    return count, fresh, error if fraction == 1.0 else math.inf, slide


@inner
def _guide_agrees(model: Model, s: Floats, rest: Floats, w: Floats, count: int) -> bool:
    """Whether the needle bears on the wall of the guide that it was taken to bear on; else that is changed.

    A wall only pushes, and between the walls nothing does: one inequality of a convex problem, so that few changes do.
    """
    if count == 0 or model.nodes.kind[0] != GUIDE or model.clearance <= 0.0:
        return True
    side, off = s[GUIDE_SIDE], w[Y, 0] - rest[0]
    if side != 0.0:
        s[GUIDE_SIDE] = 0.0 if w[FORCE, 0] * side > 0.0 else side
    elif abs(off) > model.clearance:
        s[GUIDE_SIDE] = math.copysign(1.0, off)
    return bool(s[GUIDE_SIDE] == side)


@inner
def guess(model: Model, s: Floats, u: Floats) -> None:
    """First guess: contacts to be cut are unstrained, the tip follows its own line."""
    tip_x = s[BASE_X] + model.length - s[SHORTENING]
    s[PATH_Y] = s[CUT_Y] + s[CUT_TURN] * (tip_x - s[CUT_X])
    for i in range(_count_below(model.nodes.x, s[CUT_FRONT]), _count_below(model.nodes.x, tip_x + 1.0)):
        u[i] = 0.0
    fixed, slope = spring_rest(model, s, tip_x)
    s[SPRING_U] = slope * s[PATH_Y] - fixed


@inner
def solve(model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, held: float) -> tuple[int, int]:
    """Find the equilibrium for the base and guide in `s`; a `held` tip (mm, NaN if free) is an essential condition.

    The shortening and the end of the path being cut are found with it. Where that does not converge, both are
    taken from the start of the step: what is left is the minimum of a convex energy, found with a line search.

    Work arrays: `s` (STATE_SIZE,), `rest` and `u` (n,) are updated in place, `w` (WORK_ROWS, n) is filled.
    Returns (nodes behind the tip, index of the first being cut); s[RESIDUAL] estimates the error left (mm).
    """
    start = s[SHORTENING]
    s[COUPLING] = 1.0
    guess(model, s, u)
    for iteration in range(1, MAX_ITERATIONS + 1):
        if iteration == COUPLED_ITERATIONS + 1:
            s[COUPLING], s[SHORTENING] = 0.0, start
            guess(model, s, u)
        count, fresh, error, slide = _iterate(model, s, rest, u, w, held)
        agrees = error <= model.tolerance and slide <= model.tolerance
        agrees = agrees and _guide_agrees(model, s, rest, w, count)
        if agrees:
            break
    s[ITERATIONS], s[RESIDUAL] = iteration, max(error, slide)
    finite = math.isfinite(s[TIP_Y]) and math.isfinite(s[SHORTENING])
    s[CONVERGED] = 1.0 if finite and agrees else 0.0
    return count, fresh
