"""Equilibrium of the exact needle by Newton's method, and a step of an insertion (docs/theory.md section 11).

A needle that begins in the plane z = 0 remains there, to the last bit.
"""

import math

from flexneedle.mechanics.compile import inner, kernel, shared
from flexneedle.phantom.loads import (
    Before,
    add_bevel,
    add_channel,
    add_guide,
    add_hinges,
    add_rotation_friction,
    cut_length,
    new_offset,
    set_friction,
    slip_angle,
)
from flexneedle.phantom.rod import Records, Rod, State, move_nodes
from flexneedle.phantom.space import (
    Floats,
    accumulate,
    after,
    minus,
    plus,
    put,
    put_turn,
    roll_turn,
    small_turn,
    times,
    turn,
    vector,
)
from flexneedle.phantom.sweep import newton_step, slope, sweep
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DG_Y, DG_Z, ROLL, SPIN

TOLERANCE_MM = 1e-11
ACCEPTED_MM = 1e-6  # a solve may stall above TOLERANCE_MM where a point is added or the tip crosses the skin
MAX_ITERATIONS = 60
_LONGEST_MM = 2.0  # largest displacement of a node in an iteration
_SMALL_MM = 1e-8  # a Newton step below it is accepted without a line search
_TRIALS = 16  # of the length of a Newton step
_UPHILL = 4  # full steps that may lead uphill
_SAME_RAD = 1e-3
_SOFTER = 5  # powers of ten: first softening of the guide after a failed solve
# Largest rotation in one solve where friction acts against it: its slip has the sign of the rotation.
_ROLL_RAD = 0.5


@shared
def assemble(
    rod: Rod,
    s: State,
    w: Records,
    channel: Records,
    count: int,
    before: Before,
    curved: float,
) -> None:
    """Fill gradient and Hessian of loads and hinges; the stored energy (mJ) into the state."""
    n = len(w) - 1
    for i in range(n + 1):
        row = w[i]
        put(row.force, (0.0, 0.0, 0.0))
        put(row.couple, (0.0, 0.0, 0.0))
        for k in range(6):
            row.pp[k] = row.tt[k] = 0.0
        for k in range(9):
            row.pt[k] = 0.0
    total = add_hinges(rod, s, w, curved)
    total += add_guide(rod, s, w, curved) + add_channel(rod, s, w, channel, count, curved)
    total += add_bevel(rod, s, w, before)
    accumulate(w[n].force, -1.0, vector(s.load))
    for i in range(n):
        accumulate(w[i].force, -1.0, vector(w[i].friction))
    if rod.rotation_friction > 0.0:
        add_rotation_friction(rod, w, before.rotation)
    s.energy = total


@inner
def _turn_frames(w: Records, share: float) -> None:
    """Set the frames after this share of the step in `step`, from the frames at its start."""
    for i in range(len(w) - 1):
        put_turn(w[i].frame, after(small_turn(times(share, vector(w[i].step))), turn(w[i].start)))


@inner
def _along_wall(y: float, z: float, y_now: float, z_now: float) -> bool:
    """Return whether the needle is at the guide's wall before and after, but at another point of the circle."""
    return abs(y * z_now - z * y_now) > _SAME_RAD * math.hypot(y, z) * math.hypot(y_now, z_now)


@inner
def _search(
    rod: Rod,
    s: State,
    w: Records,
    channel: Records,
    count: int,
    before: Before,
    largest: float,
    strict: bool,
) -> bool:
    """Search along the step in `step` on its slope, since bevel and friction have no energy.

    A wall makes the slope flat, then steep: the secant through the last two steps that are too long finds the bend.
    Unless it is strict, it leaves a full step that is too long, and returns False.
    """
    share, low, high, steep = min(1.0, _LONGEST_MM / largest), 0.0, math.inf, 0.0
    downhill, y, z = -slope(rod, w), s.guide_force[0], s.guide_force[1]
    for _ in range(_TRIALS):
        _turn_frames(w, share)
        move_nodes(rod, s, w)
        assemble(rod, s, w, channel, count, before, 1.0)
        up = slope(rod, w)
        if share * largest < _SMALL_MM or abs(up) <= 0.5 * downhill or (up < 0.0 and high == math.inf):
            return True
        if not strict and _along_wall(y, z, s.guide_force[0], s.guide_force[1]):
            return False
        guess = low
        if up < 0.0:
            low, guess = share, share - up * (high - share) / (steep - up)
        else:
            if high < math.inf:
                guess = share - up * (high - share) / (steep - up)
            high, steep = share, up
        share = guess if low < guess < high else 0.5 * (low + high)
    return True


