"""The exact plant of before in the plane, by angles of its segments: the oracle of the kernel in space with z = 0.

A chain of N rigid segments of length h with angles θ_i, hinged by springs against bending; the rest as in section 11 of
docs/theory.md. Only its law is that of the package. Arrays are as it had them; `Needle` drives it as the plant.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.law import response, stored_energy
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, STILL

Floats = NDArray[np.float64]

# Scalars of a rod: base and guide, direction of the bevel, normal offset of the bevel's rest point from the tip,
# length and pose of the front of the channel, tip pose, end load, results; CURVED is 1 for the full Hessian, 0 for its
# positive semidefinite Gauss-Newton part.
BASE_X, BASE_Y, BASE_TURN, GUIDE_Y, BEVEL, OFFSET, CUT, FRONT_X, FRONT_Y, FRONT_TURN = range(10)
TIP_X, TIP_Y, TIP_TURN, LOAD_X, LOAD_Y, SLIDE = range(10, 16)
ITERATIONS, RESIDUAL, CONVERGED, ENERGY, STRAIN_ENERGY, LEAST_STRETCH = range(16, 22)
BASE_FORCE_X, BASE_FORCE_Y, BASE_MOMENT, GUIDE_FORCE, CURVED = range(22, 27)
SIZE = 27

# Rows of the channel, one column per point: position, distance along the path, segment, constants of its law.
C_X, C_Y, C_CUT, C_SEGMENT, C_LAW, C_HEIGHT, C_STIFFNESS, C_WEIGHT = range(8)
CHANNEL_ROWS = 8

# Rows of the work array, one column per segment (the last one the tip): node, gradient, Hessian, gains,
# friction, Newton step, bending moment before it.
X, Y, GX, GY, GT, HXX, HXY, HYY, HXT, HYT, HTT, K0, K1, K2, K3, FX, FY, TRIAL, MOMENT = range(19)
WORK_ROWS = 19

TOLERANCE_MM = 1e-9
ACCEPTED_MM = 1e-6  # a solve may stall above TOLERANCE_MM where a point is added or the tip crosses the skin
MAX_ITERATIONS = 60
_LONGEST_MM = 2.0  # largest displacement of a node in an iteration
_SMALL_MM = 1e-8  # a Newton step below it is accepted without a line search
_HALVINGS = 16  # of a Newton step, from _LONGEST_MM to _SMALL_MM
_STEADY = 0.1  # of a segment: distance of a foot point outside of its segment before the segment changes


class Rod(NamedTuple):
    """Constants, those of the kernel in space without torsion.

    Bending stiffness (N·mm²), segment length (mm), natural curvature (1/mm, for bevel +1), bevel
    offset and length (mm), guide plane (mm, NaN: none), its clearance (mm) and stiffness (N/mm), friction (N/mm),
    spacing of channel points (mm); laws: tables of `mechanics.law`; tissue by depth in cells of `cell` mm: index of its
    law, height (mm), initial stiffness (N/mm) of 1 mm of needle, and layer weight.
    """

    stiffness: float
    segment: float
    curvature: float
    bevel_offset: float
    bevel_length: float
    guide_x: float
    clearance: float
    guide_stiffness: float
    friction: float
    spacing: float
    cell: float
    laws: Floats
    law: NDArray[np.int64]
    height: Floats
    foundation: Floats
    weight: Floats


@inner
def _law(table: Floats, height: float, stiffness: float, u: float) -> tuple[float, float, float, float]:
    """dW/du (N), d²W/du² (N/mm), W (mJ) and stretch of tissue displaced by u (mm)."""
    e = abs(u) / height
    law = response(table, e)
    stored = stiffness * height * height * stored_energy(table, e)
    return stiffness * law.secant * u, stiffness * law.tangent, stored, 1.0 - e


@inner
def _update_nodes(rod: Rod, s: Floats, w: Floats, theta: Floats) -> None:
    """Nodes from angles; the tip into the scalars."""
    n = theta.size
    w[X, 0], w[Y, 0] = s[BASE_X], s[BASE_Y]
    for i in range(n):
        w[X, i + 1] = w[X, i] + rod.segment * math.cos(theta[i])
        w[Y, i + 1] = w[Y, i] + rod.segment * math.sin(theta[i])
    s[TIP_X], s[TIP_Y], s[TIP_TURN] = w[X, n], w[Y, n], theta[n - 1]


@inner
def _add_guide(rod: Rod, s: Floats, w: Floats, theta: Floats) -> float:
    """The guide: a stiff wall beyond its clearance, across the needle. Returns its energy (mJ)."""
    s[GUIDE_FORCE] = 0.0
    if math.isnan(rod.guide_x) or w[X, theta.size] <= rod.guide_x:
        return 0.0
    i = 0
    while w[X, i + 1] <= rod.guide_x:
        i += 1
    reach = rod.guide_x - w[X, i]
    slope = math.tan(theta[i])
    square = 1.0 + slope * slope
    off = w[Y, i] + reach * slope - s[GUIDE_Y]
    excess = abs(off) - rod.clearance
    if excess <= 0.0:
        return 0.0
    k, f = rod.guide_stiffness, math.copysign(rod.guide_stiffness * excess, off)
    arm = reach * square
    w[GX, i] -= f * slope
    w[GY, i] += f
    w[GT, i] += f * arm
    w[HXX, i] += k * slope * slope
    w[HXY, i] -= k * slope
    w[HYY, i] += k
    w[HXT, i] -= k * slope * arm + s[CURVED] * f * square
    w[HYT, i] += k * arm
    w[HTT, i] += k * arm * arm + s[CURVED] * f * 2.0 * arm * slope
    s[GUIDE_FORCE] = -f
    return float(0.5 * k * excess * excess)


@inner
def _foot(rod: Rod, w: Floats, theta: Floats, x: float, y: float, first: int) -> tuple[int, float]:
    """Segment nearest to a channel point, and the distance along it (mm); the search starts at `first`."""
    i = min(max(first, 0), theta.size - 1)
    low, high = -_STEADY * rod.segment, (1.0 + _STEADY) * rod.segment
    along = (x - w[X, i]) * math.cos(theta[i]) + (y - w[Y, i]) * math.sin(theta[i])
    while along < low and i > 0:
        i -= 1
        along = (x - w[X, i]) * math.cos(theta[i]) + (y - w[Y, i]) * math.sin(theta[i])
    while along > high and i < theta.size - 1:
        i += 1
        along = (x - w[X, i]) * math.cos(theta[i]) + (y - w[Y, i]) * math.sin(theta[i])
    return i, along


@inner
def _add_channel(rod: Rod, s: Floats, w: Floats, theta: Floats, channel: Floats, count: int) -> float:
    """Tissue at the channel's points, along the normal of the needle. Returns its energy (mJ)."""
    n = theta.size
    tip_cos, tip_sin = math.cos(theta[n - 1]), math.sin(theta[n - 1])
    total, weighted, least = 0.0, 0.0, 1.0
    for j in range(count):
        x, y = channel[C_X, j], channel[C_Y, j]
        behind = (w[X, n] - x) * tip_cos + (w[Y, n] - y) * tip_sin
        if behind <= 0.0:
            continue
        i, along = _foot(rod, w, theta, x, y, int(channel[C_SEGMENT, j]))
        channel[C_SEGMENT, j] = i
        nx, ny = -math.sin(theta[i]), math.cos(theta[i])
        u = (w[X, i] - x) * nx + (w[Y, i] - y) * ny
        table = rod.laws[int(channel[C_LAW, j])]
        f, k, stored, stretch = _law(table, channel[C_HEIGHT, j], channel[C_STIFFNESS, j], u)
        ramp = min(1.0, behind / (0.5 * rod.spacing))
        f, k, stored = f * ramp, k * ramp, stored * ramp
        w[GX, i] += f * nx
        w[GY, i] += f * ny
        w[GT, i] += f * along
        w[HXX, i] += k * nx * nx
        w[HXY, i] += k * nx * ny
        w[HYY, i] += k * ny * ny
        f *= s[CURVED]
        w[HXT, i] += k * nx * along - f * ny
        w[HYT, i] += k * ny * along + f * nx
        w[HTT, i] += k * along * along - f * u
        total += stored
        weighted += channel[C_WEIGHT, j] * stored
        least = min(least, stretch)
    s[STRAIN_ENERGY], s[LEAST_STRETCH] = weighted, least
    return total


