"""Problems that validate the exact plant: tests assert their figures, studies/validation.py prints them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flexneedle import Control, Simulator, controls
from flexneedle.phantom.draw import Truth
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, THETA
from reference import closed_forms, elastica
from reference.cases import EI, FOUNDATION, long_beam
from reference.rods import IDEAL, PERFECT, Bench, Shooting, move, planar, plant

LOADS = {1.0: 0.3017, 2.0: 0.4935, 5.0: 0.7138}
"""PL²/EI of a cantilever, and the deflection of its tip over its length in tables."""

SMALL = {"element": 0.25, "spacing": 0.25, "step": 0.125}
"""Resolution (mm) of the comparison with the controller's model; SHIPPED is the phantom's own."""
SHIPPED = {"element": 0.5, "spacing": 0.5, "step": 0.25}
FINE = {"element": 0.125, "spacing": 0.125, "step": 0.0625}
_RIGID = 1e5  # N/mm: the guide of the controller's model does not give

BASE, TURN, GUIDE = "base", "turn", "guide"
MOVES = {  # base y (mm), base turn (rad), guide y (mm)
    BASE: (-2.0, 0.0, 0.0),
    TURN: (0.0, 0.02, 0.0),
    GUIDE: (0.0, 0.0, 2.0),
    "all": (-1.0, 0.01, 1.0),
}


def order(sizes, errors) -> float:
    """Return p of errors ~ sizes^p, fitted."""
    return float(np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0])


def orders(values) -> np.ndarray:
    """Return p of values computed with halved sizes, from the ratio of their differences."""
    gaps = np.abs(np.diff(values))
    return np.log2(gaps[:-1] / gaps[1:])


# --- the needle alone


def cantilever_error(load: float, segments: int) -> np.ndarray:
    """Return the error of the tip (x/L, y/L, θ) of a cantilever under a dead load across it; load = PL²/EI."""
    bench = Bench(length=100.0, segments=segments)
    bench.loaded(y=load * bench.rod.stiffness / 100.0**2)
    if not bench.converged:
        raise ValueError(f"PL²/EI = {load}: no equilibrium")
    return bench.tip / [100.0, 100.0, 1.0] - elastica.cantilever(load)


def buckling_factor(segments: int) -> float:
    """Return the load under which a straight column is no longer stable, over Euler's."""
    euler = elastica.buckling_load(100.0, 1000.0)
    low, high = 0.9, 1.1
    for _ in range(30):
        middle = 0.5 * (low + high)
        stable = Bench(length=100.0, segments=segments).loaded(x=-middle * euler).converged
        low, high = (middle, high) if stable else (low, middle)
    return 0.5 * (low + high)


# --- insertions


def commands(scale: float, depth: float, step: float) -> np.ndarray:
    """Return rows (m, 9) to `depth` mm: the guide swings by 2.4 mm times `scale`; the bevel turns over 20 mm deep."""
    count = round((depth + IDEAL.setup.tip_to_skin_mm) / step)
    way = step * np.arange(count + 1)
    guide = np.diff(1.2 * scale * (1.0 - np.cos(2.0 * np.pi * way / 50.0)))
    roll = np.where(np.abs(way[:-1] - IDEAL.setup.tip_to_skin_mm - 20.0) < 1e-9, np.pi, 0.0)
    return controls(count, db_x=step, dg_y=guide, roll=roll)


def scaled(scale: float, layers: int, element: float, spacing: float):
    """Return the paper's phantom with one or two layers, its bevel offset times `scale`; no imperfections."""
    softer = {} if layers == 2 else {f"tissue.{k}.shear_modulus_kpa": 2.5 for k in (0, 1)}
    return IDEAL.with_values(
        softer
        | {
            "needle.bevel.offset_mm": scale * IDEAL.needle.bevel.offset_mm,
            "contact.spacing_mm": spacing,
            "phantom.contact_spacing_mm": spacing,
            "phantom.element_mm": element,
        }
    )


def inserted_tip(
    *, scale=1.0, layers=2, element=0.5, spacing=0.5, step=0.25, depth=44.5, **truth
) -> np.ndarray:
    """Return the tip (x, y, θ) after that insertion."""
    needle = plant(scaled(scale, layers, element, spacing), **truth)
    for row in commands(scale, depth, step):
        needle.step(row)
    return planar(move(needle).tip)


@dataclass(frozen=True)
class Gap:
    """Differences between exact plant and controller's model over an insertion."""

    angle: float  # largest of the needle's tip, rad
    lateral: float  # largest distance of the tips, mm
    end: float  # the same at the end
    energy: float  # at the end, relative


