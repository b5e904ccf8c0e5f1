"""Results of the problems that validate the exact plant, for the page and its figures."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from reference import space_validation as in_space
from reference import validation as problems
from reference.rods import Bench

SEGMENTS = np.array([16, 32, 64, 128, 256])
SCALES = (2.0, 2**0.5, 1.0, 0.5**0.5, 0.5, 0.125**0.5, 0.25, 0.03125**0.5, 0.125)
MESHES = {0.5: problems.SHIPPED, 0.25: problems.SMALL, 0.125: problems.FINE}
CUBIC = slice(3, 8)  # of SCALES: where the cube of the angle is most of the difference
RESOLUTIONS, BEVELS = (1.0, 0.5, 0.25), (1.0, 3.0)
STEPS = (0.5, 0.25, 0.125, 0.0625)
ELEMENTS = np.array([2.0, 1.0, 0.5, 0.25, 0.125])
SIZES = {  # of one kind, the rest as shipped; the last one is the reference
    "element": np.array([2.0, 1.0, 0.5, 0.25, 0.0625]),
    "step": np.array([0.5, 0.25, 0.125, 0.0625, 0.015625]),
    "spacing": np.array([1.0, 0.5, 0.25, 0.125]),
}


@dataclass(frozen=True)
class Space:
    """All results in space."""

    solver: list[np.ndarray]  # distances of the tips (mm) from the second solver, by rod and SEGMENTS
    helix: list[float]  # unbalanced moment per mm over EI κ², by HELIX_SEGMENTS
    twist: dict[
        float, float
    ]  # moment that buckles a twisted rod over the closed form, by share of Euler's load
    lag: float  # of the tip over the closed form, minus 1


@dataclass(frozen=True)
class Found:
    """All results; sizes in mm, angles in rad, energies in mJ."""

    cantilever: dict[float, np.ndarray]  # by load: errors of the tip (x/L, y/L, θ) by SEGMENTS
    shapes: dict[float, np.ndarray]  # nodes over L
    buckling: float
    gaps: dict[int, dict[float, list[problems.Gap]]]  # by layers and element, along SCALES
    curvature: dict[float, list[float]]  # by bevel length: relative errors by RESOLUTIONS
    moves: dict[str, tuple[float, float]]  # work and change of the stored energy
    balances: dict[float, list[problems.Balance]]  # by friction, along STEPS
    second: np.ndarray  # largest distances from the second solver (x, y, θ) by ELEMENTS
    rubbed: list[float]  # the same with friction at the end, for one and two parts of a step
    refined: dict[str, np.ndarray]  # distances (mm) from the finest, by SIZES
    space: Space


def compute(*, quick: bool = False) -> Found:
    """Compute all results; quick: the differences from the model with the coarsest elements, for all sizes."""
    coarsest = max(MESHES)
    beams = {load: cantilevers(load) for load in problems.LOADS}
    return Found(
        cantilever={load: errors for load, (errors, _) in beams.items()},
        shapes={load: nodes for load, (_, nodes) in beams.items()},
        buckling=problems.buckling_factor(64),
        gaps={
            layers: dict.fromkeys(MESHES, model_gaps(layers, coarsest))
            if quick
            else {h: model_gaps(layers, h) for h in MESHES}
            for layers in (1, 2)
        },
        curvature={b: [problems.curvature_error(r, b) for r in RESOLUTIONS] for b in BEVELS},
        moves={name: problems.energy_balance(name, 40) for name in problems.MOVES},
        balances={f: [problems.insertion_balance(step, friction=f) for step in STEPS] for f in (0.0, 5.0)},
        second=second_solver(),
        rubbed=[rubbed(parts) for parts in (1, 2)],
        refined={name: refined(name) for name in SIZES},
        space=compute_space(),
    )


def cantilevers(load: float) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of the tip by SEGMENTS, and the nodes of the finest over the length."""
    errors = np.array([problems.cantilever_error(load, n) for n in SEGMENTS.tolist()])
    bench = Bench(length=100.0, segments=int(SEGMENTS[-1])).loaded(y=load * 1000.0 / 100.0**2)
    return errors, bench.nodes[:, :2] / 100.0


def model_gaps(layers: int, element: float) -> list[problems.Gap]:
    """Compare exact plant and controller's model along SCALES."""
    return [problems.model_gap(scale, layers, **MESHES[element]) for scale in SCALES]


def second_solver() -> np.ndarray:
    """Return the largest distances of the tip on the way, by ELEMENTS."""
    expected = problems.shot(problems.ROUGH, problems.wander())
    paths = (problems.stepped(problems.ROUGH, problems.wander(), h) for h in ELEMENTS.tolist())
    return np.array([np.abs(path - expected).max(axis=0) for path in paths])


def rubbed(parts: int) -> float:
    """Return the distance of the tips (mm) after a push with ten times the friction, each step in some parts."""
    scenario = problems.ROUGH.with_values({"phantom.friction_mn_per_mm": 50.0})
    ends = (
        problems.stepped(scenario, problems.push(parts), 0.25),
        problems.shot(scenario, problems.push(parts)),
    )
    return float(np.hypot(*(ends[0] - ends[1])[-1, :2]))


def refined(name: str) -> np.ndarray:
    """Return the distances of the tip from the tip with the finest size."""
    cell = {"cell": 0.125} if name == "spacing" else {}
    tips = np.array([problems.inserted_tip(**{name: size}, **cell)[:2] for size in SIZES[name].tolist()])
    return np.hypot(*(tips[:-1] - tips[-1]).T)


def compute_space() -> Space:
    """Compute all results in space."""
    rods = [in_space.drawn(seed) for seed in range(3)]
    return Space(
        [np.array([in_space.solver_gap(rod, segments)[0] for segments in in_space.SEGMENTS]) for rod in rods],
        [in_space.helix_residual(segments) for segments in in_space.HELIX_SEGMENTS],
        {share: in_space.buckling_twist(share) for share in in_space.SHARES},
        in_space.lag_error(),
    )