@inner
def _cut_length(s: Floats) -> float:
    """Distance (mm) of the tip past the front of the channel, in its direction; negative after retraction."""
    if s[CUT] <= 0.0:  # no channel yet: the front is at the skin
        return float(s[TIP_X] / math.cos(s[TIP_TURN]))
    dx, dy = s[TIP_X] - s[FRONT_X], s[TIP_Y] - s[FRONT_Y]
    return float(dx * math.cos(s[FRONT_TURN]) + dy * math.sin(s[FRONT_TURN]))


@inner
def _new_offset(rod: Rod, s: Floats, before: tuple[float, float, float]) -> tuple[float, float]:
    """(ρ, g): normal offset of the bevel's rest point from the tip after the move, and −dρ/d(drift)."""
    middle = 0.5 * (before[2] + s[TIP_TURN])
    drift = -(s[TIP_X] - before[0]) * math.sin(middle) + (s[TIP_Y] - before[1]) * math.cos(middle)
    cut = _cut_length(s)
    if cut <= 0.0:
        return (s[OFFSET] - drift if s[TIP_X] > 0.0 else 0.0), 1.0
    wanted = s[BEVEL] * rod.bevel_offset
    start = s[OFFSET] if s[CUT] > 0.0 else wanted  # the spring enters the skin fully compressed
    ratio = cut / rod.bevel_length
    g = -math.expm1(-ratio) / ratio
    return wanted + (start - wanted) * math.exp(-ratio) - g * drift, g


