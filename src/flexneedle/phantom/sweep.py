"""A Newton step of the exact needle: one sweep from the tip to the base and one pass back (docs/theory.md section 11).

A segment is a stage of an optimal control problem with the state (δp_i, δ_{i−1}) and the control δ_i, the rotation
of its frame, so that a step with exact second derivatives takes O(N).
"""

from typing import NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.phantom.rod import Records, Rod, State
from flexneedle.phantom.space import (
    Matrix,
    Symmetric,
    Vector,
    cross,
    cross_columns,
    dot,
    full,
    length,
    less,
    minus,
    of_columns,
    of_rows,
    plus,
    put,
    put_rows,
    rows,
    symmetric,
    times,
    total,
    vector,
)

_LEVER_MM = 1.0  # at which a roll counts as a displacement
_LEAST_PIVOT = 1e-3  # of the hinge's stiffness


class _Beyond(NamedTuple):
    """Cost of all stages from one on: gradient and second derivatives, and the resultant force on the needle (N).

    p, pp, pt: in the node; t, tt, pt: in the previous rotation.
    """

    pp: Matrix
    pt: Matrix
    tt: Matrix
    p: Vector
    t: Vector
    force: Vector


@inner
def _invert(m: Symmetric, least: float) -> tuple[bool, Symmetric]:
    """Return whether all pivots of a symmetric matrix are above `least`, and its inverse."""
    a, b, c, d, e, f = m
    minor = a * d - b * b
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * x + b * y + c * z
    if not (a > least and minor > least * a and det > least * minor):
        return False, m
    k = 1.0 / det
    return True, (k * x, k * y, k * z, k * (a * f - c * c), k * (b * c - a * e), k * minor)


@inner
def _own_rotation(row: Records, arm: Vector, beyond: _Beyond, curved: float) -> tuple[Matrix, Symmetric]:
    """Return second derivatives in (node, rotation) and in the rotation of a segment, without its own hinge.

    The next node moves by δp + δ × arm, up to the second power of δ by ½ δ × (δ × arm).
    """
    pa = (cross(arm, beyond.pp[0]), cross(arm, beyond.pp[1]), cross(arm, beyond.pp[2]))
    v = cross_columns(arm, total(pa, total(beyond.pt, beyond.pt)))
    x, y, z = times(0.5 * curved, beyond.force)
    along = 2.0 * (x * arm[0] + y * arm[1] + z * arm[2])
    h, tt = symmetric(row.tt), beyond.tt
    return total(rows(row.pt), total(pa, beyond.pt)), (
        h[0] + tt[0][0] + v[0][0] + 2.0 * x * arm[0] - along,
        h[1] + tt[0][1] + 0.5 * (v[0][1] + v[1][0]) + x * arm[1] + y * arm[0],
        h[2] + tt[0][2] + 0.5 * (v[0][2] + v[2][0]) + x * arm[2] + z * arm[0],
        h[3] + tt[1][1] + v[1][1] + 2.0 * y * arm[1] - along,
        h[4] + tt[1][2] + 0.5 * (v[1][2] + v[2][1]) + y * arm[2] + z * arm[1],
        h[5] + tt[2][2] + v[2][2] + 2.0 * z * arm[2] - along,
    )


@inner
def _stage(rod: Rod, row: Records, beyond: _Beyond, least: float, curved: float) -> tuple[bool, _Beyond]:
    """Eliminate the rotation of a segment: its gains, and the cost from it on; False if its pivots are too small."""
    arm, moment = times(rod.segment, vector(row.tangent)), vector(row.moment)
    w, s = _own_rotation(row, arm, beyond, curved)
    b = symmetric(row.hinge)
    definite, m = _invert(
        (b[0] + s[0], b[1] + s[1], b[2] + s[2], b[3] + s[3], b[4] + s[4], b[5] + s[5]), least
    )
    if not definite:
        return False, beyond
    inv, (x, y, z) = full(m), times(0.5 * curved, moment)
    rest = plus(vector(row.couple), plus(cross(arm, beyond.p), beyond.t))
    # The hinge couples both rotations by [m]×/2 besides its stiffness b: with Y = S + [m]×/2 and M = b + S no small
    # difference of large numbers is left.
    last = ((s[0], s[1] - z, s[2] + y), (s[1] + z, s[3], s[4] - x), (s[2] - y, s[4] + x, s[5]))
    # By rows of their factors: δ_i = gain − nodeᵀ δp_i + δ_{i−1} − hingeᵀ δ_{i−1}.
    gain = times(-1.0, of_rows(inv, plus(rest, moment)))
    node = (of_rows(inv, w[0]), of_rows(inv, w[1]), of_rows(inv, w[2]))
    hinge = (of_rows(inv, last[0]), of_rows(inv, last[1]), of_rows(inv, last[2]))
    put(row.gain, gain)
    put_rows(row.gain_node, node)
    put_rows(row.gain_last, hinge)
    force = vector(row.force)
    return True, _Beyond(
        pp=less(total(full(symmetric(row.pp)), beyond.pp), w, node),
        pt=(
            minus(w[0], of_rows(hinge, w[0])),
            minus(w[1], of_rows(hinge, w[1])),
            minus(w[2], of_rows(hinge, w[2])),
        ),
        tt=less(full(s), last, hinge),
        p=plus(force, plus(beyond.p, of_rows(w, gain))),
        t=plus(rest, of_rows(last, gain)),
        force=plus(beyond.force, force),
    )


@inner
def sweep(rod: Rod, s: State, w: Records, curved: float) -> bool:
    """Make a Riccati sweep from the tip to the base: the gains of a Newton step, and the reactions at the base.

    Returns False if the Hessian is not positive definite, where a Newton step may lead uphill.
    """
    n, none = len(w) - 1, (0.0, 0.0, 0.0)
    zero, force = (none, none, none), vector(w[n].force)
    beyond = _Beyond(full(symmetric(w[n].pp)), zero, zero, force, none, force)
    least = _LEAST_PIVOT * min(rod.stiffness, rod.torsion) / rod.segment
    for i in range(n - 1, -1, -1):
        definite, beyond = _stage(rod, w[i], beyond, least, curved)
        if not definite:
            return False
    put(s.base_force, beyond.force)
    put(s.base_moment, times(-1.0, vector(w[0].moment)))
    return True


@inner
def newton_step(rod: Rod, w: Records) -> float:
    """Write the rotations of the segments into `step`; return the largest displacement of a node (mm)."""
    moved = last = (0.0, 0.0, 0.0)
    largest = 0.0
    for i in range(len(w) - 1):
        row = w[i]
        change = plus(vector(row.gain), minus(last, of_columns(rows(row.gain_last), last)))
        change = minus(change, of_columns(rows(row.gain_node), moved))
        put(row.step, change)
        t = vector(row.tangent)
        moved = plus(moved, times(rod.segment, cross(change, t)))
        last = change
        largest = max(largest, length(moved), _LEVER_MM * abs(dot(change, t)))
    return largest


@inner
def slope(rod: Rod, w: Records) -> float:
    """Return the work (mJ) of the unbalanced forces along the step in `step`; negative for a descent direction."""
    moved = last = (0.0, 0.0, 0.0)
    total = 0.0
    for i in range(len(w) - 1):
        row = w[i]
        change = vector(row.step)
        total += dot(vector(row.force), moved) + dot(vector(row.couple), change)
        total += dot(vector(row.moment), minus(change, last))
        moved = plus(moved, times(rod.segment, cross(change, vector(row.tangent))))
        last = change
    return total + dot(vector(w[len(w) - 1].force), moved)
