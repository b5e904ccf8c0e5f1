"""Hinges between the segments of the exact needle: bending and twist by any angle (docs/theory.md section 11)."""

from flexneedle.mechanics.compile import inner
from flexneedle.phantom.rod import Records, Rod, State
from flexneedle.phantom.space import (
    Turn,
    add_product,
    after,
    cross,
    dot,
    inverse,
    logarithm,
    minus,
    plus,
    put,
    second_axis,
    third_axis,
    tilt_turn,
    times,
    turn,
    vector,
)


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
