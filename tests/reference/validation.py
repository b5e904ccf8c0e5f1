"""The problems that validate the exact plant: tests assert their figures, studies/validation.py writes them down."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flexneedle import Control, Simulator
from flexneedle.phantom import rod as rd
from reference import closed_forms, elastica
from reference.cases import EI, FOUNDATION, long_beam
from reference.rods import IDEAL, PERFECT, Bench, move, plant

LOADS = {1.0: 0.3017, 2.0: 0.4935, 5.0: 0.7138}
"""PL²/EI of a cantilever, and the deflection of its tip over its length as tables have it."""

SMALL = {"element": 0.25, "spacing": 0.25, "step": 0.125}
"""Resolution (mm) of the comparison with the controller's model; SHIPPED is the phantom's own."""
SHIPPED = {"element": 0.5, "spacing": 0.5, "step": 0.25}

BASE, TURN, GUIDE = "base", "turn", "guide"
MOVES = {  # base y (mm), base turn (rad), guide y (mm)
    BASE: (-2.0, 0.0, 0.0),
    TURN: (0.0, 0.02, 0.0),
    GUIDE: (0.0, 0.0, 2.0),
    "all": (-1.0, 0.01, 1.0),
}
_FORCES = [rd.BASE_FORCE_X, rd.BASE_FORCE_Y, rd.BASE_MOMENT, rd.GUIDE_FORCE]


def order(sizes, errors) -> float:
    """p of errors ~ sizes^p, fitted."""
    return float(np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0])


def orders(values) -> np.ndarray:
    """p of values that were computed with halved sizes, from the ratio of their differences."""
    gaps = np.abs(np.diff(values))
    return np.log2(gaps[:-1] / gaps[1:])


# --- the needle alone


def cantilever_error(load: float, segments: int) -> np.ndarray:
    """Error of the tip (x/L, y/L, θ) of a cantilever under a dead load across it; load = PL²/EI."""
    bench = Bench(length=100.0, segments=segments)
    bench.loaded(y=load * bench.rod.stiffness / 100.0**2)
    if not bench.converged:
        raise ValueError(f"PL²/EI = {load}: no equilibrium")
    return bench.tip / [100.0, 100.0, 1.0] - elastica.cantilever(load)


def buckling_factor(segments: int) -> float:
    """Load under which a straight column is no longer stable, over Euler's."""
    euler = elastica.buckling_load(100.0, 1000.0)
    low, high = 0.9, 1.1
    for _ in range(30):
        middle = 0.5 * (low + high)
        stable = Bench(length=100.0, segments=segments).loaded(x=-middle * euler).converged
        low, high = (middle, high) if stable else (low, middle)
    return 0.5 * (low + high)


# --- insertions


def commands(scale: float, depth: float, step: float) -> np.ndarray:
    """Rows (m, 5) to `depth` mm: the guide swings by 2.4 mm times `scale`; the bevel turns over 20 mm deep."""
    count = round((depth + IDEAL.setup.tip_to_skin_mm) / step)
    way = step * np.arange(count + 1)
    rows = np.zeros((count, 5))
    rows[:, 0] = step
    rows[:, 3] = np.diff(1.2 * scale * (1.0 - np.cos(2.0 * np.pi * way / 50.0)))
    rows[:, 4] = np.where(np.abs(way[:-1] - IDEAL.setup.tip_to_skin_mm - 20.0) < 1e-9, 1.0, -1.0)
    return rows


def scaled(scale: float, layers: int, element: float, spacing: float):
    """The paper's phantom with one or two layers, its bevel offset times `scale`; no imperfections."""
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
    """Tip (x, y, θ) after that insertion."""
    needle = plant(scaled(scale, layers, element, spacing), **truth)
    for row in commands(scale, depth, step):
        needle.step(row)
    return move(needle).tip


@dataclass(frozen=True)
class Gap:
    """How far exact plant and controller's model are apart over an insertion."""

    angle: float  # largest of the needle's tip, rad
    aside: float  # largest distance of the tips, mm
    end: float  # the same at the end
    energy: float  # at the end, relative