@inner
def _add_bevel(rod: Rod, s: Floats, w: Floats, n: int, before: tuple[float, float, float]) -> float:
    """The bevel's spring, normal to the tip, in the tissue around it. Returns its energy (mJ)."""
    if not s[TIP_X] > 0.0:  # NaN included
        return 0.0
    offset, g = _new_offset(rod, s, before)
    angle = s[TIP_TURN]
    nx, ny, per_x = -math.sin(angle), math.cos(angle), 1.0 / math.cos(angle)
    front = s[TIP_X] - min(0.0, _cut_length(s)) * math.cos(angle)
    top, bottom = max(0.0, front - rod.bevel_length / per_x), s[TIP_X]
    force, stiffness, stored = 0.0, 0.0, 0.0
    first = int(top / rod.cell)
    for c in range(first, min(int(bottom / rod.cell), rod.law.size - 1) + 1):
        length = (min(bottom, (c + 1) * rod.cell) - max(top, c * rod.cell)) * per_x
        if length > 0.0:
            f, k, e, _ = _law(rod.laws[rod.law[c]], rod.height[c], rod.foundation[c] * length, -offset)
            force, stiffness, stored = force + f, stiffness + k, stored + e
    w[GX, n] += force * nx
    w[GY, n] += force * ny
    w[HXX, n] += g * stiffness * nx * nx
    w[HXY, n] += g * stiffness * nx * ny
    w[HYY, n] += g * stiffness * ny * ny
    return stored


@inner
def _assemble(
    rod: Rod,
    s: Floats,
    w: Floats,
    theta: Floats,
    channel: Floats,
    count: int,
    before: tuple[float, float, float],
) -> None:
    """Fill gradient and Hessian rows of the loads; the energy stored (mJ) into the scalars."""
    n = theta.size
    for row in range(GX, HTT + 1):
        for i in range(n + 1):
            w[row, i] = 0.0
    total = _add_guide(rod, s, w, theta) + _add_channel(rod, s, w, theta, channel, count)
    total += _add_bevel(rod, s, w, n, before)
    w[GX, n] -= s[LOAD_X]
    w[GY, n] -= s[LOAD_Y]
    for i in range(n):
        w[GX, i] -= w[FX, i]
        w[GY, i] -= w[FY, i]
    last = s[BASE_TURN]
    for i in range(n):
        length = 0.5 * rod.segment if i == 0 else rod.segment  # half a segment from the clamp
        bending = theta[i] - last - s[BEVEL] * rod.curvature * length
        w[MOMENT, i] = rod.stiffness / length * bending
        total += 0.5 * w[MOMENT, i] * bending
        last = theta[i]
    s[ENERGY] = total