def model_gap(scale: float, layers: int, *, element: float, spacing: float, step: float) -> Gap:
    """Compare exact plant and controller's model: same scenario, same spacing of contacts, same commands."""
    scenario = scaled(scale, layers, element, spacing)
    rows = commands(scale, 44.5, step)
    simulator, needle = Simulator(scenario, threads=1), plant(scenario)
    needle.rod = needle.rod._replace(guide_stiffness=_RIGID)
    state, tips = simulator.start(), []
    for row in rows:
        state = simulator.step(state, Control.of(row.tolist()))
        needle.step(row)
        tips.append((needle.tip, state.tip))
    move(needle)
    exact, model = np.array(tips).swapaxes(0, 1)
    apart = np.hypot(*(exact - model)[:, :2].T)
    energy = needle.strain_energy / state.strain_energy - 1.0
    return Gap(float(np.abs(exact[:, THETA]).max()), float(apart.max()), float(apart[-1]), energy)


def path_curvature(resolution: float, bevel_length: float, bevel: float = 0.01) -> float:
    """Return κ (1/mm) over the last 6/β of a path that is 25/β deep, all sizes in `resolution` mm."""
    sizes = {"phantom.contact_spacing_mm": resolution, "phantom.element_mm": resolution}
    scenario = long_beam(250.0, spacing=resolution, bevel=bevel, bevel_length=bevel_length)
    needle = plant(scenario.with_values(PERFECT | sizes))
    tips = []
    for _ in range(round(251.0 / resolution)):
        needle.step(np.array(Control(db_x=resolution)))
        tips.append(needle.tip)
    x, y, *_ = np.array(tips).T
    last = x > 190.0
    bend, slope, _ = np.polyfit(x[last] - x[last].mean(), y[last], 2)
    return float(2.0 * bend / (1.0 + slope**2) ** 1.5)


def curvature_error(resolution: float, bevel_length: float) -> float:
    """Return its relative difference from docs/theory.md eq. 10."""
    expected = closed_forms.steady_curvature(0.01, bevel_length, FOUNDATION, EI)
    return path_curvature(resolution, bevel_length) / expected - 1.0


# --- a second solver

ROUGH = IDEAL.with_values(
    {
        "needle.length_mm": 100.0,
        "setup.tip_to_skin_mm": 1.0,
        "setup.guide_to_skin_mm": 20.0,
        "setup.stroke_mm": 50.0,
        "target.depth_mm": 20.0,
        "tissue.0.thickness_mm": 8.0,
        "phantom.contact_spacing_mm": 1.0,
        "phantom.guide_clearance_mm": 0.05,
    }
)
"""A short needle in two thin layers, with imperfections, for a quick comparison."""
START = {
    "base_y": 0.4,
    "base_turn": 0.003,
    "bend": 0.5,
    "variation": tuple((1.0 + 0.3 * np.sin(0.3 * np.arange(200))).tolist()),
}
_STEP_MM = 0.47  # never a whole number of them to a channel point


def wander(steps: int = 48):
    """Yield commands in all inputs: in, drawn back from half way, in again; the bevel turned over twice."""
    for k in range(steps):
        yield {
            "db_x": -_STEP_MM if 24 <= k < 30 else _STEP_MM,
            "db_y": 0.02 * np.sin(k / 9.0),
            "db_theta": 4e-4 * np.cos(k / 7.0),
            "dg_y": 0.12 * np.cos(k / 10.0),
            "flip": k in (14, 38),
        }


def push(parts: int):
    """Yield commands for 14 mm ahead under a guide that moves laterally, each step in some parts."""
    for k in range(30 * parts):
        yield {"db_x": _STEP_MM / parts, "dg_y": 0.12 / parts * np.cos(k / parts / 10.0)}


def shot(scenario, rows) -> np.ndarray:
    """Return the poses of the tip (m, 3) by shooting."""
    needle = Shooting(Truth(scenario, cell_mm=0.5, **START))
    return np.array([needle.step(**row).tip for row in rows])


def stepped(scenario, rows, element: float) -> np.ndarray:
    """Return the poses of the tip (m, 3) of the plant: x, y, θ."""
    needle = plant(scenario.with_values({"phantom.element_mm": element}), cell=0.5, **START)
    return np.array([planar(move(needle, **row).tip) for row in rows])


# --- work and energy


def bent(withdrawn: float, friction: float = 0.0):
    """Return a plant 31.5 mm deep on a bent path, drawn back by some mm: nothing there cuts."""
    needle = plant(IDEAL.with_values({"phantom.friction_mn_per_mm": friction}))
    for k in range(240):
        move(needle, 0.25, dg_y=0.02 if k < 200 else -0.01, flip=k == 200)
    return move(needle, -withdrawn / 20, times=20)


