"""Records of the needle and its solve, and their places in the arrays of kernels.

In kernels, every number of a record is a number or the lanes of several needles (`lanes`); the numbers of iterations
and of nodes, and truth values, are floats.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, interpret
from flexneedle.mechanics.lateral import Lateral

Floats = NDArray[np.float64]
Laterals = NDArray[Any]


class NodePose(NamedTuple):
    """Position x along the axis and y across it (mm), and slope dy/dx."""

    x: float
    y: Lateral
    slope: Lateral


class Boundary(NamedTuple):
    """Conditions on the needle: pose of the base, the guide (mm), the bevel's direction, a tip load (N).

    The bevel is ±1 in the plane and a unit number in space.
    """

    base: NodePose
    guide: Lateral
    bevel: Lateral
    load: Lateral


class CutChannel(NamedTuple):
    """The end of the cut: its deepest point `front` and the rest position of the tip spring (mm)."""

    front: float
    rest: Lateral


class Cut(NamedTuple):
    """Start of the cut of the running step: tip, channel, and the angle by which the bevel turns in the step (rad)."""

    tip: NodePose
    channel: CutChannel
    spin: float


class Bearing(NamedTuple):
    """A needle in a guide with clearance."""

    wall: Lateral  # unit vector to the wall on which it bears, 0 for none
    give: float  # displacement of the needle in the guide per force (mm/N)
    y: Lateral  # displacement from the guide's middle in the iteration before
    force: Lateral  # force in the iteration before


class Iterate(NamedTuple):
    """Start of an iteration."""

    spring: Lateral  # compression of the tip spring
    shortening: float  # shortening (mm)
    guide: Bearing  # the needle in its guide


class Held(NamedTuple):
    """Essential conditions of the tip: y (mm), and slope if y is held, too; NaN where it is free."""

    y: Lateral
    slope: Lateral


class Loads(NamedTuple):
    """Lateral force on the tip (N), reaction and couple (N·mm) of a held tip, shear and moment at the base."""

    tip: Lateral
    reaction: Lateral
    couple: Lateral
    shear: Lateral
    moment: Lateral


class Equilibrium(NamedTuple):
    """Equilibrium and its search; residual: estimated distance from equilibrium (mm)."""

    tip: NodePose
    last: Iterate
    loads: Loads
    behind: float  # number of nodes behind the tip
    iterations: float
    residual: float
    converged: float  # 1 or 0


class NeedleState(NamedTuple):
    """State of a needle besides the rest positions and compressions of its contacts; the input of the next step."""

    boundary: Boundary
    cut: Cut
    channel: CutChannel
    solution: Equilibrium


class Path(NamedTuple):
    """End of the path that is being cut: coupled (1) to the unknown y of the tip, or (0) at a given one."""

    coupling: float
    y: Lateral


def start(base: NodePose, tip: NodePose, bevel: Lateral, guide: Lateral) -> NeedleState:
    """Return the straight needle in air, before a solve, with the guide on it."""
    none = 0.0 * bevel
    channel = CutChannel(0.0, none)
    solution = Equilibrium(
        tip,
        Iterate(none, 0.0, Bearing(none, 0.0, none, none)),
        Loads(none, none, none, none, none),
        behind=0.0,
        iterations=0.0,
        residual=0.0,
        converged=1.0,
    )
    return NeedleState(Boundary(base, guide, bevel, none), Cut(tip, channel, 0.0), channel, solution)


# ---- a needle as a row of numbers: its reals, then its laterals with one number an axis

REALS, LATERALS = 12, 20
BEHIND = 8
"""Place of the number of nodes behind the tip."""


@inner
def apart(needle: NeedleState) -> tuple[tuple[float, ...], tuple[Lateral, ...]]:
    """Return the reals and the laterals of a needle."""
    boundary, cut, channel, solution = needle.boundary, needle.cut, needle.channel, needle.solution
    base, begun, tip, last, loads = boundary.base, cut.tip, solution.tip, solution.last, solution.loads
    guide = last.guide
    reals = (
        base.x, begun.x, cut.channel.front, cut.spin, channel.front, tip.x, last.shortening, guide.give,
        solution.behind, solution.iterations, solution.residual, solution.converged,
    )  # fmt: skip
    laterals = (
        base.y, base.slope, boundary.guide, boundary.bevel, boundary.load, begun.y, begun.slope,
        cut.channel.rest, channel.rest, tip.y, tip.slope, last.spring, guide.wall, guide.y, guide.force,
        loads.tip, loads.reaction, loads.couple, loads.shear, loads.moment,
    )  # fmt: skip
    return reals, laterals


@inner
def together(reals: tuple[float, ...], laterals: tuple[Lateral, ...]) -> NeedleState:
    """Return the needle of these reals and laterals."""
    base_x, begun_x, cut_front, spin, front, tip_x, shortening, give, behind, iterations, residual, good = (
        reals
    )
    base_y, base_slope, guide, bevel, load, begun_y, begun_slope, cut_rest, rest = laterals[:9]
    tip_y, tip_slope, spring, wall, guide_y, guide_force, force, reaction, couple = laterals[9:18]
    shear, moment = laterals[18:]
    return NeedleState(
        Boundary(NodePose(base_x, base_y, base_slope), guide, bevel, load),
        Cut(NodePose(begun_x, begun_y, begun_slope), CutChannel(cut_front, cut_rest), spin),
        CutChannel(front, rest),
        Equilibrium(
            NodePose(tip_x, tip_y, tip_slope),
            Iterate(spring, shortening, Bearing(wall, give, guide_y, guide_force)),
            Loads(force, reaction, couple, shear, moment),
            behind,
            iterations,
            residual,
            good,
        ),
    )


def row_size(axes: int) -> int:
    """Return the number of numbers of a needle."""
    return REALS + axes * LATERALS


def to_row(needle: NeedleState, axes: int) -> Floats:
    """Return the numbers (REALS + axes LATERALS,) of a needle."""
    reals, laterals = interpret(apart)(needle)
    return np.concatenate([np.array(reals, dtype=float), to_parts(np.array(laterals), axes).ravel()])


def from_row(row: Floats) -> NeedleState:
    """Return the needle of `to_row`."""
    laterals = from_parts(row[REALS:].reshape(LATERALS, -1))
    return interpret(together)(row[:REALS].tolist(), laterals.tolist())


def to_parts(laterals: Laterals, axes: int) -> Floats:
    """Return the parts (…, axes) of laterals (…)."""
    parts = np.empty((*laterals.shape, axes))
    parts[..., 0] = laterals.real
    if axes > 1:
        parts[..., 1] = laterals.imag
    return parts


def from_parts(parts: Floats) -> Laterals:
    """Return the laterals (…) of parts (…, axes): real in the plane, complex in space."""
    laterals: Laterals = parts[..., 0] if parts.shape[-1] == 1 else parts[..., 0] + 1j * parts[..., 1]
    return laterals
