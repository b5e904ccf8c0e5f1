"""The exact needle and its state: a rod in space, inextensible, unshearable, with twist (docs/theory.md section 11).

The needle is a chain of N rigid segments of length h with frames R_i, hinged by springs against bending and twist.
Nodes follow as p_{i+1} = p_i + h t_i along the first axes t_i of the frames, so the length is kept exactly and the mesh
moves with the needle. The second axes are the direction of the bevel.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.phantom.space import (
    Floats,
    Turn,
    Vector,
    after,
    first_axis,
    plus,
    put,
    put_turn,
    roll_about_x,
    roll_turn,
    tilt_of,
    tilt_turn,
    times,
    turn,
    vector,
)

STATE = np.dtype(
    [
        ("base", float, 3),  # position (mm)
        ("tilt", float, 2),  # of the base: its angle with x (rad) in the direction of y and z
        ("half_roll", float, 2),  # cos and sin of half the roll of the base
        ("roll", float),  # of the base since the start (rad)
        ("guide", float, 2),  # y and z (mm)
        ("softening", float),  # of the guide during a solve, 1: none
        ("held", float),  # 1: guide and channel stay at their last segments
        ("guide_segment", np.int64),  # of the needle in the guide
        ("slide", float),  # last direction of axial motion, −1, 0, +1
        ("tip", float, 3),
        ("tangent", float, 3),  # of the tip
        ("frame", float, 4),  # of the tip
        ("twist", float),  # of the needle from base to tip (rad)
        ("offset", float, 3),  # of the bevel's rest point from the tip (mm), across the tip
        ("cut", float),  # length of the channel (mm)
        ("front", float, 3),  # of the channel
        ("front_tangent", float, 3),
        ("load", float, 3),  # dead force on the tip (N)
        ("iterations", float),
        ("residual", float),  # length of the last Newton step (mm)
        ("converged", float),
        ("energy", float),  # stored in needle, tissue and guide (mJ)
        ("strain_energy", float),  # of the tissue, weighted by layer (mJ)
        ("least_stretch", float),
        ("base_force", float, 3),  # on the needle (N)
        ("base_moment", float, 3),  # on the needle (N·mm)
        ("guide_force", float, 2),  # on the needle (N)
    ]
)
State = Any
"""One record of STATE; kernels write its fields as attributes."""

POINT = np.dtype(
    [
        ("place", float, 3),
        ("cut", float),  # distance along the channel (mm)
        ("segment", np.int64),  # of the needle there
        ("law", np.int64),
        ("height", float),  # of the law (mm)
        ("stiffness", float),  # of the law (N/mm)
        ("weight", float),  # of its energy
    ]
)
"""A point of the channel."""

SEGMENT = np.dtype(
    [
        ("frame", float, 4),
        ("slip", float),  # rotation of the shaft in the tissue from where friction does not act (rad)
        # For a solve:
        ("node", float, 3),  # at its start; one more after the last segment is the tip
        ("tangent", float, 3),
        ("force", float, 3),  # gradient of the energy in the node
        ("couple", float, 3),  # and in the rotation of the segment
        ("pp", float, 6),  # its second derivatives: in the node,
        ("pt", float, 9),  # in node and rotation,
        ("tt", float, 6),  # in the rotation
        ("moment", float, 3),  # of the hinge before the segment (N·mm)
        ("hinge", float, 6),  # and its stiffness
        ("gain", float, 3),  # of a Newton step: alone,
        ("gain_node", float, 9),  # times the node's,
        ("gain_last", float, 9),  # times the previous segment's
        ("friction", float, 3),  # along the axis (N)
        ("inside", float),  # length in the tissue (mm)
        ("step", float, 3),  # rotation in a Newton step
        ("start", float, 4),  # frame at its start
        ("held", float, 4),  # frame to which the solve returns if full steps lead nowhere
        ("rest", float, 4),  # frame before the load step, with the base's roll
    ]
)
"""A segment of the needle."""

Records = Any
"""An array of POINT or SEGMENT; the latter has N + 1 for N segments."""


class Rod(NamedTuple):
    """Constants of the exact needle."""

    stiffness: float  # bending stiffness (N·mm²)
    torsion: float  # torsional stiffness (N·mm²)
    segment: float  # length of a segment (mm)
    curvature: float  # natural curvature towards the bevel (1/mm)
    curvature_across: float  # natural curvature towards a quarter turn from the bevel (1/mm)
    bevel_offset: float  # offset of the bevel (mm)
    bevel_length: float  # length of the bevel (mm)
    guide_x: float  # plane of the guide (mm, NaN: none)
    clearance: float  # clearance of the guide (mm)
    guide_stiffness: float  # stiffness of the guide (N/mm)
    friction: float  # friction along the axis (N/mm)
    rotation_friction: float  # friction against rotation (N·mm/mm)
    spacing: float  # spacing of channel points (mm)
    cell: float  # length of the cells of tissue along the depth (mm)
    laws: Floats  # tables of `mechanics.law`
    law: NDArray[np.int64]  # index of the law of the bevel's spring in each cell
    channel_law: NDArray[np.int64]  # index of the law of the channel's points in each cell
    height: Floats  # compression length of each cell (mm)
    foundation: Floats  # initial stiffness (N/mm) of 1 mm of needle in each cell
    weight: Floats  # layer weight of each cell


@kernel
def _frames(theta: float, psi: float, roll: float) -> tuple[Turn, Turn, Vector]:
    """Return the roll, the frame of a base that is rolled and then tilted (rad), and its first axis."""
    half = roll_turn(roll)
    turned = after(tilt_turn(theta, psi), half)
    return half, turned, first_axis(turned)


@kernel
def tip_angles(s: State) -> tuple[float, float, float]:
    """Return the tilt θ, ψ of the tip from x, by √(θ² + ψ²), and its roll before the tilt, from −π to π (rad)."""
    theta, psi = tilt_of(vector(s.tangent))
    return theta, psi, roll_about_x(turn(s.frame))


def start(
    base: Vector, tilt: tuple[float, float], length: float, segments: int, roll: float = 0.0
) -> tuple[State, Records]:
    """Return state and segments of a straight needle at rest in air, by the pose of its base and its roll (mm, rad)."""
    half, turned, tangent = _frames(float(tilt[0]), float(tilt[1]), roll)
    s = np.zeros(1, STATE)[0]
    s["base"], s["tilt"], s["half_roll"], s["roll"] = base, tilt, half[:2], roll
    s["tip"], s["tangent"], s["frame"] = np.array(base) + length * np.array(tangent), tangent, turned
    s["converged"] = s["softening"] = 1.0
    w = np.zeros(segments + 1, SEGMENT)
    w["frame"] = turned
    return s, w


@inner
def move_nodes(rod: Rod, s: State, w: Records) -> None:
    """Set nodes and tangents from frames, and the tip in the state."""
    n = len(w) - 1
    node = vector(s.base)
    for i in range(n):
        put(w[i].node, node)
        tangent = first_axis(turn(w[i].frame))
        put(w[i].tangent, tangent)
        node = plus(node, times(rod.segment, tangent))
    put(w[n].node, node)
    put(s.tip, node)
    put(s.tangent, vector(w[n - 1].tangent))
    put_turn(s.frame, turn(w[n - 1].frame))
