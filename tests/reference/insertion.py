"""An insertion from docs/theory.md the plain way: influence functions, dense full Newton, secant for the tip.

The needle is a cantilever, and whatever touches it is a force on it. A unit force at distance b from the base
deflects it at distance a ≤ b by a²(3b − a)/6EI, and so by b²(3a − b)/6EI beyond it. That is exact, and well
conditioned for forces as close together as you like. Nothing here is shared with flexneedle.mechanics.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.simulator.control import Control

TOLERANCE_MM = 1e-11
_FLOOR = 0.3
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)  # exact to degree 5; y'² has degree 4


class Tissue(NamedTuple):
    """Contact points or pieces of the tip spring, arrays (k,): Ogden's μ (MPa) and α, h (mm), volume V (mm³)."""

    mu: np.ndarray
    alpha: np.ndarray
    h: np.ndarray
    volume: np.ndarray

    def take(self, which) -> "Tissue":
        """The chosen entries."""
        return Tissue(*(values[which] for values in self))


def ogden(tissue: Tissue, u):
    """Energy, force −dW/du and stiffness d²W/du² at the compression u (mm): equations 1 to 3, with the floor."""
    mu, alpha, h, volume = tissue
    stretch = 1.0 - np.abs(u) / h
    lam = np.maximum(stretch, _FLOOR)
    beyond = (lam - stretch) * h
    energy = volume * 2 * mu / alpha**2 * (2 * lam ** (-alpha / 2) + lam**alpha - 3)
    push = 2 * mu * volume / (alpha * h) * (lam ** (-alpha / 2 - 1) - lam ** (alpha - 1))
    stiffness = (
        2
        * mu
        * volume
        / (alpha * h**2)
        * ((alpha - 1) * lam ** (alpha - 2) + (alpha / 2 + 1) * lam ** (-alpha / 2 - 2))
    )
    energy = energy + push * beyond + stiffness * beyond**2 / 2
    return energy, -np.sign(u) * (push + stiffness * beyond), stiffness


class Loads(NamedTuple):
    """The forces (N) at the places x (mm) that hold the needle in its shape."""

    x: np.ndarray
    force: np.ndarray


class Cut(NamedTuple):
    """What a step starts from: tip pose, front of the channel, rest positions of contacts and of the tip spring."""

    tip: np.ndarray
    front: float
    rest: np.ndarray
    bevel_rest: float


@dataclass(frozen=True)
class Pose:
    """The insertion after a step; `cut` is what the step started from, `after` what the next one starts from."""

    base: np.ndarray
    guide: float
    bevel: int
    load: float
    cut: Cut
    after: Cut
    y: np.ndarray  # of the contacts that the tip has passed
    loads: Loads
    guide_force: float
    tip_force: float
    energy: float
    strain_energy: float

    @property
    def tip(self) -> np.ndarray:
        """x, y, θ."""
        return self.after.tip


class _Trial(NamedTuple):
    """Equilibrium for a given x of the tip."""

    y: np.ndarray
    y_tip: float
    rest: np.ndarray
    bevel_rest: float
    loads: Loads
    reactions: np.ndarray
    tissue_energy: np.ndarray
    spring_energy: float


