"""Rollouts of many needles, each with its own constants, start and commands (paper eq. 1): the entry point of kernels.

Groups of needles go side by side through all their steps. What a caller does not ask for is not computed.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.insertion import advance_needles, settle_needles
from flexneedle.mechanics.lanes import fill, lanes_of, least, load, load_all, most, select, some, spill
from flexneedle.mechanics.lateral import axes_of, dot, size, square, times, y_of, z_of
from flexneedle.mechanics.law import stored_energy
from flexneedle.mechanics.needle import LATERALS, REALS, NeedleState, apart, together
from flexneedle.mechanics.spring import spring_energy
from flexneedle.mechanics.work import (
    CELLS,
    CONSTANTS,
    CONTACT,
    GUIDE,
    HEIGHT,
    KIND,
    LAW,
    LOAD,
    MOMENT,
    PER_REACH,
    REST,
    SHEAR,
    SLOPE,
    STIFFNESS,
    WEIGHT,
    Constants,
    Needles,
    U,
    Workspace,
    X,
    Y,
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
    curves: Floats  # x, y and slope at base, nodes and tip (N, m, n + 2, 1 + 2 axes); the last are at the tip
    ends: Starts  # states at the end
    solution: Floats  # at the end, at the nodes (N, n, 5, axes): columns `SOLUTION`
    stored: Floats  # energies (N, n + 1), mJ, of the contacts, without their weights, and of the tip spring


@inner
def _gather(
    space: Workspace, models: Models, starts: Starts, model_of: Whole, state_of: Whole, j: int
) -> tuple[Constants, NeedleState, int]:
    """Place the needles j, j + 1, … of a rollout side by side.

    Returns their constants, their start, and the number of nodes before the contacts.
    """
    n, axes = models.nodes.shape[1], models.curvature.shape[1]
    for k in range(CONSTANTS):
        fill(space.constants, 0, k, models.constants, model_of, j, k)
    fill(space.curvature, 0, 0, models.curvature, model_of, j, 0)
    first = 0
    for i in range(n):
        for k in range(8):
            fill(space.mesh, i, k, models.nodes, model_of, j, i, k)
        fill(space.laterals, i, REST, starts.rest, state_of, j, i, 0)
        fill(space.laterals, i, U, starts.compression, state_of, j, i, 0)
        if some(load(space.mesh, i, KIND) != CONTACT):
            first = i + 1
    for i in range(models.layers.shape[1]):
        for k in range(5):
            fill(space.layers, i, k, models.layers, model_of, j, i, k)
    for k in range(REALS):
        fill(space.needle_reals, 0, k, starts.needles, state_of, j, k)
    for k in range(LATERALS):
        fill(space.needle_laterals, 0, k, starts.needles, state_of, j, REALS + axes * k)
    flexibility, length, offset, bevel, part, zone, clearance, tolerance, slide = load_all(
        space.constants, 0, CONSTANTS
    )
    curvature = load(space.curvature, 0, 0)
    constants = Constants(
        flexibility, length, offset, bevel, part, zone, clearance, tolerance, slide, curvature
    )
    needle = together(load_all(space.needle_reals, 0, REALS), load_all(space.needle_laterals, 0, LATERALS))
    return constants, needle, first


@inner
def _count(w: Needles, needle: NeedleState, near: int) -> int:
    """Return the number of nodes behind the tips, or solved."""
    count, total = near, w.mesh.shape[0]
    tip_x, behind = needle.solution.tip.x, needle.solution.behind
    while count < total and some((load(w.mesh, count, X) < tip_x) | (float(count) < behind)):
        count += 1
    while count > 0 and not some((load(w.mesh, count - 1, X) < tip_x) | (float(count - 1) < behind)):
        count -= 1
    return count


@inner
def _is_solved(w: Needles, needle: NeedleState, i: int) -> bool:
    """Return whether node i is behind the tip and has a solution: a solved tip is moved along its line."""
    return (load(w.mesh, i, X) < needle.solution.tip.x) & (float(i) < needle.solution.behind)


@inner
def _grown(w: Needles, i: int, tip_x: float) -> float:
    return least(1.0, most(0.0, (tip_x - load(w.mesh, i, X)) * load(w.mesh, i, PER_REACH)))


@inner
def _contact_energy(w: Needles, i: int, tip_x: float) -> float:
    """Return the energy (mJ) that contact i stores, without its weight."""
    cells = load(w.mesh, i, CELLS)
    stored = stored_energy(w.laws, load(w.mesh, i, LAW), size(load(w.laterals, i, U)) * cells)
    contact = load(w.mesh, i, KIND) == CONTACT
    scale = load(w.mesh, i, STIFFNESS) * _grown(w, i, tip_x)
    return select(contact, scale * stored / select(contact, cells * cells, 1.0), 0.0)


@inner
def _strain_energy(w: Needles, needle: NeedleState, count: int) -> float:
    """Return the tissue strain energy Σ w_c W (mJ) of the contacts (paper eq. 12)."""
    tip_x = needle.solution.tip.x
    total = 0.0 * tip_x
    for i in range(count):
        total += load(w.mesh, i, WEIGHT) * _contact_energy(w, i, tip_x)
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
def _spill_step(
    w: Needles, space: Workspace, needle: NeedleState, count: int, out: Outputs, j: int, k: int, steps: int
) -> None:
    """Write the outputs of step k of `steps`."""
    tip, loads = needle.solution.tip, needle.solution.loads
    spill(tip.x + 0.0, out.tips, j, k, 0)
    spill(y_of(tip.y) + 0.0, out.tips, j, k, 1)
    spill(z_of(tip.y) + 0.0, out.tips, j, k, 2)
    spill(y_of(tip.slope) + 0.0, out.tips, j, k, 3)
    spill(z_of(tip.slope) + 0.0, out.tips, j, k, 4)
    spill(needle.solution.converged, out.converged, j, k)
    at = k - steps + out.energy.shape[1]
    if at >= 0:
        spill(_strain_energy(w, needle, count) + 0.0, out.energy, j, at)
    at = k - steps + out.stretch.shape[1]
    if at >= 0:
        spill(_least_stretch(w, needle, count), out.stretch, j, at)
    at = k - steps + out.deflection.shape[1]
    if at >= 0:
        spill(_mean_square_deflection(w, space, needle, count), out.deflection, j, at)
    at = k - steps + out.strain.shape[1]
    if at >= 0:
        spill(_largest_bend(w, needle, count), out.strain, j, at)
    at = k - steps + out.loads.shape[1]
    if at >= 0:
        guide = (load(w.mesh, 0, KIND) == GUIDE) & _is_solved(w, needle, 0)
        force = select(guide, load(w.laterals, 0, LOAD), times(0.0, loads.shear))
        shear, moment = times(-1.0, loads.shear), times(-1.0, loads.moment)
        spill(y_of(shear) + 0.0, out.loads, j, at, 0)
        spill(z_of(shear) + 0.0, out.loads, j, at, 1)
        spill(y_of(moment) + 0.0, out.loads, j, at, 2)
        spill(z_of(moment) + 0.0, out.loads, j, at, 3)
        spill(y_of(force) + 0.0, out.loads, j, at, 4)
        spill(z_of(force) + 0.0, out.loads, j, at, 5)
    at = k - steps + out.curves.shape[1]
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
        spill(_contact_energy(w, i, needle.solution.tip.x), out.stored, j, i)
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
    first: int,
    last: int,
    out: Outputs,
) -> None:
    """Run sequences first to last − 1 (multiples of the lanes) of `commands` (N, m, 9), and fill `out`.

    model_of, state_of, sequence (N,): constants and state of each, and its own number. axes (N, 2, axes): y at x = 0
    (mm) and slope of the line from which deflections count. held (N, axes): without commands, m = 0, the needles are
    settled, with the tip at this y (mm), or free where it is NaN.
    """
    lanes, steps = lanes_of(space.constants), commands.shape[1]
    loads = out.loads.size > 0 or out.strain.size > 0 or out.solution.size > 0
    shape = out.deflection.size > 0 or out.curves.size > 0 or out.solution.size > 0
    for j in range(first, last, lanes):
        constants, needle, before = _gather(space, models, starts, model_of, state_of, j)
        w = Needles(
            constants,
            space.mesh,
            space.layers,
            models.laws,
            space.reals,
            space.laterals,
            before,
            shape,
            loads,
        )
        near = 0 * steps
        fill(space.axis, 0, 0, axes, sequence, j, 0, 0)
        fill(space.axis, 0, 1, axes, sequence, j, 1, 0)
        for k in range(steps):
            for column in range(9):
                fill(space.command, 0, column, commands, sequence, j, k, column)
            needle, near = advance_needles(w, needle, space.command, near)
            _spill_step(w, space, needle, _count(w, needle, near), out, j, k, steps)
        if steps == 0:
            fill(space.axis, 0, 0, held, sequence, j, 0)
            live = needle.solution.tip.x == needle.solution.tip.x
            needle, near = settle_needles(w, needle, load(space.axis, 0, 0), live, near)
        if out.solution.size > 0:
            _spill_ends(w, needle, _count(w, needle, near), out, j)