def holding(needle) -> np.ndarray:
    """Return force x, y and moment of the base, and force of the guide (N, N·mm), in the plane."""
    s = needle.state
    return np.array([*s["base_force"][:2], s["base_moment"][2], s["guide_force"][0]])


def work(needle, *, steps: int, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0) -> tuple[float, float]:
    """Return work of base and guide and change of the stored energy over a move, by the trapezoid rule."""
    part = np.array([db_x, db_y, db_theta, dg_y]) / steps
    energy = needle.state["energy"]
    forces = [holding(needle), *(holding(move(needle, *part)) for _ in range(steps))]
    done = sum(0.5 * float((before + after) @ part) for before, after in pairwise(forces))
    return done, float(needle.state["energy"] - energy)


def energy_balance(name: str, steps: int) -> tuple[float, float]:
    """Return work and change of the stored energy of one of MOVES, with no contact point about to grow in."""
    db_y, db_theta, dg_y = MOVES[name]
    return work(bent(3.75), steps=steps, db_y=db_y, db_theta=db_theta, dg_y=dg_y)


def friction_balance(steps: int, friction: float = 5.0) -> tuple[float, float, float]:
    """Return work, change of the stored energy and dissipation in a push by 3 mm along the present channel."""
    needle = bent(8.0, friction)
    move(needle, 1e-3)  # from now on it slides forward
    before = inside_length(needle)
    done, stored = work(needle, steps=steps, db_x=3.0)
    return done, stored, 1e-3 * friction * 0.5 * (inside_length(needle) ** 2 - before**2)


def slide(before: np.ndarray, after: np.ndarray) -> float:
    """Return the slide of the needle in the tissue along itself, over its length (mm²), from its nodes (N + 1, 3)."""
    way = np.diff(0.5 * (before + after), axis=0)
    length = np.linalg.norm(way, axis=1)
    along = (0.5 * (after - before)[:-1] + 0.5 * (after - before)[1:]) * way / length[:, None]
    left, right = 0.5 * (before + after)[:-1, 0], 0.5 * (before + after)[1:, 0]
    inside = np.clip(right / (right - left), 0.0, 1.0) * length
    return float(inside @ along.sum(axis=1))


@dataclass(frozen=True)
class Balance:
    """Energies of an insertion, mJ."""

    base: float  # work of the base
    guide: float  # and of the guide
    bevel: float  # and of the tissue on the bevel: what cutting feeds into the needle
    needle: float  # stored in its bending
    tissue: float  # stored along the channel
    spring: float  # stored in the guide
    friction: float  # dissipated

    @property
    def work(self) -> float:
        """Work done on the needle."""
        return self.base + self.guide + self.bevel

    @property
    def gap(self) -> float:
        """Share of the work that is neither stored nor dissipated."""
        return 1.0 - (self.needle + self.tissue + self.spring + self.friction) / self.work


def insertion_balance(step: float, *, spacing=0.5, element=0.5, depth=40.0, friction=5.0) -> Balance:
    """Return the work, by the trapezoid rule, over an insertion with guide motion and a flip, and its balance."""
    needle = plant(scaled(1.0, 2, element, spacing).with_values({"phantom.friction_mn_per_mm": friction}))
    done, lost, last, before = np.zeros(3), 0.0, np.zeros(6), needle.nodes
    for row in commands(1.0, depth, step):
        needle.step(row)
        nodes, forces = needle.nodes, np.append(holding(needle), -needle.segments["force"][-1, :2])
        shares = 0.5 * (forces + last) * [*row[[DB_X, DB_Y, DB_THETA, DG_Y]], *(nodes - before)[-1, :2]]
        done += [shares[:3].sum(), shares[3], shares[4:].sum()]
        lost += 1e-3 * friction * slide(before, nodes)
        last, before = forces, nodes
    s, w, rod = move(needle).state, needle.segments[:-1], needle.rod
    bends = np.full(w.size, rod.segment)
    bends[0] *= 0.5
    return Balance(
        *done.tolist(),
        needle=float((w["moment"][:, 2] ** 2 * bends).sum() / (2.0 * rod.stiffness)),
        tissue=needle.strain_energy,
        spring=float(s["guide_force"][0] ** 2 / (2.0 * rod.guide_stiffness)),
        friction=lost,
    )


def inside_length(needle) -> float:
    """Return the arc length (mm) of the needle in the tissue."""
    x = needle.nodes[:, 0]
    arc = needle.rod.segment * np.arange(x.size)
    return float(arc[-1] - np.interp(0.0, x, arc))
