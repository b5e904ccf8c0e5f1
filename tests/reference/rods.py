"""Rods for the tests of `phantom.rod`: on a bench, the plant of a scenario, and a second solver of that plant."""

import math

import numpy as np

from flexneedle import Control, load_scenario
from flexneedle.mechanics.law import tables
from flexneedle.phantom import rod as rd
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.equilibrium import step
from flexneedle.phantom.plants import ExactPlant
from flexneedle.scenario.tissue.ogden import Ogden
from flexneedle.types import THETA, X, Y

ZEROS = (
    "shear_modulus_variation",
    "layer_shift_sd_mm",
    "start_offset_sd_mm",
    "start_angle_sd_mrad",
    "start_axial_sd_mm",
    "youngs_modulus_variation",
    "initial_bend_mm",
    "run_out_mm",
    "guide_clearance_mm",
    "friction_mn_per_mm",
    "rotation_friction_mn",
    "motor_resolution_mm",
    "delay_periods",
    "missing_fraction",
    "tracker_bias_mm",
)
PERFECT = {
    "phantom.shear_modulus_factor": [1.0, 1.0],
    "phantom.bevel_factor": [1.0, 1.0],
    **{f"phantom.{key}": 0.0 for key in ZEROS},
}
"""Changes that remove all imperfections of a rig."""

GUIDE_N_PER_MM = 1e3

IDEAL = load_scenario("phantom").with_values(PERFECT)

_ON_A_BENCH = {
    "stiffness": 1000.0,
    "torsion": 770.0,
    "curvature": 0.0,
    "curvature_across": 0.0,
    "bevel_offset": 0.0,
    "bevel_length": 1.0,
    "guide_x": math.nan,
    "clearance": 0.0,
    "guide_stiffness": 1e3,
    "friction": 0.0,
    "rotation_friction": 0.0,
    "spacing": 0.5,
    "cell": 1.0,
    "laws": tables(
        [Ogden(alpha=6.0, shear_modulus_kpa=1.0, compression_length_mm=20.0, engaged_width_mm=1.0)]
    ),
    "law": np.array([0]),
    "channel_law": np.array([0]),
    "height": np.array([20.0]),
    "foundation": np.array([0.0]),
    "weight": np.array([1.0]),
}


class Bench:
    """A rod of EI = 1000 N·mm² far from tissue, with all its parts accessible; it steps in place."""

    def __init__(
        self,
        length=100.0,
        segments=64,
        base=(-1000.0, 0.0, 0.0),
        roll=0.0,
        tilt=None,
        points=400,
        **constants,
    ):
        self.rod = rd.Rod(**{**_ON_A_BENCH, "segment": length / segments, **constants})
        x, y, turn = base
        self.s, self.segments = rd.start((x, y, 0.0), tilt or (turn, 0.0), length, segments, roll)
        self.channel, self.count = np.zeros(points, rd.POINT), 0

    def step(self, **columns):
        """Move and settle."""
        row = np.array(Control(**columns))
        self.count = step(self.rod, self.s, self.segments, self.channel, self.count, row)
        return self

    def loaded(self, x=0.0, y=0.0, z=0.0):
        """Apply a dead load (N) at the tip, and settle."""
        self.s["load"] = x, y, z
        return self.step()

    @property
    def converged(self):
        return self.s["converged"] > 0.0

    @property
    def tip(self):
        """x, y, θ; position relative to the base."""
        (x, y, _), t = self.s["tip"] - self.s["base"], self.s["tangent"]
        return np.array([x, y, math.atan2(t[1], t[0])])

    @property
    def nodes(self):
        """(N + 1, 3) relative to the base."""
        return self.segments["node"] - self.s["base"]

    @property
    def turns(self):
        """Angles (N,) of the segments in the plane."""
        x, y, _ = self.segments["tangent"][:-1].T
        return np.arctan2(y, x)


def plant(scenario=IDEAL, *, roll=0.0, cell=None, **truth):
    """Return the exact plant of a scenario; `truth` are fields of `Truth`."""
    cell = 0.5 * scenario.phantom.contact_spacing_mm if cell is None else cell
    return ExactPlant(Truth(scenario, cell_mm=cell, **truth), roll)


def move(plant, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0, flip=False, times=1):
    """Step a plant `times` times; a step without equilibrium is an error of the test."""
    for _ in range(times):
        plant.step(np.array(Control(db_x, db_y=db_y, db_theta=db_theta, dg_y=dg_y, flip=flip)))
    if not plant.converged:
        raise ValueError(f"residual {plant.state['residual']:.3g} mm")
    return plant


def planar(pose):
    """Return x, y, θ of a pose."""
    return pose[[X, Y, THETA]]


