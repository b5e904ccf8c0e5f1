"""Steps of an insertion: move, solve, cut (docs/theory.md section 6), alone and in batches."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.lateral import Lateral, dot, lateral, rotate, size, square, times
from flexneedle.mechanics.law import stored_energy
from flexneedle.mechanics.model import CONTACT, GUIDE, Floats, Model
from flexneedle.mechanics.needle import (
    Boundary,
    Cut,
    CutChannel,
    Equilibrium,
    Laterals,
    NeedleState,
    NodePose,
    Plain,
    Work,
    to_plain,
)
from flexneedle.mechanics.shape import put, sample
from flexneedle.mechanics.solve import solve
from flexneedle.mechanics.spring import spring_energy, spring_rest
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

Bools = NDArray[np.bool_]
POSE_SIZE = 5
"""Columns of a pose: x, y, z (mm), slopes θ = dy/dx and ψ = dz/dx (rad)."""


class Outputs(NamedTuple):
    """Arrays that a rollout of N sequences of m steps fills; an array that is not wanted has size 0."""

    tips: Floats  # poses (N, m, 5)
    energy: Floats  # strain energy of the tissue (N, m), mJ
    converged: Bools  # whether each step converged (N, m)
    deflection: Floats  # mean square distance (N, m) of the needle from an axis, mm²
    shapes: Floats  # poses at n nodes (N, m, n, 5)


_SAME_PLACE = 1e-3  # of a part: a tip this near the end of a part is there


def outputs(n: int, m: int, *, deflection: bool = False, nodes: int = 0) -> Outputs:
    """Return arrays for a rollout, with shapes of this number of nodes."""
    return Outputs(
        np.zeros((n, m, POSE_SIZE)),
        np.zeros((n, m)),
        np.zeros((n, m), dtype=np.bool_),
        np.zeros((n, m) if deflection else (0, 0)),
        np.zeros((n, m, nodes, POSE_SIZE) if nodes else (0, 0, 0, 0)),
    )


@inner
def _move_boundary(boundary: Boundary, command: Floats, share: float, roll: float) -> Boundary:
    """Return the boundary after a share of a command; `roll` (rad) includes its spin."""
    base, like = boundary.base, boundary.guide
    bevel = boundary.bevel if roll == 0.0 else rotate(roll, boundary.bevel)
    return Boundary(
        NodePose(
            base.x + share * command[DB_X],
            base.y + times(share, lateral(like, command[DB_Y], command[DB_Z])),
            base.slope + times(share, lateral(like, command[DB_THETA], command[DB_PSI])),
        ),
        boundary.guide + times(share, lateral(like, command[DG_Y], command[DG_Z])),
        bevel,
        boundary.load,
    )


@inner
def settle_needle(
    model: Model, needle: NeedleState, rest: Laterals, u: Laterals, w: Work, held: Lateral
) -> NeedleState:
    """Solve with the present base and guide, and lay the cut; a `held` tip y (mm) is essential, NaN leaves it free.

    Arrays are changed in place, as in `solve`. Out of the skin the channel is closed.
    """
    boundary, cut = needle.boundary, needle.cut
    if rest.size > 0 and model.nodes[0].kind == GUIDE:
        rest[0] = boundary.guide
    solution, path, fresh = solve(model, boundary, cut, needle.solution.last, rest, u, w, held)
    x, y = solution.tip.x, solution.tip.y
    for i in range(fresh, solution.last.behind):
        if model.nodes[i].kind == CONTACT:
            rest[i] = w[i].fixed + times(w[i].share, y)
    fixed, slope = spring_rest(model, boundary.bevel, cut, path, x)
    front = max(cut.channel.front, x) if x > 0.0 else 0.0
    return NeedleState(boundary, cut, CutChannel(front, fixed + times(1.0 - slope, y)), solution)


@kernel
def settle(model: Model, needle: NeedleState, rest: Laterals, u: Laterals, w: Work, held: Lateral) -> Plain:
    """Call `settle_needle` from outside of kernels; return the needle for `from_plain`."""
    return to_plain(settle_needle(model, needle, rest, u, w, held))


@inner
def _end_of_part(model: Model, needle: NeedleState, advance: float, done: float) -> float:
    """Return the share of a step at which its next part ends, after the share `done`.

    Down to the zone below the skin parts end where the tip is expected at a multiple of the part's length: the state
    remains a continuous function of the command.
    """
    x = needle.solution.tip.x
    if advance <= 0.0 or x >= model.zone or x + (1.0 - done) * advance <= 0.0:
        return 1.0
    goal = max(0.0, model.part * (math.floor(x / model.part + _SAME_PLACE) + 1.0))
    end = done + (goal - x) / advance
    return end if end < 1.0 else 1.0


@inner
def _advance_needle(
    model: Model, needle: NeedleState, rest: Laterals, u: Laterals, w: Work, command: Floats
) -> NeedleState:
    """Return the needle after one step, in its parts."""
    done, residual, converged, roll = 0.0, 0.0, True, command[ROLL]
    while done < 1.0:
        end = _end_of_part(model, needle, command[DB_X], done)
        spin = (end - done) * command[SPIN]
        boundary = _move_boundary(needle.boundary, command, end - done, roll + spin)
        cut = Cut(needle.solution.tip, needle.channel, spin)
        needle = settle_needle(
            model,
            NeedleState(boundary, cut, needle.channel, needle.solution),
            rest,
            u,
            w,
            times(math.nan, boundary.guide),
        )
        residual, converged = max(residual, needle.solution.residual), converged and needle.solution.converged
        roll, done = 0.0, end
    last = needle.solution
    solution = Equilibrium(last.tip, last.last, last.loads, last.iterations, residual, converged)
    return NeedleState(needle.boundary, needle.cut, needle.channel, solution)


@inner
def _contact_energy(model: Model, i: int, u: Lateral, tip_x: float) -> float:
    """Return the energy (mJ) that contact point i stores, without its weight."""
    node = model.nodes[i]
    stored = stored_energy(model.laws[node.law], size(u) / node.height)
    energy = node.stiffness * node.height * node.height * stored
    behind = tip_x - node.x
    return float(energy if behind >= node.reach else energy * behind / node.reach)


@inner
def _strain_energy(model: Model, needle: NeedleState, u: Laterals) -> float:
    """Return the tissue strain energy Σ w_c W (mJ) of the contacts (paper eq. 12)."""
    total = 0.0
    for i in range(needle.solution.last.behind):
        if model.nodes[i].kind == CONTACT:
            total += model.nodes[i].weight * _contact_energy(model, i, u[i], needle.solution.tip.x)
    return total


@kernel
def energies(model: Model, needle: NeedleState, u: Laterals, stored: Floats) -> float:
    """Fill the energy (mJ) of each node behind the tip, (behind,), without its weight; return the tip spring's."""
    tip_x = needle.solution.tip.x
    for i in range(stored.size):
        stored[i] = _contact_energy(model, i, u[i], tip_x) if model.nodes[i].kind == CONTACT else 0.0
    return spring_energy(model, needle.cut.channel.front, tip_x, needle.solution.last.spring)