def model_gap(scale: float, layers: int, *, element: float, spacing: float, step: float) -> Gap:
    """Exact plant against the controller's model: same scenario, same spacing of contacts, same commands."""
    scenario = scaled(scale, layers, element, spacing)
    rows = commands(scale, 44.5, step)
    simulator, needle = Simulator(scenario, threads=1), plant(scenario)
    state, tips = simulator.start(), []
    for row in rows:
        state = simulator.step(state, Control.from_row(row.tolist()))
        needle.step(row)
        tips.append((needle.tip, state.tip))
    move(needle)
    exact, model = np.array(tips).swapaxes(0, 1)
    apart = np.hypot(*(exact - model)[:, :2].T)
    energy = needle.strain_energy / state.strain_energy - 1.0
    return Gap(float(np.abs(exact[:, 2]).max()), float(apart.max()), float(apart[-1]), energy)


def path_curvature(resolution: float, bevel_length: float, bevel: float = 0.01) -> float:
    """κ (1/mm) over the last 6/β of a path that is 25/β deep, all sizes in `resolution` mm."""
    sizes = {"phantom.contact_spacing_mm": resolution, "phantom.element_mm": resolution}
    scenario = long_beam(250.0, spacing=resolution, bevel=bevel, bevel_length=bevel_length)
    needle = plant(scenario.with_values(PERFECT | sizes))
    tips = []
    for _ in range(round(251.0 / resolution)):
        needle.step(np.array([resolution, 0.0, 0.0, 0.0, -1.0]))
        tips.append(needle.tip)
    x, y, _ = np.array(tips).T
    last = x > 190.0
    bend, slope, _ = np.polyfit(x[last] - x[last].mean(), y[last], 2)
    return float(2.0 * bend / (1.0 + slope**2) ** 1.5)


def curvature_error(resolution: float, bevel_length: float) -> float:
    """The same relative to docs/theory.md eq. 10."""
    expected = closed_forms.steady_curvature(0.01, bevel_length, FOUNDATION, EI)
    return path_curvature(resolution, bevel_length) / expected - 1.0


# --- work and energy


def bent(withdrawn: float, friction: float = 0.0):
    """A plant that went 31.5 mm deep along a bent way and was drawn back by so much: nothing there cuts."""
    needle = plant(IDEAL.with_values({"phantom.friction_mn_per_mm": friction}))
    for k in range(240):
        move(needle, 0.25, dg_y=0.02 if k < 200 else -0.01, flip=k == 200)
    return move(needle, -withdrawn / 20, times=20)


def work(needle, *, steps: int, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0) -> tuple[float, float]:
    """(work of base and guide, change of the stored energy) over a move in so many steps, by the trapezoid rule."""
    part = np.array([db_x, db_y, db_theta, dg_y]) / steps
    energy = needle._s[rd.ENERGY]
    forces = [needle._s[_FORCES], *(move(needle, *part)._s[_FORCES] for _ in range(steps))]
    done = sum(0.5 * float((before + after) @ part) for before, after in pairwise(forces))
    return done, float(needle._s[rd.ENERGY] - energy)


def energy_balance(name: str, steps: int) -> tuple[float, float]:
    """(work, change of the stored energy) of one of MOVES, with no contact point about to grow in."""
    db_y, db_theta, dg_y = MOVES[name]
    return work(bent(3.75), steps=steps, db_y=db_y, db_theta=db_theta, dg_y=dg_y)


def friction_balance(steps: int, friction: float = 5.0) -> tuple[float, float, float]:
    """(work, change of the stored energy, dissipated) of a push by 3 mm along the channel that is there."""
    needle = bent(8.0, friction)
    move(needle, 1e-3)  # from now on it slides forward
    before = inside_length(needle)
    done, stored = work(needle, steps=steps, db_x=3.0)
    return done, stored, 1e-3 * friction * 0.5 * (inside_length(needle) ** 2 - before**2)


def inside_length(needle) -> float:
    """Arc length (mm) of the needle in the tissue."""
    x, _ = needle.nodes.T
    arc = needle.rod.segment * np.arange(x.size)
    return float(arc[-1] - np.interp(0.0, x, arc))