@inner
def _newton(
    rod: Rod, s: State, w: Records, channel: Records, count: int, before: Before
) -> tuple[bool, float]:
    """Write a Newton step into `step`; return whether the Hessian is definite, and the largest displacement (mm)."""
    stable = sweep(rod, s, w, 1.0)
    if not stable:  # near buckling, or a poor initial guess
        assemble(rod, s, w, channel, count, before, 0.0)
        sweep(rod, s, w, 0.0)
    return stable, newton_step(rod, w)


@inner
def _iterate(rod: Rod, s: State, w: Records, channel: Records, count: int, before: Before) -> None:
    """Iterate by Newton's method from the present frames; its iterations are added to those before.

    Along the round wall of the guide each descent would be short. So a few full steps may lead uphill, if the work of
    the last of them is below half of the work of the first; otherwise the solve returns to its state before them.
    """
    move_nodes(rod, s, w)
    assemble(rod, s, w, channel, count, before, 1.0)
    iteration, uphill, work, strict = 0, 0, 0.0, False
    while True:
        stable, largest = _newton(rod, s, w, channel, count, before)
        if not largest > TOLERANCE_MM or iteration == MAX_ITERATIONS:
            break
        iteration += 1
        now = -slope(rod, w)
        if uphill > 0 and stable and now < 0.5 * work:
            uphill = 0
        elif uphill == _UPHILL:
            _copy_frames(w.held, w.frame)
            move_nodes(rod, s, w)
            assemble(rod, s, w, channel, count, before, 1.0)
            uphill, strict = 0, True
            continue
        _copy_frames(w.frame, w.start)
        downhill = _search(rod, s, w, channel, count, before, largest, strict or not stable)
        strict = False
        if uphill > 0:
            uphill += 1
        elif not downhill:
            uphill, work = 1, now
            _copy_frames(w.start, w.held)
    s.iterations, s.residual = s.iterations + iteration, largest
    found = stable and largest <= ACCEPTED_MM and math.isfinite(s.tip[0] + s.tip[1] + s.tip[2])
    s.converged = 1.0 if found else 0.0


@inner
def _copy_frames(source: Floats, into: Floats) -> None:
    """Copy the frames of all segments (N + 1, 4)."""
    for i in range(len(source) - 1):
        for k in range(4):
            into[i, k] = source[i, k]


@inner
def solve(rod: Rod, s: State, w: Records, channel: Records, count: int, before: Before) -> None:
    """Solve for equilibrium with base, guide, bevel and loads of the state, in place.

    If that fails, it starts again with a soft guide that becomes stiff in steps, then with guide and channel held at
    their segments: the force of a point changes its direction where the point changes its segment.
    """
    move_nodes(rod, s, w)
    set_friction(rod, s, w)
    s.iterations = 0.0
    for attempt in range(_SOFTER + 3):
        if attempt == 1:
            _copy_frames(w.rest, w.frame)
        softer = _SOFTER + 1 - attempt
        s.softening = 0.1**softer if 0 < softer <= _SOFTER else 1.0
        s.held = 1.0 if softer < 0 else 0.0
        _iterate(rod, s, w, channel, count, before)
        if s.converged > 0.0 and s.softening == 1.0:
            break
    s.held = 0.0


@inner
def _roll(s: State, w: Records, angle: float) -> None:
    """Roll the base, and with it the whole needle, from where friction holds it back."""
    if angle != 0.0:
        half = roll_turn(angle)
        c, d = s.half_roll[0], s.half_roll[1]
        s.half_roll[0], s.half_roll[1] = c * half[0] - d * half[1], c * half[1] + d * half[0]
        s.roll += angle
        for i in range(len(w) - 1):
            put_turn(w[i].frame, after(turn(w[i].frame), half))
    for i in range(len(w) - 1):
        put_turn(w[i].rest, turn(w[i].frame))


