"""Problems in space that validate the exact plant, for tests and the page (in a plane: `reference.validation`)."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from reference import elastica, kirchhoff
from reference.bent_rods import assembled
from reference.rods import IDEAL, Bench
from reference.space_insertions import Inserted

EI, GJ, LENGTH = 1000.0, 770.0, 100.0
SEGMENTS = (32, 64, 128)
EULER = 4.0 * math.pi**2 * EI / LENGTH**2
"""Buckling load (N) of a rod clamped at both ends."""


HELIX_SEGMENTS = (40, 80, 160)
SHARES = (0.0, 0.5)


def drawn(seed):
    """Return a rod with natural bend, tilted and rolled, bent by about a radian by a force in any direction."""
    rng = np.random.default_rng(seed)
    load = rng.normal(0.0, 1.0, 3)
    load *= rng.uniform(1.0, 2.5) * EI / LENGTH**2 / np.linalg.norm(load)
    tilt = rng.normal(0.0, 0.3, 2)
    bend, roll = rng.uniform(-0.01, 0.01), rng.uniform(-3.0, 3.0)
    return kirchhoff.Clamped(LENGTH, EI, GJ, bend, (tilt[0], tilt[1]), roll, load)


def loaded(rod, segments):
    """Return a bench with that rod, its load applied in parts."""
    bench = Bench(
        length=rod.length,
        segments=segments,
        tilt=rod.tilt,
        curvature=rod.curvature,
        stiffness=rod.stiffness,
        torsion=rod.torsion,
    ).step(roll=rod.roll)
    for part in range(1, 7):
        if not bench.loaded(*(rod.load * part / 6)).converged:
            raise ValueError(f"no equilibrium of {rod}")
    return bench


def solver_gap(rod, segments) -> tuple[float, float]:
    """Return the distance of the tip (mm) and the largest difference of its axes from the second solver."""
    position, frame = kirchhoff.tip(rod)
    bench = loaded(rod, segments)
    axes = Rotation.from_quat(bench.segments["frame"][-2], scalar_first=True).as_matrix()
    return float(np.linalg.norm(bench.nodes[-1] - position)), float(np.abs(axes - frame).max())


def helix_residual(segments) -> float:
    """Return the moment per mm (over EI κ²) that is not balanced within a helix under its wrench.

    Kirchhoff: with the twist T the force is (GJ T − EI τ) √(κ² + τ²) along its axis; the ends would need a couple.
    """
    twist = 0.03
    turns, bend, torsion, axis = kirchhoff.helix(15.0, 60.0, twist, LENGTH, segments)
    bench = Bench(length=LENGTH, segments=segments, stiffness=EI, torsion=GJ)
    bench.s["load"] = (GJ * twist - EI * torsion) * math.hypot(bend, torsion) * axis
    _, gradient = assembled(bench, turns.as_quat(scalar_first=True), np.zeros((segments, 3)))
    moment = np.linalg.norm(bench.segments["moment"][segments // 2])
    if abs(moment / math.hypot(GJ * twist, EI * bend) - 1.0) > 0.01:
        raise ValueError(f"moment of the helix: {moment} N·mm")
    left = gradient.reshape(-1, 3)[2:-2] / (LENGTH / segments)
    return float(np.abs(left).max() / (EI * bend**2))


def held(push=0.0):
    """Return a rod between a clamp at its base and stiff tissue that holds direction and roll of its last 6 mm."""
    bench = Bench(
        length=LENGTH + 6.0,
        segments=106,
        base=(-LENGTH, 0.0, 0.0),
        spacing=0.25,
        foundation=np.array([1e4]),
        rotation_friction=200.0,
    )
    for k, point in enumerate(bench.channel[:20]):
        point["place"], point["height"] = (0.1 + 0.25 * k, 0.0, 0.0), 20.0
        point["stiffness"], point["weight"] = 1e4, 1.0
    bench.count = 20
    bench.s["cut"], bench.s["front"], bench.s["front_tangent"] = 6.0, (6.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    bench.s["load"] = -push, 0.0, 0.0
    return bench.step()


def twisted(share, turn):
    """Return that rod under a share of Euler's load, its base rolled in 40 steps; None if it has buckled."""
    bench = held(share * EULER)
    for _ in range(40):
        if not bench.step(roll=turn / 40).converged:
            return None
    return bench


def buckling_twist(share) -> float:
    """Return the greatest stable moment of a twisted rod over Greenhill's, by bisection of the roll of its base."""
    moment = elastica.twisted_buckling_moment(LENGTH, EI, share * EULER)
    low, high, found = 0.9 * moment * LENGTH / GJ, 1.1 * moment * LENGTH / GJ, math.nan
    for _ in range(10):
        middle = 0.5 * (low + high)
        bench = twisted(share, middle)
        if bench is None:
            high = middle
        else:
            low, found = middle, float(bench.s["base_moment"][0]) / moment
    return found


def inserted_straight(couple=20.0):
    """Return a straight needle 40 mm deep, with this friction against rotation (mN)."""
    straight = {"needle.bevel.offset_mm": 0.0, "phantom.rotation_friction_mn": couple}
    return Inserted(IDEAL.with_values(straight)).move(db_x=0.5, times=137)


def largest_lag(needle, couple=0.02) -> float:
    """Return c l²/2GJ in the tissue and c l over the free length (rad), for c in N."""
    inside, gj = needle.tip[0], needle.rod.torsion
    return couple * inside * (0.5 * inside + 150.0 - inside) / gj


def lag_error() -> float:
    """Return the relative error of the lag after a roll by 1.5 rad in parts."""
    needle = inserted_straight().move(roll=0.075, times=20)
    return -float(needle.s["twist"]) / largest_lag(needle) - 1.0
