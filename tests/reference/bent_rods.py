"""Rods bent and twisted in space by any amount, with their energy and its gradient, for comparison with the sweep."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from flexneedle.mechanics import law
from flexneedle.phantom import equilibrium, loads, rod, space, sweep
from flexneedle.scenario.tissue.ogden import Ogden
from reference.interpreted import Record, interpreted
from reference.rods import Bench

PLAIN = interpreted(law, space, rod, loads, sweep, equilibrium)


def parts(bench):
    """Return constants, state and segments of a bench for the plain kernels."""
    return bench.rod, Record(bench.s), [Record(row) for row in bench.segments]


SEGMENTS, POINTS = 8, 9
TISSUE = {
    "laws": law.tables(
        [
            Ogden(alpha=alpha, shear_modulus_kpa=1.0, compression_length_mm=20.0, engaged_width_mm=1.0)
            for alpha in (6.0, 8.74, -5.0, 8.0)
        ]
    ),
    "law": np.array([0, 1, 2]),
    "height": np.array([20.0, 15.0, 25.0]),
    "foundation": np.array([0.675, 2.36, 0.27]),
    "weight": np.array([1.0, 2.0, 0.5]),
    "cell": 14.0,
}


def crooked(seed, *, guide=True, channel=True, load=(0.3, -0.2, 0.25)):
    """Return a rod bent by up to 1 rad, in a channel up to 6 mm off and a guide 3 mm off it, its tip drawn back."""
    rng = np.random.default_rng(seed)
    bench = Bench(
        length=60.0,
        segments=SEGMENTS,
        base=(-30.0, 0.3, 0.2),
        stiffness=2000.0,
        torsion=1600.0,
        curvature=1e-2,
        curvature_across=-6e-3,
        bevel_offset=2.0,
        bevel_length=3.0,
        guide_x=-11.3 if guide else math.nan,
        clearance=0.05,
        guide_stiffness=3.0,
        **TISSUE,
    )
    bend = rng.normal(0.0, 0.15, (SEGMENTS, 3))
    frames = Rotation.from_rotvec(np.cumsum(bend, axis=0) + np.array([0.0, -0.1, 0.2]))
    bench.segments["frame"][:-1] = frames.as_quat(scalar_first=True)
    bench.s["guide"], bench.s["load"] = (2.0, -1.5), load
    PLAIN.move_nodes(*parts(bench))
    nodes, tip = bench.segments["node"], bench.s["tip"]
    if channel:
        x = np.linspace(0.3, tip[0] - 4.0, POINTS)
        bench.count, points = POINTS, bench.channel[:POINTS]
        points["place"][:, 0] = x
        for k in (1, 2):
            points["place"][:, k] = np.interp(x, nodes[:, 0], nodes[:, k]) + rng.normal(0.0, 3.0, POINTS)
        points["law"], points["height"], points["stiffness"], points["weight"] = 3, 20.0, 0.48, 1.0
    # The front is 5 mm ahead: no bevel here, whose force has no energy.
    bench.s["cut"], bench.s["front"], bench.s["front_tangent"] = (
        30.0,
        tip + np.array([5.0, 0.0, 0.0]),
        bench.s["tangent"],
    )
    return bench


def before(bench):
    """Return a step that begins where the bench is."""
    s = bench.s
    return loads.Before(tuple(s["tip"]), tuple(s["tangent"]), float(s["twist"]), 0.0, 0.0)


def assemble(bench, curved=1.0, begun=None):
    """Fill in nodes, forces and Hessians of the bench in its present shape."""
    constants, s, w = parts(bench)
    PLAIN.move_nodes(constants, s, w)
    channel = [Record(point) for point in bench.channel[: bench.count]]
    PLAIN.assemble(constants, s, w, channel, bench.count, begun or before(bench), curved)


def assembled(bench, frames, rotations):
    """Return energy (mJ) minus the work of the load with frames turned by vectors (N, 3), and its gradient in these."""
    turned = Rotation.from_rotvec(rotations) * Rotation.from_quat(frames, scalar_first=True)
    w, s = bench.segments, bench.s
    w["frame"][:-1] = turned.as_quat(scalar_first=True)
    assemble(bench)
    behind = np.cumsum(w["force"][::-1], axis=0)[-2::-1]  # forces on all nodes after a segment
    arms, moment = bench.rod.segment * w["tangent"][:-1], w["moment"][:-1]
    gradient = w["couple"][:-1] + np.cross(arms, behind) + moment
    gradient[:-1] -= moment[1:]
    return s["energy"] - s["load"] @ s["tip"], gradient.ravel()


def differences(function, size, step=1e-6):
    """Return central differences of a function of `size` numbers at zero, one row per number."""
    shifts = step * np.eye(size)
    return np.array([(function(e) - function(-e)) / (2 * step) for e in shifts])


def gradient_and_hessian(bench):
    """Return derivatives of the energy by rotation vectors (3N,); the second are differences of the first."""
    frames = bench.segments["frame"][:-1].copy()

    def gradient(vectors):
        return assembled(bench, frames, vectors.reshape(-1, 3))[1]

    hessian = differences(gradient, frames.shape[0] * 3)
    # Each row is a gradient at turned frames: half the commutator of two rotations of a frame cancels in the sum.
    return gradient(np.zeros(frames.shape[0] * 3)), 0.5 * (hessian + hessian.T)