@inner
def _extend(rod: Rod, s: State, channel: Records, count: int, segments: int) -> int:
    """Extend the channel along the tip's path with a point every `spacing`; returns the number of points."""
    cut, tip, t = cut_length(s), vector(s.tip), vector(s.tangent)
    if tip[0] <= 0.0:
        s.cut = 0.0
        put(s.offset, (0.0, 0.0, 0.0))
        return 0
    if cut <= 0.0:
        return count
    if s.cut <= 0.0:
        put(s.front, (0.0, tip[1] - tip[0] * t[1] / t[0], tip[2] - tip[0] * t[2] / t[0]))
    front = vector(s.front)
    way = minus(tip, front)
    while (count + 0.5) * rod.spacing < s.cut + cut and count < len(channel):
        point, at = channel[count], (count + 0.5) * rod.spacing
        place = plus(front, times((at - s.cut) / cut, way))
        c = min(int(place[0] / rod.cell), rod.law.size - 1)
        put(point.place, place)
        point.cut, point.segment, point.law, point.height = (
            at,
            segments - 1,
            rod.channel_law[c],
            rod.height[c],
        )
        point.stiffness, point.weight = rod.foundation[c] * rod.spacing, rod.weight[c]
        count += 1
    if (count + 0.5) * rod.spacing < s.cut + cut:  # no room for more points: the tissue is incomplete
        s.converged = 0.0
    s.cut += cut
    put(s.front, tip)
    put(s.front_tangent, t)
    return count


@inner
def _move_base(s: State, command: Floats, share: float) -> None:
    """Move base and guide by a share of a command."""
    for k in range(3):
        s.base[k] += share * command[DB_X + k]
    s.tilt[0] += share * command[DB_THETA]
    s.tilt[1] += share * command[DB_PSI]
    s.guide[0] += share * command[DG_Y]
    s.guide[1] += share * command[DG_Z]
    if share * command[DB_X] != 0.0:
        s.slide = math.copysign(1.0, command[DB_X])


@inner
def _settle(rod: Rod, s: State, w: Records, channel: Records, count: int, roll: float, spin: float) -> int:
    """Roll by both angles, the second one during the motion of the base, solve, cut; returns the new count."""
    before = Before(vector(s.tip), vector(s.tangent), s.twist, roll + spin, spin)
    _roll(s, w, roll + spin)
    solve(rod, s, w, channel, count, before)
    put(s.offset, new_offset(rod, s, before)[0])
    if rod.rotation_friction > 0.0:
        for i in range(len(w) - 1):
            w[i].slip = slip_angle(w, i, before.rotation)
    return _extend(rod, s, channel, count, len(w) - 1)


@kernel
def step(rod: Rod, s: State, w: Records, channel: Records, count: int, command: Floats) -> int:
    """Move base and guide by a command (the columns of `Control`), solve for equilibrium, cut; all in place.

    s: a record of STATE; w (N + 1,) of SEGMENT; channel (M,) of POINT, of which the first `count` are used. Returns
    the new count. A step that spins has parts of at most half a radian, since the force on the tip is taken at the end
    of a part. The roll is in the first part; against friction it precedes the motion, in parts of the same size.
    """
    turns, parts = 0, max(1, math.ceil(abs(command[SPIN]) / _ROLL_RAD))
    if rod.rotation_friction > 0.0:
        turns = math.ceil(abs(command[ROLL]) / _ROLL_RAD)
    share, roll, spin = 1.0 / parts, command[ROLL] / max(1, turns), command[SPIN] / parts
    for k in range(turns + parts):
        moving = k >= turns
        _move_base(s, command, share if moving else 0.0)
        rolled = roll if k == 0 or not moving else 0.0
        count = _settle(rod, s, w, channel, count, rolled, spin if moving else 0.0)
    return count