@inner
def _sweep(rod: Rod, s: Floats, w: Floats, theta: Floats) -> bool:
    """Riccati sweep from the tip to the base: the gains of a Newton step, and the reactions at the base.

    Returns False if the Hessian is not positive definite, where a Newton step may lead uphill.
    """
    n = theta.size
    pxx, pxy, pyy, pxt, pyt, ptt = w[HXX, n], w[HXY, n], w[HYY, n], 0.0, 0.0, 0.0
    qx, qy, qt = w[GX, n], w[GY, n], 0.0
    ax, ay = w[GX, n], w[GY, n]  # resultant force on the needle from here to the tip
    for i in range(n - 1, -1, -1):
        b = rod.stiffness / (0.5 * rod.segment if i == 0 else rod.segment)
        c, d = w[X, i + 1] - w[X, i], w[Y, i + 1] - w[Y, i]
        wx = w[HXT, i] - pxx * d + pxy * c + pxt
        wy = w[HYT, i] - pxy * d + pyy * c + pyt
        rest = w[HTT, i] + d * d * pxx - 2.0 * c * d * pxy + c * c * pyy + 2.0 * (c * pyt - d * pxt) + ptt
        rest -= s[CURVED] * (ax * c + ay * d)
        if rest <= -0.999 * b:
            return False
        gradient = w[GT, i] + w[MOMENT, i] - d * qx + c * qy + qt
        inverse = 1.0 / (b + rest)
        w[K0, i], w[K1, i], w[K2, i], w[K3, i] = (
            -gradient * inverse,
            -wx * inverse,
            -wy * inverse,
            b * inverse,
        )
        pxx += w[HXX, i] - wx * wx * inverse
        pxy += w[HXY, i] - wx * wy * inverse
        pyy += w[HYY, i] - wy * wy * inverse
        pxt, pyt, ptt = wx * b * inverse, wy * b * inverse, b * rest * inverse
        qx += w[GX, i] - wx * gradient * inverse
        qy += w[GY, i] - wy * gradient * inverse
        qt = -w[MOMENT, i] + b * gradient * inverse
        ax += w[GX, i]
        ay += w[GY, i]
    s[BASE_FORCE_X], s[BASE_FORCE_Y], s[BASE_MOMENT] = ax, ay, -w[MOMENT, 0]
    return True


@inner
def _newton_step(w: Floats, n: int) -> float:
    """Steps of the angles into TRIAL; returns the largest displacement of a node (mm)."""
    dx, dy, last, largest = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        change = w[K0, i] + w[K1, i] * dx + w[K2, i] * dy + w[K3, i] * last
        w[TRIAL, i] = change
        dx -= (w[Y, i + 1] - w[Y, i]) * change
        dy += (w[X, i + 1] - w[X, i]) * change
        last = change
        largest = max(largest, math.hypot(dx, dy))
    return largest


@inner
def _slope(w: Floats, n: int) -> float:
    """Work (mJ) of the unbalanced forces along the step in TRIAL; negative for a descent direction."""
    dx, dy, last, total = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        change = w[TRIAL, i]
        total += w[GX, i] * dx + w[GY, i] * dy + w[GT, i] * change + w[MOMENT, i] * (change - last)
        dx -= (w[Y, i + 1] - w[Y, i]) * change
        dy += (w[X, i + 1] - w[X, i]) * change
        last = change
    return float(total + w[GX, n] * dx + w[GY, n] * dy)


@inner
def _set_friction(rod: Rod, s: Floats, w: Floats, theta: Floats) -> None:
    """Friction opposite to the last sliding direction, on the part of each segment inside the tissue."""
    for i in range(theta.size):
        left, right = w[X, i], w[X, i + 1]
        inside = 0.0
        if right > 0.0 and right > left:
            inside = rod.segment * min(1.0, right / (right - left))
        w[FX, i] = -s[SLIDE] * rod.friction * inside * math.cos(theta[i])
        w[FY, i] = -s[SLIDE] * rod.friction * inside * math.sin(theta[i])


@inner
def _solve(rod: Rod, s: Floats, w: Floats, theta: Floats, channel: Floats, count: int) -> None:
    """Solve for equilibrium with base, guide, bevel and loads in `s`, in place."""
    n = theta.size
    before = (s[TIP_X], s[TIP_Y], s[TIP_TURN])
    _update_nodes(rod, s, w, theta)
    _set_friction(rod, s, w, theta)
    s[CURVED] = 1.0
    _assemble(rod, s, w, theta, channel, count, before)
    largest = np.inf
    iteration = 0
    while iteration < MAX_ITERATIONS and largest > TOLERANCE_MM:
        iteration += 1
        if not _sweep(rod, s, w, theta):  # near buckling, or a poor initial guess
            s[CURVED] = 0.0
            _assemble(rod, s, w, theta, channel, count, before)
            _sweep(rod, s, w, theta)
            s[CURVED] = 1.0
        largest = _newton_step(w, n)
        share = min(1.0, _LONGEST_MM / max(largest, 1e-300))
        # Line search on the residual, since bevel and friction have no energy.
        enough = -0.5 * _slope(w, n)
        done = 0.0
        for _ in range(_HALVINGS):
            for i in range(n):
                theta[i] += (share - done) * w[TRIAL, i]
            _update_nodes(rod, s, w, theta)
            _assemble(rod, s, w, theta, channel, count, before)
            if share * largest < _SMALL_MM or _slope(w, n) <= enough:
                break
            done, share = share, 0.5 * share
        if share < 1.0:
            largest = np.inf
    stable = _sweep(rod, s, w, theta)
    s[ITERATIONS], s[RESIDUAL] = iteration, _newton_step(w, n)
    found = stable and s[RESIDUAL] <= ACCEPTED_MM and math.isfinite(s[TIP_X] + s[TIP_Y])
    s[CONVERGED] = 1.0 if found else 0.0
    s[OFFSET] = _new_offset(rod, s, before)[0]


