"""A second solver for rods in space: Kirchhoff's equations of the continuous rod, integrated from base to tip.

Nothing is shared with the exact plant: forces in balance instead of a minimum of energy, an adaptive integrator
instead of segments, rotation matrices instead of quaternions, and a search for the moment at the base.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation


class Clamped(NamedTuple):
    """A rod along x, rolled and then tilted at its base (rad), with a dead force (N) on its tip."""

    length: float
    stiffness: float
    torsion: float
    curvature: float
    tilt: tuple[float, float]
    roll: float
    load: np.ndarray


def frame_of(tilt, roll: float) -> Rotation:
    """Return the frame of a base along x, rolled and then tilted (rad)."""
    return Rotation.from_rotvec([0.0, -tilt[1], tilt[0]]) * Rotation.from_rotvec([roll, 0.0, 0.0])


def tip(rod: Clamped, parts: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Return position and axes (3, 3), in columns, of the tip; the load is applied in parts."""
    frame, moment = frame_of(rod.tilt, rod.roll), np.zeros(3)
    for part in range(1, parts + 1):
        load = rod.load * part / parts
        found = root(lambda m, load=load: _integrated(rod, frame, load, m)[12:], moment, tol=1e-12)
        moment = found.x
    end = _integrated(rod, frame, rod.load, moment)
    if np.abs(end[12:]).max() > 1e-7:
        raise ArithmeticError(f"a moment of {end[12:]} N·mm is left at the tip")
    return end[:3], end[3:12].reshape(3, 3)


def _integrated(rod, frame, load, moment):
    """Return position, axes and moment (15,) at the tip, from the moment at the base."""
    compliance = np.array([1.0 / rod.torsion, 1.0 / rod.stiffness, 1.0 / rod.stiffness])

    def slopes(_, state):
        axes, m = state[3:12].reshape(3, 3), state[12:]
        u = compliance * (axes.T @ m) + np.array([0.0, 0.0, rod.curvature])
        spin = np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
        return np.concatenate([axes[:, 0], (axes @ spin).ravel(), -np.cross(axes[:, 0], load)])

    start = np.concatenate([np.zeros(3), frame.as_matrix().ravel(), moment])
    return solve_ivp(slopes, (0.0, rod.length), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]


def helix(radius: float, pitch: float, twist: float, length: float, segments: int):
    """Return axes (N, 3, 3) of segments at their middles on a helix, in columns, the first its tangent; κ, τ, axis.

    The material turns about the tangent by `twist` (rad/mm), torsion included. The helix begins along x at the base,
    half a segment before the first segment; its axis is a unit vector.
    """
    size = math.hypot(radius, pitch / (2.0 * math.pi))
    bend, torsion = radius / size**2, pitch / (2.0 * math.pi) / size**2
    darboux = np.array([torsion, 0.0, bend])  # in Frenet's frame t, n, b, which turns about this fixed axis
    s = (np.arange(segments) + 0.5) * length / segments
    frenet = Rotation.from_rotvec(s[:, None] * darboux)
    own = Rotation.from_rotvec((twist - torsion) * s[:, None] * np.array([1.0, 0.0, 0.0]))
    return frenet * own, bend, torsion, darboux / np.linalg.norm(darboux)