@dataclass
class Reference:
    """The needle of a scenario in its tissue."""

    scenario: Scenario
    stiffness: float = field(init=False)
    x: np.ndarray = field(init=False)
    length: np.ndarray = field(init=False)
    tissue: Tissue = field(init=False)
    weight: np.ndarray = field(init=False)

    def __post_init__(self):
        needle, layers = self.scenario.needle, self.scenario.tissue
        d, bore = needle.outer_diameter, needle.inner_diameter
        self.stiffness = needle.youngs_modulus * np.pi * (d**4 - bore**4) / 64
        self.ends = np.append(np.cumsum([layer.thickness_mm for layer in layers[:-1]]), np.inf)
        edges = _interval_edges(self.scenario, self.ends)
        self.length = np.diff(edges)
        self.x = edges[:-1] + self.length / 2
        kind = np.array([int((depth > self.ends).sum()) for depth in self.x])
        self.laws = Tissue(*(np.array(column) for column in zip(*map(_law_per_mm, layers), strict=True)))
        law = self.laws.take(kind)
        self.tissue = law._replace(volume=law.volume * self.length)
        self.weight = np.array([layer.energy_weight for layer in layers])[kind]

    def start(self, bevel: int = 1) -> Pose:
        """The straight needle in air."""
        setup, needle = self.scenario.setup, self.scenario.needle
        base = np.array([-setup.tip_to_skin_mm - needle.length_mm, 0.0, 0.0])
        tip = np.array([-setup.tip_to_skin_mm, 0.0, 0.0])
        cut = Cut(tip, 0.0, np.zeros(self.x.size), 0.0)
        nothing = np.zeros(0)
        pose = Pose(base, 0.0, bevel, 0.0, cut, cut, nothing, Loads(nothing, nothing), 0.0, 0.0, 0.0, 0.0)
        return self._solve(pose, cut)

    def step(self, pose: Pose, control: Control) -> Pose:
        """One control step, in parts that end where the tip is due at multiples of Δ/4 down to 3Δ."""
        part, left = self.scenario.contact.spacing_mm / 4, 1.0
        while left > 0.0:
            x, share = pose.tip[0], left
            if control.db_x > 0.0 and x < 12 * part and x + left * control.db_x > 0.0:
                due = max(0.0, part * (np.floor(x / part + 1e-3) + 1))
                share = min(left, (due - x) / control.db_x)
            pose = self._move(
                pose,
                Control(
                    share * control.db_x,
                    share * control.db_y,
                    share * control.db_theta,
                    share * control.dg_y,
                    control.flip and left == 1.0,
                ),
            )
            left -= share if share < left else left
        return pose

    def _move(self, pose: Pose, control: Control) -> Pose:
        moved = replace(
            pose,
            base=np.add(pose.base, [control.db_x, control.db_y, control.db_theta]),
            guide=pose.guide + control.dg_y,
            bevel=-pose.bevel if control.flip else pose.bevel,
        )
        return self._solve(moved, pose.after)

    def hold(self, pose: Pose, tip_y: float, points=()) -> Pose:
        """The last step again, with the tip held at tip_y and the needle at further (x, y)."""
        return self._solve(pose, pose.cut, held=tip_y, points=tuple(points))

    def curve(self, pose: Pose, x):
        """y, θ and arc length from the base at places x (mm) along the needle."""
        y, turn = self._shape(pose.base, pose.loads, np.asarray(x, dtype=float))
        return (
            y,
            turn,
            np.array([self._integrals(pose.base, pose.loads, end)[0] for end in x]) + (x - pose.base[0]),
        )

    def _solve(self, pose: Pose, cut: Cut, held=None, points=()) -> Pose:
        """Find x_t = b_x + L − s by the secant rule."""
        straight = pose.base[0] + self.scenario.needle.length_mm
        at = straight - self._integrals(pose.base, pose.loads, np.inf)[0] if pose.loads.x.size else straight
        guess, last = pose, None
        for _ in range(100):
            trial = self._equilibrium(guess, cut, at, held, points)
            short, beam_energy = self._integrals(pose.base, trial.loads, at)
            miss = straight - short - at
            if abs(miss) < TOLERANCE_MM:
                return self._finish(pose, cut, trial, at, beam_energy, held)
            slope = -1.0 if last is None or last[0] == at else (miss - last[1]) / (at - last[0])
            last = at, miss
            at -= miss / (slope if -2.0 < slope < -0.5 else -1.0)
        raise ArithmeticError(f"no tip position found: off by {miss} mm")

    def _equilibrium(self, pose: Pose, cut: Cut, tip_x: float, held, points) -> _Trial:
        """Newton's method on y = (free needle) + C F(y) for the contacts behind tip_x and the tip."""
        count = int((self.x < tip_x).sum())
        x = np.append(self.x[:count], tip_x)
        fixed_x, fixed_y = _essential(self.scenario.setup.guide_x, pose.guide, points, tip_x, held)
        influence = self._influence(pose.base, x, x)
        of_fixed = self._influence(pose.base, x, fixed_x)
        among_fixed = self._influence(pose.base, fixed_x, fixed_x)
        free, free_fixed = (pose.base[1] + pose.base[2] * (a - pose.base[0]) for a in (x, fixed_x))
        touch = _Touch(self, cut, pose, tip_x, count)
        y = self._shape(pose.base, pose.loads, x)[0]
        reactions = np.zeros(fixed_x.size)
        for _ in range(200):
            u, force, slope = touch.forces(y)
            residual = y - free - influence @ force - of_fixed @ reactions
            miss = fixed_y - free_fixed - of_fixed.T @ force - among_fixed @ reactions
            matrix = np.block(
                [[np.eye(count + 1) - influence @ slope, -of_fixed], [of_fixed.T @ slope, among_fixed]]
            )
            change = np.linalg.solve(matrix, np.concatenate([-residual, miss]))
            share = touch.largest_share(u, y, change[: count + 1])
            y = y + share * change[: count + 1]
            reactions = reactions + share * change[count + 1 :]
            if np.abs(change[: count + 1]).max() < TOLERANCE_MM / 10:
                return touch.result(y, x, fixed_x, reactions)
        raise ArithmeticError("no equilibrium found")

    def _finish(self, pose: Pose, cut: Cut, trial: _Trial, tip_x: float, beam_energy: float, held) -> Pose:
        turn = float(self._shape(pose.base, trial.loads, np.array([tip_x]))[1][0])
        tip = np.array([tip_x, trial.y_tip, turn])
        count = trial.y.size
        if tip_x > 0.0:
            rest = np.append(trial.rest, cut.rest[count:])
            after = Cut(tip, max(cut.front, tip_x), rest, trial.bevel_rest)
        else:
            after = Cut(tip, 0.0, np.zeros(self.x.size), 0.0)
        guide_x = self.scenario.setup.guide_x
        guided = guide_x is not None and guide_x < tip_x
        return replace(
            pose,
            cut=cut,
            after=after,
            y=trial.y,
            loads=trial.loads,
            guide_force=float(trial.reactions[0]) if guided else 0.0,
            tip_force=float(trial.reactions[-1]) if held is not None else 0.0,
            energy=float(beam_energy + trial.tissue_energy.sum() + trial.spring_energy),
            strain_energy=float(self.weight[:count] @ trial.tissue_energy),
        )

    def _influence(self, base, x, of):
        """Deflection at x of unit forces at `of`."""
        a, b = x[:, None] - base[0], of[None, :] - base[0]
        return np.where(a < b, a**2 * (3 * b - a), b**2 * (3 * a - b)) / (6 * self.stiffness)

    def _shape(self, base, loads: Loads, x):
        """y and θ at x."""
        s, b = (x - base[0])[:, None], (loads.x - base[0])[None, :]
        y = base[1] + base[2] * (x - base[0]) + self._influence(base, x, loads.x) @ loads.force
        turn = np.where(s < b, s * (2 * b - s), b**2) / (2 * self.stiffness)
        return y, base[2] + turn @ loads.force

    def _integrals(self, base, loads: Loads, end: float):
        """½∫y'² dx and ½∫M²/EI dx from the base to `end`, or to the last force."""
        breaks = np.unique(np.concatenate([[base[0]], loads.x, [] if np.isinf(end) else [end]]))
        breaks = breaks[breaks <= end]
        left, half = breaks[:-1, None], np.diff(breaks)[:, None] / 2
        x = (left + half * (1 + _GAUSS_X)).ravel()
        share = (half * _GAUSS_W).ravel()
        turn = self._shape(base, loads, x)[1]
        moment = np.maximum(loads.x[None, :] - x[:, None], 0.0) @ loads.force
        return share @ turn**2 / 2, share @ moment**2 / (2 * self.stiffness)