class Shooting:
    """Section 11 of docs/theory.md the plain way: the continuous rod, integrated from its tip to its base.

    Forces in balance replace a minimum of energy, and the rule of Runge and Kutta the segments; a search for the pose
    of the tip brings the far end to the clamp. Nothing is shared with `phantom.rod` but the section's definition of a
    step. `points`: of the channel, [x, y] in the order of cutting.
    """

    def __init__(self, truth: Truth, bevel=1):
        scenario = truth.scenario
        self.truth, self.scenario, self.bevel = truth, scenario, bevel
        needle = scenario.needle
        self.stiffness = needle.youngs_modulus * np.pi * needle.outer_diameter**4 / 64
        self.curvature = 2.0 * truth.bend / needle.length_mm**2  # an arc with this deflection
        self.base = np.array([scenario.start_base_x, truth.base_y, truth.base_turn])
        self.guide, self.slide, self.eta, self.cut = 0.0, 0.0, 0.0, 0.0
        self.points, self.front = [], np.zeros(3)
        along = np.array([math.cos(truth.base_turn), math.sin(truth.base_turn), 0.0])
        self.tip = self.base + needle.length_mm * along
        self.guide_force = np.zeros(1)
        self.step()

    def step(self, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0, flip=False):
        """Move, find the tip, cut."""
        self.base = np.add(self.base, [db_x, db_y, db_theta])
        self.guide += dg_y
        self.bevel *= -1 if flip else 1
        self.slide = math.copysign(1.0, db_x) if db_x else self.slide
        guess = np.append(np.add(self.tip, [db_x, 0.0, 0.0]), self.guide_force)
        tip, self.guide_force = np.split(self._settled(guess), [3])
        self.eta = self._new_eta(tip)
        self._lay(tip)
        self.tip = tip
        return self

    def _settled(self, z):
        """Return pose of the tip and force of the guide (4,): Newton's method with differences, at most 1 at a time."""
        for _ in range(60):
            miss = self._shoot(z)
            if np.abs(miss).max() < 1e-10:
                return z
            columns = [(self._shoot(z + shift) - miss) / 1e-7 for shift in 1e-7 * np.eye(4)]
            move = -np.linalg.solve(np.array(columns).T, miss)
            z = z + move / max(1.0, np.abs(move).max())
        raise ArithmeticError(f"no equilibrium found: off by {miss}")

    def _shoot(self, z):
        """Return the distance of the far end from the clamp (x, y, θ), and of the needle from its guide."""
        tip, force, at_guide = z[:3], z[3], z[3]
        setup, needle = self.scenario.setup, self.scenario.needle
        pull = self.scenario.phantom.friction * self.slide
        end = _End(tip, self._bevel_force(tip), self.stiffness, self.curvature * self.bevel)
        turned = np.array([math.cos(tip[2]), math.sin(tip[2])])
        for point in reversed(self.points):
            behind = float((tip[:2] - point) @ turned)
            if behind > 0.0:
                end.back_to(lambda end, at=point: end.along(at), pull)
                u = end.across(point)
                end.push(-min(1.0, 2.0 * behind / self._spacing) * self._force(point[0], self._spacing, u))
        if end.x > 0.0:
            end.back_to(lambda end: end.x / math.cos(end.turn), pull)
        if setup.guide_x is not None and end.x > setup.guide_x:
            end.back_to(lambda end: (end.x - setup.guide_x) / math.cos(end.turn), 0.0)
            at_guide = self._guide_miss(end.y - self.guide, force)
            end.push(force / math.cos(end.turn))
        end.back_to(lambda end: needle.length_mm - end.passed, 0.0)
        return np.array([*(end.x, end.y, end.turn) - self.base, at_guide])

    def _guide_miss(self, off, force):
        """Return 0 where the needle is free within the clearance, or beyond it by force/stiffness (mm)."""
        clearance, reach = self.scenario.phantom.guide_clearance_mm, off + force / GUIDE_N_PER_MM
        return reach - np.clip(reach - 0.1 * force, -clearance, clearance)

    @property
    def _spacing(self):
        return self.scenario.phantom.contact_spacing_mm

    def _force(self, depth, length, u):
        """Return dW/du (N) of a length (mm) of needle at a depth: docs/theory.md eq. 2, and its line below λ = 0.3."""
        cell = int(depth / self.truth.cell_mm)
        middle = (cell + 0.5) * self.truth.cell_mm
        tops = self.scenario.layer_tops
        layer = self.scenario.tissue[max(k for k, top in enumerate(tops) if top <= middle)]
        mu = 1e-3 * layer.shear_modulus_kpa * self.truth.variation[min(cell, len(self.truth.variation) - 1)]
        a, h = layer.alpha, layer.compression_length_mm
        lam = max(0.3, 1.0 - abs(u) / h)
        scale = 2.0 * mu * length * layer.engaged_width_mm / a
        push = scale * (lam ** (-a / 2 - 1) - lam ** (a - 1))
        slope = scale / h * ((a / 2 + 1) * lam ** (-a / 2 - 2) + (a - 1) * lam ** (a - 2))
        push += slope * (abs(u) - (1.0 - lam) * h)
        return math.copysign(push, u)

    def _progress(self, tip):
        """Return the length cut by a step that ends with this tip (mm), negative if pulled back."""
        if not self.cut:
            return tip[0] / math.cos(tip[2])
        return float((tip - self.front)[:2] @ [math.cos(self.front[2]), math.sin(self.front[2])])

    def _new_eta(self, tip):
        """Return the offset of the bevel's rest point from the tip, across it; docs/theory.md eq. 14."""
        turn = 0.5 * (self.tip[2] + tip[2])
        drift = float((tip - self.tip)[:2] @ [-math.sin(turn), math.cos(turn)])
        way, bevel = self._progress(tip), self.scenario.needle.bevel
        if tip[0] <= 0.0:
            return 0.0
        if way <= 0.0:
            return self.eta - drift
        wanted = self.bevel * bevel.offset_mm
        eta = self.eta if self.cut else wanted
        steady = wanted - drift * bevel.length_mm / way
        return steady + (eta - steady) * math.exp(-way / bevel.length_mm)

    def _bevel_force(self, tip):
        """Return the force on the tip (2,)."""
        if tip[0] <= 0.0:
            return np.zeros(2)
        turn, cell, u = tip[2], self.truth.cell_mm, -self._new_eta(tip)
        ahead = max(0.0, -self._progress(tip))
        top = max(0.0, tip[0] - (self.scenario.needle.bevel.length_mm - ahead) * math.cos(turn))
        if top >= tip[0]:
            return np.zeros(2)
        inside = cell * np.arange(math.floor(top / cell) + 1, math.ceil(tip[0] / cell))
        edges = np.array([top, *inside, tip[0]])
        lengths = np.diff(edges) / math.cos(turn)
        force = sum(self._force(x, length, u) for x, length in zip(edges[:-1] + 1e-9, lengths, strict=True))
        return -force * np.array([-math.sin(turn), math.cos(turn)])

    def _lay(self, tip):
        """Add points to the channel, evenly along the path, from the front (at first: the skin) to the tip."""
        way = self._progress(tip)
        if tip[0] <= 0.0:
            self.points, self.cut, self.eta = [], 0.0, 0.0
        elif way > 0.0:
            start = self.front[:2] if self.cut else np.array([0.0, tip[1] - tip[0] * math.tan(tip[2])])
            while (len(self.points) + 0.5) * self._spacing < self.cut + way:
                share = ((len(self.points) + 0.5) * self._spacing - self.cut) / way
                self.points.append(start + share * (tip[:2] - start))
            self.cut += way
            self.front = np.array(tip)