@inner
def _extend(rod: Rod, s: Floats, channel: Floats, count: int, segments: int) -> int:
    """Extend the channel along the tip's path with a point every `spacing`; returns the number of points."""
    cut = _cut_length(s)
    if s[TIP_X] <= 0.0:
        s[CUT], s[OFFSET] = 0.0, 0.0
        return 0
    if cut <= 0.0:
        return count
    if s[CUT] <= 0.0:
        s[FRONT_X], s[FRONT_Y] = 0.0, s[TIP_Y] - s[TIP_X] * math.tan(s[TIP_TURN])
    while (count + 0.5) * rod.spacing < s[CUT] + cut and count < channel.shape[1]:
        share = ((count + 0.5) * rod.spacing - s[CUT]) / cut
        x = s[FRONT_X] + share * (s[TIP_X] - s[FRONT_X])
        c = min(int(x / rod.cell), rod.law.size - 1)
        channel[C_X, count] = x
        channel[C_Y, count] = s[FRONT_Y] + share * (s[TIP_Y] - s[FRONT_Y])
        channel[C_CUT, count] = (count + 0.5) * rod.spacing
        channel[C_SEGMENT, count] = segments - 1
        channel[C_LAW, count], channel[C_HEIGHT, count] = rod.law[c], rod.height[c]
        channel[C_STIFFNESS, count] = rod.foundation[c] * rod.spacing
        channel[C_WEIGHT, count] = rod.weight[c]
        count += 1
    if (count + 0.5) * rod.spacing < s[CUT] + cut:  # no room for more points: the tissue is incomplete
        s[CONVERGED] = 0.0
    s[CUT] += cut
    s[FRONT_X], s[FRONT_Y], s[FRONT_TURN] = s[TIP_X], s[TIP_Y], s[TIP_TURN]
    return count


@kernel
def step(rod: Rod, s: Floats, theta: Floats, channel: Floats, count: int, w: Floats, command: Floats) -> int:
    """Move base and guide by (db_x, db_y, db_theta, dg_y, flip), solve for equilibrium, cut; all in place.

    s (SIZE,), theta (N,), channel (CHANNEL_ROWS, M) of which `count` columns hold points, w (WORK_ROWS, N + 1).
    Returns the new count.
    """
    s[BASE_X] += command[0]
    s[BASE_Y] += command[1]
    s[BASE_TURN] += command[2]
    s[GUIDE_Y] += command[3]
    if command[4] > 0.0:
        s[BEVEL] = -s[BEVEL]
    if command[0] != 0.0:
        s[SLIDE] = math.copysign(1.0, command[0])
    _solve(rod, s, w, theta, channel, count)
    return _extend(rod, s, channel, count, theta.size)


class Needle:
    """The kernel with the constants and the start of an exact plant."""

    def __init__(self, plant, roll=0.0):
        constants = plant.rod._asdict()
        self.rod = Rod(**{name: constants[name] for name in Rod._fields})
        segments = len(plant.segments) - 1
        self.s = np.zeros(SIZE)
        self.s[[BASE_X, BASE_Y, BASE_TURN]] = *plant.state["base"][:2], plant.state["tilt"][0]
        self.s[BEVEL], self.s[TIP_X] = math.cos(roll), plant.state["base"][0] + self.rod.segment * segments
        self.theta = np.full(segments, self.s[BASE_TURN])
        self.w = np.zeros((WORK_ROWS, segments + 1))
        self.channel = np.zeros((CHANNEL_ROWS, len(plant.channel)))
        self.count = 0
        self.step(np.array(STILL))

    def step(self, row):
        """Move by the planar columns of `Control`."""
        planar = np.append(row[[DB_X, DB_Y, DB_THETA, DG_Y]], -1.0 if row[ROLL] == 0.0 else 1.0)
        self.count = step(self.rod, self.s, self.theta, self.channel, self.count, self.w, planar)

    @property
    def converged(self):
        return self.s[CONVERGED] > 0.0

    @property
    def tip(self):
        """x, y, θ."""
        return self.s[[TIP_X, TIP_Y, TIP_TURN]]