@inner
def _mean_square_deflection(model: Model, needle: NeedleState, w: Work, axis: Laterals) -> float:
    """Return ∫y² dx over the length of the needle (mm²), exact for cubics (the consistent mass matrix of a beam).

    axis: y at x = 0 and slope of the line from which y counts.
    """
    tip, base = needle.solution.tip, needle.boundary.base
    at, slope = axis[0], axis[1]
    x, y, turn = tip.x, tip.y - at - times(tip.x, slope), tip.slope - slope
    total = 0.0
    for i in range(needle.solution.last.behind - 1, -2, -1):
        x0, y0, turn0 = base.x, base.y, base.slope
        if i >= 0:
            x0, y0, turn0 = model.nodes[i].x, w[i].y, w[i].slope
        y0, turn0 = y0 - at - times(x0, slope), turn0 - slope
        length = x - x0
        squares = (156.0 * (square(y0) + square(y)) + 108.0 * dot(y0, y)) / 420.0
        mixed = (44.0 * (dot(y0, turn0) - dot(y, turn)) + 26.0 * (dot(turn0, y) - dot(y0, turn))) / 420.0
        turns = (4.0 * (square(turn0) + square(turn)) - 6.0 * dot(turn0, turn)) / 420.0
        total += length * (squares + length * (mixed + length * turns))
        x, y, turn = x0, y0, turn0
    return total / model.length


@inner
def _shape(
    model: Model, needle: NeedleState, w: Work, x: Floats, y: Laterals, slope: Laterals, out: Floats
) -> None:
    """Fill poses (n, 5) along the needle, after a solve; x, y, slope (k + 2,) are scratch."""
    base, tip, count = needle.boundary.base, needle.solution.tip, needle.solution.last.behind
    x[0], y[0], slope[0] = base.x, base.y, base.slope
    for i in range(count):
        x[i + 1], y[i + 1], slope[i + 1] = model.nodes[i].x, w[i].y, w[i].slope
    x[count + 1], y[count + 1], slope[count + 1] = tip.x, tip.y, tip.slope
    sample(x, y, slope, count + 2, out)


@kernel
def rollout(
    model: Model,
    start: NeedleState,
    rest0: Laterals,
    u0: Laterals,
    rest: Laterals,
    u: Laterals,
    w: Work,
    commands: Floats,
    axes: Laterals,
    first: int,
    last: int,
    out: Outputs,
) -> Plain:
    """Run samples first to last − 1 of `commands` (N, m, 9) from one state (paper eq. 1), and fill `out`.

    Returns the needle after the last sample, for `from_plain`, with its `rest`, `u` and `w`, arrays as in `solve`. axes
    (N, 2): y at x = 0 (mm) and slope of the line from which the deflection of a sample counts.
    """
    needle = start
    x, y, slope = (
        np.empty(rest0.size + 2),
        np.empty(rest0.size + 2, rest0.dtype),
        np.empty(rest0.size + 2, rest0.dtype),
    )
    for j in range(first, last):
        needle = start
        for i in range(rest.size):  # not by slices, whose check of shapes takes 2 s to compile
            rest[i], u[i] = rest0[i], u0[i]
        for k in range(commands.shape[1]):
            needle = _advance_needle(model, needle, rest, u, w, commands[j, k])
            tip = needle.solution.tip
            put(out.tips[j, k], tip.x, tip.y, tip.slope)
            out.energy[j, k] = _strain_energy(model, needle, u)
            out.converged[j, k] = needle.solution.converged
            if out.deflection.size > 0:
                out.deflection[j, k] = _mean_square_deflection(model, needle, w, axes[j])
            if out.shapes.size > 0:
                _shape(model, needle, w, x, y, slope, out.shapes[j, k])
    return to_plain(needle)