class _End:
    """The cut end of a needle: position, slope, and the force and moment of all beyond it."""

    def __init__(self, tip, force, stiffness, curvature):
        self.x, self.y, self.turn = map(float, tip)
        self.fx, self.fy = map(float, force)
        self.stiffness, self.curvature, self.moment, self.passed = stiffness, curvature, 0.0, 0.0

    def along(self, point):
        """Return the distance ahead of a point, along the needle."""
        return (self.x - point[0]) * math.cos(self.turn) + (self.y - point[1]) * math.sin(self.turn)

    def across(self, point):
        """Return the distance to the left of a point."""
        return (self.y - point[1]) * math.cos(self.turn) - (self.x - point[0]) * math.sin(self.turn)

    def push(self, force):
        """Add a force across the needle."""
        self.fx -= force * math.sin(self.turn)
        self.fy += force * math.cos(self.turn)

    def back_to(self, left, pull):
        """Go back until `left` of this end is 0, with friction at each mm."""
        for _ in range(60):
            way = left(self)
            if abs(way) < 1e-12:
                return
            self._back(min(way, 5.0), pull)
        raise ArithmeticError(f"{left(self)} mm left")

    def _back(self, way, pull):
        """Apply the rule of Runge and Kutta to dx = cos θ ds, dy = sin θ ds, dθ = (κ₀ + M/EI) ds, dM = −τ × F ds."""

        def slopes(x, y, turn, moment):
            fx, fy = self.fx - pull * (self.x - x), self.fy - pull * (self.y - y)
            c, s = math.cos(turn), math.sin(turn)
            return -c, -s, -self.curvature - moment / self.stiffness, c * fy - s * fx

        def ahead(part, slope):
            return tuple(value + part * change for value, change in zip(z, slope, strict=True))

        z = self.x, self.y, self.turn, self.moment
        a = slopes(*z)
        b = slopes(*ahead(0.5 * way, a))
        c = slopes(*ahead(0.5 * way, b))
        d = slopes(*ahead(way, c))
        mean = [(p + 2.0 * q + 2.0 * r + s) / 6.0 for p, q, r, s in zip(a, b, c, d, strict=True)]
        x, y, self.turn, self.moment = ahead(way, mean)
        self.fx, self.fy = self.fx - pull * (self.x - x), self.fy - pull * (self.y - y)
        self.x, self.y, self.passed = x, y, self.passed + way
