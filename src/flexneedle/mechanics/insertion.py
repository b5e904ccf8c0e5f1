"""Steps of an insertion: move, solve, cut (docs/theory.md section 6), alone and in batches."""

import math

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.model import CONTACT, GUIDE, Floats, Model

Bools = NDArray[np.bool_]
_SAME_PLACE = 1e-3  # of a part: a tip this near the end of a part is there


@inner
def _move(model: Model, s: Floats, rest: Floats, command: Floats) -> None:
    """Begin a step: remember where the tip is, apply (db_x, db_y, db_theta, dg_y, flip)."""
    s[nd.CUT_X], s[nd.CUT_Y], s[nd.CUT_TURN] = s[nd.TIP_X], s[nd.TIP_Y], s[nd.TIP_TURN]
    s[nd.CUT_FRONT], s[nd.CUT_REST] = s[nd.FRONT], s[nd.REST]
    s[nd.BASE_X] += command[0]
    s[nd.BASE_Y] += command[1]
    s[nd.BASE_TURN] += command[2]
    s[nd.GUIDE_Y] += command[3]
    if command[4] > 0.0:
        s[nd.BEVEL] = -s[nd.BEVEL]
    if rest.size > 0 and model.nodes.kind[0] == GUIDE:
        rest[0] = s[nd.GUIDE_Y]


@inner
def _end_cut(model: Model, s: Floats, rest: Floats, w: Floats, count: int, fresh: int) -> None:
    """Leave the channel and the tip spring as the step cut them; out of the skin the channel is closed."""
    for i in range(fresh, count):
        if model.nodes.kind[i] == CONTACT:
            rest[i] = w[nd.FIXED, i] + w[nd.SHARE, i] * s[nd.TIP_Y]
    fixed, slope = nd.spring_rest(model, s, s[nd.TIP_X])
    s[nd.REST] = fixed + (1.0 - slope) * s[nd.TIP_Y]
    s[nd.FRONT] = max(s[nd.CUT_FRONT], s[nd.TIP_X]) if s[nd.TIP_X] > 0.0 else 0.0


@kernel
def settle(model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, held: float) -> int:
    """Solve where base and guide are and lay the cut; a `held` tip y (mm) is essential, NaN leaves it free.

    Work arrays in place, as in `needle.solve`; returns the number of nodes behind the tip.
    """
    count, fresh = nd.solve(model, s, rest, u, w, held)
    _end_cut(model, s, rest, w, count, fresh)
    return count


@inner
def _end_of_part(model: Model, s: Floats, advance: float, done: float) -> float:
    """Share of a step at which its next part ends, `done` being the share so far.

    Down to the zone below the skin parts end where the tip is expected at a multiple of the part's length: the state
    stays a continuous function of the command.
    """
    x = s[nd.TIP_X]
    if advance <= 0.0 or x >= model.zone or x + (1.0 - done) * advance <= 0.0:
        return 1.0
    goal = max(0.0, model.part * (math.floor(x / model.part + _SAME_PLACE) + 1.0))
    end = done + (goal - x) / advance
    return end if end < 1.0 else 1.0


@kernel
def advance(model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, command: Floats) -> int:
    """One step (X, C)_{k+1} = f((X, C)_k, U_k) (paper eq. 1); arrays and result as in `settle`."""
    end = _end_of_part(model, s, command[0], 0.0)
    if end == 1.0:
        _move(model, s, rest, command)
        return settle(model, s, rest, u, w, math.nan)
    part = command.copy()
    done, count, converged, residual = 0.0, 0, 1.0, 0.0
    while done < 1.0:
        part[:4] = (end - done) * command[:4]
        _move(model, s, rest, part)
        count = settle(model, s, rest, u, w, math.nan)
        converged, residual = min(converged, s[nd.CONVERGED]), max(residual, s[nd.RESIDUAL])
        part[4] = -1.0
        done = end
        end = _end_of_part(model, s, command[0], done)
    s[nd.CONVERGED], s[nd.RESIDUAL] = converged, residual
    return count


@kernel
def replay(
    model: Model, s: Floats, rest: Floats, u: Floats, w: Floats, controls: Floats, tips: Floats
) -> int:
    """Carry out `controls` (m, 5) one after the other; fills tips (m, 3).

    Other arrays and result as in `settle`.
    """
    count = 0
    for k in range(controls.shape[0]):
        count = advance(model, s, rest, u, w, controls[k])
        tips[k, 0], tips[k, 1], tips[k, 2] = s[nd.TIP_X], s[nd.TIP_Y], s[nd.TIP_TURN]
    return count


@inner
def _strain_energy(model: Model, w: Floats, count: int) -> float:
    """Tissue strain energy Σ w_c W (mJ) of the contacts after a solve (paper eq. 12)."""
    total = 0.0
    for i in range(count):
        if model.nodes.kind[i] == CONTACT:
            total += model.nodes.weight[i] * w[nd.ENERGY, i]
    return total


@inner
def _mean_square_deflection(model: Model, s: Floats, w: Floats, count: int) -> float:
    """∫y² dx over the length of the needle (mm²), exact for cubics (the consistent mass matrix of a beam)."""
    x, y, turn = s[nd.TIP_X], s[nd.TIP_Y], s[nd.TIP_TURN]
    total = 0.0
    for i in range(count - 1, -2, -1):
        x0, y0, turn0 = s[nd.BASE_X], s[nd.BASE_Y], s[nd.BASE_TURN]
        if i >= 0:
            x0, y0, turn0 = model.nodes.x[i], w[nd.Y, i], w[nd.TURN, i]
        length = x - x0
        square = (156.0 * (y0 * y0 + y * y) + 108.0 * y0 * y) / 420.0
        mixed = (44.0 * (y0 * turn0 - y * turn) + 26.0 * (turn0 * y - y0 * turn)) / 420.0
        turns = (4.0 * (turn0 * turn0 + turn * turn) - 6.0 * turn0 * turn) / 420.0
        total += length * (square + length * (mixed + length * turns))
        x, y, turn = x0, y0, turn0
    return total / model.length


@kernel
def rollout(
    model: Model,
    s0: Floats,
    rest0: Floats,
    u0: Floats,
    controls: Floats,
    first: int,
    last: int,
    tips: Floats,
    energy: Floats,
    converged: Bools,
    deflection: Floats,
) -> None:
    """Run samples first to last − 1 of `controls` (N, m, 5) from one state.

    Fills tips (N, m, 3), energy (N, m), converged (N, m), and deflection (N, m) unless its size is 0.
    """
    n = rest0.size
    w = np.zeros((nd.WORK_ROWS, n))
    s, rest, u = np.empty(nd.STATE_SIZE), np.empty(n), np.empty(n)
    for j in range(first, last):
        s[:], rest[:], u[:] = s0, rest0, u0
        for k in range(controls.shape[1]):
            count = advance(model, s, rest, u, w, controls[j, k])
            tips[j, k, 0], tips[j, k, 1], tips[j, k, 2] = s[nd.TIP_X], s[nd.TIP_Y], s[nd.TIP_TURN]
            energy[j, k] = _strain_energy(model, w, count)
            converged[j, k] = s[nd.CONVERGED] > 0.0
            if deflection.size > 0:
                deflection[j, k] = _mean_square_deflection(model, s, w, count)
