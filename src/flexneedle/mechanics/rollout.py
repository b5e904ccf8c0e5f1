"""Rollouts of many needles, each with its own constants, start and commands (paper eq. 1): the entry point of kernels.

Groups of needles go side by side through all their steps. What a caller does not ask for is not computed.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.contact import contact_energy
from flexneedle.mechanics.insertion import advance_needles, settle_needles
from flexneedle.mechanics.iteration import count_before
from flexneedle.mechanics.lanes import fill, lanes_of, least, load, load_all, most, select, some, spill
from flexneedle.mechanics.lateral import Lateral, axes_of, dot, size, square, times, y_of, z_of
from flexneedle.mechanics.needle import LATERALS, REALS, Held, NeedleState, apart, together
from flexneedle.mechanics.spring import spring_energy
from flexneedle.mechanics.zones import Zones, least_distance

from flexneedle.mechanics.work import (  # isort: skip
    CONSTANTS, CONTACT, GUIDE, HEIGHT, KIND, LOAD, MOMENT, REST, SHEAR, SLOPE, U, WEIGHT, X, Y,
    Constants, Needles, Workspace,
)  # fmt: skip

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

POSE_SIZE = 5
"""Columns of a pose: x, y, z (mm), slopes θ = dy/dx and ψ = dz/dx (rad)."""
LOADS = 6
"""Columns of loads: force y, z (N) and moment y, z (N·mm) of the base on the needle, force y, z of the guide (N)."""
SOLUTION = (Y, SLOPE, SHEAR, MOMENT, LOAD)
"""Columns of a solution at the nodes."""


class Models(NamedTuple):
    """Constants of M needles in tissue, as arrays of numbers."""

    constants: Floats  # (M, 9), reals of `Constants`
    curvature: Floats  # (M, axes)
    nodes: Floats  # (M, n, 8), columns of `work`
    layers: Floats  # (M, l, 5)
    laws: Floats  # tables of `law` (rows, 8)


class Starts(NamedTuple):
    """States of S needles, as arrays of numbers."""

    needles: Floats  # rows of `needle` (S, k)
    rest: Floats  # rest positions of the nodes (S, n, axes), mm
    compression: Floats  # compressions (S, n, axes), mm


class Outputs(NamedTuple):
    """Arrays that a rollout of N sequences of m steps fills; of size 0 those that are not wanted."""

    tips: Floats  # poses (N, m, 5)
    converged: Floats  # whether each step converged (N, m), 1 or 0
    energy: Floats  # strain energy of the tissue (N, m), mJ, of the last steps
    stretch: Floats  # least stretch of a contact (N, m)
    deflection: Floats  # mean square distance (N, m) of the needle from an axis, mm²
    loads: Floats  # `LOADS` (N, m, 6)
    strain: Floats  # largest curvature of the needle that bends it elastically (N, m), 1/mm
    clearance: Floats  # least distance (N, m) of the needle's axis from the zones, mm
    curves: Floats  # x, y and slope at base, nodes and tip (N, m, n + 2, 1 + 2 axes); the last are at the tip
    ends: Starts  # states at the end
    solution: Floats  # at the end, at the nodes (N, n, 5, axes): columns `SOLUTION`
    stored: Floats  # energies (N, n + 1), mJ, of the contacts, without their weights, and of the tip spring


@inner
def _gather_models(space: Workspace, models: Models, model_of: Whole, j: int) -> tuple[Constants, int]:
    """Place the constants of the needles j, j + 1, … side by side; return them and the nodes before the contacts."""
    first = 0
    for k in range(CONSTANTS):
        fill(space.constants, 0, k, models.constants, model_of, j, k)
    fill(space.curvature, 0, 0, models.curvature, model_of, j, 0)
    for i in range(models.nodes.shape[1]):
        for k in range(8):
            fill(space.mesh, i, k, models.nodes, model_of, j, i, k)
        if some(load(space.mesh, i, KIND) != CONTACT):
            first = i + 1
    for i in range(models.layers.shape[1]):
        for k in range(5):
            fill(space.layers, i, k, models.layers, model_of, j, i, k)
    return Constants(*(*load_all(space.constants, 0, CONSTANTS), load(space.curvature, 0, 0))), first


@inner
def _gather_starts(space: Workspace, starts: Starts, state_of: Whole, j: int) -> NeedleState:
    """Place the states of the needles j, j + 1, … side by side, and return what they are besides their contacts."""
    axes = starts.rest.shape[2]
    for i in range(starts.rest.shape[1]):
        fill(space.laterals, i, REST, starts.rest, state_of, j, i, 0)
        fill(space.laterals, i, U, starts.compression, state_of, j, i, 0)
    for k in range(REALS):
        fill(space.needle_reals, 0, k, starts.needles, state_of, j, k)
    for k in range(LATERALS):
        fill(space.needle_laterals, 0, k, starts.needles, state_of, j, REALS + axes * k)
    return together(load_all(space.needle_reals, 0, REALS), load_all(space.needle_laterals, 0, LATERALS))


@inner
def _count(w: Needles, needle: NeedleState, near: int) -> int:
    """Return the number of nodes behind the tips, or solved."""
    count, behind = count_before(w, needle.solution.tip.x, near), needle.solution.behind
    while count < w.mesh.shape[0] and some(float(count) < behind):
        count += 1
    return count


@inner
def _is_solved(w: Needles, needle: NeedleState, i: int) -> bool:
    """Return whether node i is behind the tip and has a solution: a solved tip is moved along its line."""
    return (load(w.mesh, i, X) < needle.solution.tip.x) & (float(i) < needle.solution.behind)


@inner
def _strain_energy(w: Needles, needle: NeedleState, count: int) -> float:
    """Return the tissue strain energy Σ w_c W (mJ) of the contacts (paper eq. 12)."""
    tip_x = needle.solution.tip.x
    total = 0.0 * tip_x
    for i in range(count):
        total += load(w.mesh, i, WEIGHT) * contact_energy(w, i, tip_x)
    return total


@inner
def _least_stretch(w: Needles, needle: NeedleState, count: int) -> float:
    """Return the least stretch of the contacts behind the tip; 1 without any."""
    tip_x = needle.solution.tip.x
    found = 1.0 + 0.0 * tip_x
    for i in range(count):
        here = 1.0 - size(load(w.laterals, i, U)) / load(w.mesh, i, HEIGHT)
        acts = (load(w.mesh, i, X) < tip_x) & (load(w.mesh, i, KIND) == CONTACT)
        found = select(acts, least(found, here), found)
    return found


@inner
def _largest_bend(w: Needles, needle: NeedleState, count: int) -> float:
    """Return the largest elastic curvature of the needle (1/mm): its moment is linear between the nodes."""
    found = size(needle.solution.loads.moment)
    for i in range(count):
        found = select(_is_solved(w, needle, i), most(found, size(load(w.laterals, i, MOMENT))), found)
    return found * w.constants.flexibility


@inner
def _mean_square_deflection(w: Needles, space: Workspace, needle: NeedleState, count: int) -> float:
    """Return ∫y² dx over the length of the needle (mm²), exact for cubics (the consistent mass matrix of a beam)."""
    tip, base = needle.solution.tip, needle.boundary.base
    at, slope = load(space.axis, 0, 0), load(space.axis, 0, 1)
    x, y, turn = tip.x, tip.y - at - times(tip.x, slope), tip.slope - slope
    total = 0.0 * x
    for i in range(count - 1, -2, -1):
        x0, y0, turn0 = base.x, base.y, base.slope
        behind = x0 < tip.x
        if i >= 0:
            behind = _is_solved(w, needle, i)
            x0, y0, turn0 = load(w.mesh, i, X), load(w.laterals, i, Y), load(w.laterals, i, SLOPE)
        y0, turn0 = y0 - at - times(x0, slope), turn0 - slope
        length = select(behind, x - x0, 0.0)
        squares = (156.0 * (square(y0) + square(y)) + 108.0 * dot(y0, y)) / 420.0
        mixed = (44.0 * (dot(y0, turn0) - dot(y, turn)) + 26.0 * (dot(turn0, y) - dot(y0, turn))) / 420.0
        turns = (4.0 * (square(turn0) + square(turn)) - 6.0 * dot(turn0, turn)) / 420.0
        total += select(behind, length * (squares + length * (mixed + length * turns)), 0.0)
        x, y, turn = select(behind, x0, x), select(behind, y0, y), select(behind, turn0, turn)
    return total / w.constants.length


@inner
def _spill_curves(w: Needles, needle: NeedleState, count: int, curves: Floats, j: int, k: int) -> None:
    """Write the curve of each needle: base, nodes, and the tip from the nodes that it has not passed on."""
    axes = axes_of(needle.boundary.bevel)
    base, tip = needle.boundary.base, needle.solution.tip
    spill(base.x, curves, j, k, 0, 0)
    spill(base.y, curves, j, k, 0, 1)
    spill(base.slope, curves, j, k, 0, 1 + axes)
    for i in range(w.mesh.shape[0] + 1):
        x, y, slope = tip.x, tip.y, tip.slope
        if i < count:
            behind = _is_solved(w, needle, i)
            x = select(behind, load(w.mesh, i, X), x)
            y = select(behind, load(w.laterals, i, Y), y)
            slope = select(behind, load(w.laterals, i, SLOPE), slope)
        spill(x, curves, j, k, i + 1, 0)
        spill(y, curves, j, k, i + 1, 1)
        spill(slope, curves, j, k, i + 1, 1 + axes)


@inner
def _spill_vector(value: Lateral, numbers: Floats, j: int, k: int, column: int) -> None:
    """Write y and z of each needle, never −0, to two columns."""
    spill(y_of(value) + 0.0, numbers, j, k, column)
    spill(z_of(value) + 0.0, numbers, j, k, column + 1)


@inner
def _spill_loads(w: Needles, needle: NeedleState, out: Floats, j: int, k: int) -> None:
    """Write the loads of the base on the needle and of the guide."""
    loads = needle.solution.loads
    guided = (load(w.mesh, 0, KIND) == GUIDE) & _is_solved(w, needle, 0)
    _spill_vector(times(-1.0, loads.shear), out, j, k, 0)
    _spill_vector(times(-1.0, loads.moment), out, j, k, 2)
    _spill_vector(select(guided, load(w.laterals, 0, LOAD), times(0.0, loads.shear)), out, j, k, 4)


@inner
def _spill_step(
    w: Needles, space: Workspace, zones: Zones, needle: NeedleState, count: int, out: Outputs, j: int, k: int,
    left: int,
) -> None:  # fmt: skip
    """Write the outputs of step k, with `left` steps from it to the end; an output may have the last steps alone."""
    tip = needle.solution.tip
    spill(tip.x + 0.0, out.tips, j, k, 0)
    _spill_vector(tip.y, out.tips, j, k, 1)
    _spill_vector(tip.slope, out.tips, j, k, 3)
    spill(needle.solution.converged, out.converged, j, k)
    at = out.energy.shape[1] - left
    if at >= 0:
        spill(_strain_energy(w, needle, count) + 0.0, out.energy, j, at)
    at = out.stretch.shape[1] - left
    if at >= 0:
        spill(_least_stretch(w, needle, count), out.stretch, j, at)
    at = out.deflection.shape[1] - left
    if at >= 0:
        spill(_mean_square_deflection(w, space, needle, count), out.deflection, j, at)
    at = out.strain.shape[1] - left
    if at >= 0:
        spill(_largest_bend(w, needle, count), out.strain, j, at)
    at = out.loads.shape[1] - left
    if at >= 0:
        _spill_loads(w, needle, out.loads, j, at)
    at = out.clearance.shape[1] - left
    if at >= 0:
        spill(least_distance(w, zones, needle, count), out.clearance, j, at)
    at = out.curves.shape[1] - left
    if at >= 0:
        _spill_curves(w, needle, count, out.curves, j, at)


@inner
def _spill_ends(w: Needles, needle: NeedleState, count: int, out: Outputs, j: int) -> None:
    """Write the states at the end, with the solution at the nodes."""
    reals, laterals = apart(needle)
    axes = axes_of(needle.boundary.bevel)
    for k in range(REALS):
        spill(reals[k], out.ends.needles, j, k)
    for k in range(LATERALS):
        spill(laterals[k], out.ends.needles, j, REALS + axes * k)
    for i in range(w.mesh.shape[0]):
        spill(load(w.laterals, i, REST), out.ends.rest, j, i, 0)
        spill(load(w.laterals, i, U), out.ends.compression, j, i, 0)
    for i in range(count):
        for k in range(5):
            spill(load(w.laterals, i, Y + k), out.solution, j, i, k, 0)
        spill(contact_energy(w, i, needle.solution.tip.x), out.stored, j, i)
    spring = spring_energy(w, needle.cut.channel.front, needle.solution.tip.x, needle.solution.last.spring)
    spill(spring, out.stored, j, w.mesh.shape[0])


@kernel
def rollout(
    space: Workspace,
    models: Models,
    starts: Starts,
    model_of: Whole,
    state_of: Whole,
    sequence: Whole,
    commands: Floats,
    held: Floats,
    axes: Floats,
    zones: Zones,
    first: int,
    last: int,
    out: Outputs,
) -> None:
    """Run sequences first to last − 1 (multiples of the lanes) of `commands` (N, m, 9), and fill `out`.

    model_of, state_of, sequence (N,): constants and state of each, and its own number. axes (N, 2, axes): y at x = 0
    (mm) and slope of the line from which deflections count. held (N, 2, axes): without commands, m = 0, the needles are
    settled, with the tip at this y (mm) and slope, or free where they are NaN.
    """
    steps = commands.shape[1]
    ends, curves = out.solution.size > 0, out.curves.size > 0
    loads = ends or out.loads.size > 0 or out.strain.size > 0
    shape = ends or curves or out.deflection.size > 0 or out.clearance.size > 0
    for j in range(first, last, lanes_of(space.constants)):
        constants, before = _gather_models(space, models, model_of, j)
        tissue, memory = (space.mesh, space.layers, models.laws), (space.reals, space.laterals)
        w = Needles(constants, *tissue, *memory, before, shape, loads)
        needle, near = _gather_starts(space, starts, state_of, j), 0
        fill(space.axis, 0, 0, axes, sequence, j, 0, 0)
        fill(space.axis, 0, 1, axes, sequence, j, 1, 0)
        for k in range(steps):
            for column in range(9):
                fill(space.command, 0, column, commands, sequence, j, k, column)
            needle, near = advance_needles(w, needle, space.command, near)
            _spill_step(w, space, zones, needle, _count(w, needle, near), out, j, k, steps - k)
        if steps == 0:
            fill(space.axis, 0, 0, held, sequence, j, 0, 0)
            fill(space.axis, 0, 1, held, sequence, j, 1, 0)
            live = needle.solution.tip.x == needle.solution.tip.x
            tip = Held(load(space.axis, 0, 0), load(space.axis, 0, 1))
            needle, near = settle_needles(w, needle, tip, live, near)
        if ends:
            _spill_ends(w, needle, _count(w, needle, near), out, j)
