"""Records of the needle and its solve, and their form as plain tuples, which kernels return."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lateral import Lateral

Laterals = NDArray[Any]
Work = NDArray[Any]

Plain = tuple[Any, ...]


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
    behind: int  # number of nodes behind the tip


class Loads(NamedTuple):
    """Lateral force on the tip (N), reaction of a held tip, shear and moment (N·mm) of the needle at the base."""

    tip: Lateral
    reaction: Lateral
    shear: Lateral
    moment: Lateral


class Equilibrium(NamedTuple):
    """Equilibrium and its search; residual: estimated distance from equilibrium (mm)."""

    tip: NodePose
    last: Iterate
    loads: Loads
    iterations: int
    residual: float
    converged: bool


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


@inner
def to_plain(needle: NeedleState) -> Plain:
    """Return a needle as tuples without names, for `from_plain`.

    Kernels return these. Compiled code that makes a named tuple for Python calls Python: if a signal's handler raises
    there, as Ctrl-C does, the process crashes.
    """
    boundary, cut, solution = needle.boundary, needle.cut, needle.solution
    base, begun, tip, last, loads = boundary.base, cut.tip, solution.tip, solution.last, solution.loads
    guide, channel = last.guide, needle.channel
    return (
        (base.x, base.y, base.slope),
        (boundary.guide, boundary.bevel, boundary.load),
        (begun.x, begun.y, begun.slope),
        (cut.channel.front, cut.channel.rest, cut.spin),
        (channel.front, channel.rest),
        (tip.x, tip.y, tip.slope),
        (last.spring, last.shortening, last.behind),
        (guide.wall, guide.give, guide.y, guide.force),
        (loads.tip, loads.reaction, loads.shear, loads.moment),
        (solution.iterations, solution.residual, solution.converged),
    )


def from_plain(plain: Plain) -> NeedleState:
    """Return the needle of `to_plain`."""
    base, imposed, begun, cut, channel, tip, last, guide, loads, found = plain
    (front, rest, spin), (spring, shortening, behind) = cut, last
    return NeedleState(
        Boundary(NodePose(*base), *imposed),
        Cut(NodePose(*begun), CutChannel(front, rest), spin),
        CutChannel(*channel),
        Equilibrium(
            NodePose(*tip), Iterate(spring, shortening, Bearing(*guide), behind), Loads(*loads), *found
        ),
    )


def start(base: NodePose, tip: NodePose, bevel: Lateral, guide: Lateral) -> NeedleState:
    """Return the straight needle in air, before a solve, with the guide on it."""
    none = 0.0 * bevel
    channel = CutChannel(0.0, none)
    solution = Equilibrium(
        tip,
        Iterate(none, 0.0, Bearing(none, 0.0, none, none), 0),
        Loads(none, none, none, none),
        0,
        0.0,
        True,
    )
    return NeedleState(Boundary(base, guide, bevel, none), Cut(tip, channel, 0.0), channel, solution)


def work_array(rest: Laterals) -> Work:
    """Return the solver's array (n,) for rest positions (n,): by node, left of it (a, g, B), of it, and the solution.

    a1, g1, b11, b12 are taken before an essential node, all else after.
    """
    real, across = np.dtype(np.float64), rest.dtype
    reals = [
        (name, real)
        for name in ("g1", "g2", "b11", "b12", "b22", "stiffness", "share", "sharpness", "turning")
    ]
    laterals = [
        (name, across) for name in ("a1", "a2", "fixed", "force", "new_u", "y", "slope", "shear", "moment")
    ]
    return np.zeros(rest.size, np.dtype([*reals, *laterals]))