class _Touch:
    """Forces of contacts and tip spring on the needle for a tip at tip_x, as functions of y (equations 4, 8, 9)."""

    def __init__(self, reference: Reference, cut: Cut, pose: Pose, tip_x: float, count: int):
        bevel = reference.scenario.needle.bevel
        x0, y0, turn0 = cut.tip
        x, self.count, self.load, self.tip_x = reference.x[:count], count, pose.load, tip_x
        self.tissue = reference.tissue.take(slice(count))
        self.ramp = np.minimum(1.0, (tip_x - x) / (reference.length[:count] / 2))
        new = x > cut.front
        self.along = np.where(new, (x - x0) / (tip_x - x0) if new.any() else 0.0, 0.0)
        self.rest = np.where(new, (1.0 - self.along) * y0, cut.rest[:count])
        self.cuts = tip_x - cut.front
        front = max(cut.front, tip_x)
        self.pieces = _spring(reference, max(0.0, front - bevel.length_mm), tip_x)
        self.bevel_rest, self.follow = cut.bevel_rest, 0.0
        if self.cuts > 0.0:
            decay = np.exp(-self.cuts / bevel.length_mm)
            g = -bevel.length_mm * np.expm1(-self.cuts / bevel.length_mm) / self.cuts
            b = pose.bevel * bevel.offset_mm
            y_front = y0 + turn0 * (cut.front - x0)
            q = cut.bevel_rest - y_front - b if cut.front > 0.0 else 0.0
            line = y_front + turn0 * self.cuts
            self.bevel_rest, self.follow = line + b + q * decay - (1 - g) * line, 1 - g

    def forces(self, y):
        """Compressions (of contacts and tip), forces and their derivatives (k + 1, k + 1)."""
        u = np.append(y[:-1] - self.rest - self.along * y[-1], y[-1] * (1 - self.follow) - self.bevel_rest)
        _, force, stiffness = ogden(self.tissue, u[:-1])
        _, tip_force, tip_stiffness = ogden(self.pieces, u[-1])
        slope = np.diag(np.append(-self.ramp * stiffness, -tip_stiffness.sum() * (1 - self.follow)))
        slope[:-1, -1] += self.ramp * stiffness * self.along
        return u, np.append(self.ramp * force, tip_force.sum() + self.load), slope

    def largest_share(self, u, y, change) -> float:
        """How much of a change takes at most half of any remaining stretch."""
        heights = np.append(self.tissue.h, self.pieces.h.min(initial=np.inf))
        after = self.forces(y + change)[0]
        room = np.maximum(1.0 - np.abs(u) / heights, 0.1) * heights / 2
        return float(min(1.0, (room / np.maximum(np.abs(after - u), 1e-300)).min()))

    def result(self, y, x, fixed_x, reactions) -> _Trial:
        """Collect what equilibrium at y means."""
        u, force, _ = self.forces(y)
        return _Trial(
            y[:-1],
            float(y[-1]),
            self.rest + self.along * y[-1],
            float(self.bevel_rest + self.follow * y[-1]),
            Loads(np.append(x, fixed_x), np.append(force, reactions)),
            reactions,
            self.ramp * ogden(self.tissue, u[:-1])[0],
            float(ogden(self.pieces, u[-1])[0].sum()),
        )


def _law_per_mm(layer):
    height, width = layer.compression_length_mm, layer.engaged_width_mm
    return 1e-3 * layer.shear_modulus_kpa, layer.alpha, height, width * height


def _interval_edges(scenario: Scenario, ends):
    """Edges of the intervals of length Δ, shorter below the skin, divided where a layer ends."""
    spacing = scenario.contact.spacing_mm
    depth = scenario.setup.stroke_mm - scenario.setup.tip_to_skin_mm
    count = max(int(np.ceil(max(depth, 0.0) / spacing)), 3) + 2
    grid = spacing * np.concatenate([[0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5], np.arange(3, count)])
    inside = [end for end in ends if end < grid[-1] and np.abs(grid - end).min() > 1e-6 * spacing]
    return np.sort(np.append(grid, inside))


def _essential(guide_x, guide_y, points, tip_x, held):
    """Places and values that are prescribed: guide first, held tip last."""
    pairs = [(guide_x, guide_y)] if guide_x is not None and guide_x < tip_x else []
    pairs += [tuple(point) for point in points]
    pairs += [] if held is None else [(tip_x, held)]
    x, y = np.array(pairs, dtype=float).reshape(-1, 2).T
    return x, y


def _spring(reference: Reference, start: float, end: float) -> Tissue:
    """The tip spring: the length of each layer between `start` and `end`."""
    tops = np.append(0.0, reference.ends[:-1])
    length = np.clip(np.minimum(reference.ends, end) - np.maximum(tops, start), 0.0, None)
    return reference.laws._replace(volume=reference.laws.volume * length)
