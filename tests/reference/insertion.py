"""An insertion from docs/theory.md the plain way: influence functions, dense full Newton, secant for the tip.

The needle is a cantilever, and each contact is a force on it. A unit force at distance b from the base
deflects it at distance a ≤ b by a²(3b − a)/6EI, and so by b²(3a − b)/6EI beyond it. That is exact, and well
conditioned for forces as close together as you like. Nothing here is shared with flexneedle.mechanics.

Laterally, numbers are y + iz; the plane is the case z = 0. The unknowns of Newton's method are the y of all places,
then their z: each contact has its true tangent, two by two.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.types import ROLL, Control
from reference.ogden import Tissue, ogden

TOLERANCE_MM = 1e-11
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)  # exact to degree 5; |y'|² has degree 4
_SPIN_X, _SPIN_W = np.polynomial.legendre.leggauss(64)  # for some turns of the bevel


class End(NamedTuple):
    """An end of the needle: position x and y + iz (mm), slope θ + iψ."""

    x: float
    y: complex
    turn: complex

    @property
    def row(self) -> np.ndarray:
        """x, y, z, θ, ψ."""
        return np.array([self.x, self.y.real, self.y.imag, self.turn.real, self.turn.imag])


class Loads(NamedTuple):
    """The forces (N) at the places x (mm) that hold the needle in its shape."""

    x: np.ndarray
    force: np.ndarray


class Cut(NamedTuple):
    """Start of a step: tip, front of the channel, rest positions of contacts and of the tip spring.

    spin: angle (rad) by which the bevel turns in the step.
    """

    tip: End
    front: float
    rest: np.ndarray
    bevel_rest: complex
    spin: float = 0.0


@dataclass(frozen=True)
class Pose:
    """The insertion after a step; `cut` is its start, `after` the start of the next step."""

    base: End
    guide: complex
    bevel: complex
    load: complex
    cut: Cut
    after: Cut
    y: np.ndarray  # of the contacts that the tip has passed
    loads: Loads
    guide_force: complex
    tip_force: complex
    energy: float
    strain_energy: float

    @property
    def tip(self) -> End:
        """The tip after the step, from which the next one starts."""
        return self.after.tip


class _Trial(NamedTuple):
    """Equilibrium for a given x of the tip."""

    y: np.ndarray
    y_tip: complex
    rest: np.ndarray
    bevel_rest: complex
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

    def start(self, roll: float = 0.0) -> Pose:
        """Return the straight needle in air, on the line of its entry, rolled (rad)."""
        setup, entry = self.scenario.setup, self.scenario.entry
        offset = entry.lateral_mm + 1j * entry.lateral_z_mm
        slope = 1e-3 * (entry.slope_mrad + 1j * entry.slope_z_mrad)
        tip_x = -setup.tip_to_skin_mm
        base, tip = (
            End(x, offset + slope * x, slope) for x in (tip_x - self.scenario.needle.length_mm, tip_x)
        )
        guide = offset - slope * setup.guide_to_skin_mm if setup.has_guide else 0.0
        cut = Cut(tip, 0.0, np.zeros(self.x.size, complex), 0.0)
        nothing = np.zeros(0)
        bevel = np.exp(1j * roll)
        pose = Pose(base, guide, bevel, 0.0, cut, cut, nothing, Loads(nothing, nothing), 0.0, 0.0, 0.0, 0.0)
        return self._solve(pose, cut)

    def step(self, pose: Pose, control: Control) -> Pose:
        """Take a control step, in parts that end where the tip is due at multiples of Δ/4 down to 3Δ."""
        part, left = self.scenario.contact.spacing_mm / 4, 1.0
        while left > 0.0:
            x, share = pose.tip.x, left
            if control.db_x > 0.0 and x < 12 * part and x + left * control.db_x > 0.0:
                due = max(0.0, part * (np.floor(x / part + 1e-3) + 1))
                share = min(left, (due - x) / control.db_x)
            row = share * np.array(control)
            row[ROLL] = control.roll if left == 1.0 else 0.0
            pose = self._move(pose, Control.of(row))
            left -= share if share < left else left
        return pose

    def _move(self, pose: Pose, control: Control) -> Pose:
        base, entry = pose.base, self.scenario.entry
        along = 1e-3 * (entry.slope_mrad + 1j * entry.slope_z_mrad)
        moved = replace(
            pose,
            base=End(
                base.x + control.db_x,
                base.y + along * control.db_x + control.db_y + 1j * control.db_z,
                base.turn + control.db_theta + 1j * control.db_psi,
            ),
            guide=pose.guide + control.dg_y + 1j * control.dg_z,
            bevel=pose.bevel * np.exp(1j * (control.roll + control.spin)),
        )
        return self._solve(moved, pose.after._replace(spin=control.spin))

    def hold(self, pose: Pose, tip: Sequence[float], points: Sequence[Sequence[float]] = ()) -> Pose:
        """Solve the last step again, with the tip held at y (, z) of a point, and the needle at others."""
        return self._solve(pose, pose.cut, held=complex(*tip[1:]), points=points)

    def curve(self, pose: Pose, x):
        """Return lateral position, slope, and arc length from the base at positions x (mm) along the needle."""
        y, turn = self._shape(pose.base, pose.loads, np.asarray(x, dtype=float))
        return (
            y,
            turn,
            np.array([self._integrals(pose.base, pose.loads, end)[0] for end in x]) + (x - pose.base.x),
        )

    def _solve(self, pose: Pose, cut: Cut, held=None, points=()) -> Pose:
        """Find x_t = b_x + L − s by the secant rule."""
        straight = pose.base.x + self.scenario.needle.length_mm
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
        free, free_fixed = (pose.base.y + pose.base.turn * (a - pose.base.x) for a in (x, fixed_x))
        touch = _Touch(self, cut, pose, tip_x, count)
        y = self._shape(pose.base, pose.loads, x)[0]
        reactions = np.zeros(fixed_x.size, complex)
        for _ in range(200):
            u, force = touch.forces(y)
            residual = y - free - influence @ force - of_fixed @ reactions
            miss = fixed_y - free_fixed - of_fixed.T @ force - among_fixed @ reactions
            slope = touch.slope(u)
            matrix = np.block(
                [
                    [np.eye(2 * count + 2) - _on_both(influence) @ slope, -_on_both(of_fixed)],
                    [_on_both(of_fixed.T) @ slope, _on_both(among_fixed)],
                ]
            )
            change = np.linalg.solve(matrix, np.concatenate([_parts(-residual), _parts(miss)]))
            dy, more = _joined(change[: 2 * count + 2]), _joined(change[2 * count + 2 :])
            share = touch.largest_share(u, y, dy)
            y = y + share * dy
            reactions = reactions + share * more
            if np.abs(dy).max() < TOLERANCE_MM / 10:
                return touch.result(y, x, fixed_x, reactions)
        raise ArithmeticError("no equilibrium found")

    def _finish(self, pose: Pose, cut: Cut, trial: _Trial, tip_x: float, beam_energy: float, held) -> Pose:
        tip = End(tip_x, trial.y_tip, complex(self._shape(pose.base, trial.loads, np.array([tip_x]))[1][0]))
        count = trial.y.size
        if tip_x > 0.0:
            rest = np.append(trial.rest, cut.rest[count:])
            after = Cut(tip, max(cut.front, tip_x), rest, trial.bevel_rest)
        else:
            after = Cut(tip, 0.0, np.zeros(self.x.size, complex), 0.0)
        guide_x = self.scenario.setup.guide_x
        guided = guide_x is not None and guide_x < tip_x
        return replace(
            pose,
            cut=cut,
            after=after,
            y=trial.y,
            loads=trial.loads,
            guide_force=complex(trial.reactions[0]) if guided else 0.0,
            tip_force=complex(trial.reactions[-1]) if held is not None else 0.0,
            energy=float(beam_energy + trial.tissue_energy.sum() + trial.spring_energy),
            strain_energy=float(self.weight[:count] @ trial.tissue_energy),
        )

    def _influence(self, base, x, of):
        """Return the deflection at x of unit forces at `of`."""
        a, b = x[:, None] - base.x, of[None, :] - base.x
        return np.where(a < b, a**2 * (3 * b - a), b**2 * (3 * a - b)) / (6 * self.stiffness)

    def _shape(self, base, loads: Loads, x):
        """Return lateral position and slope at x."""
        s, b = (x - base.x)[:, None], (loads.x - base.x)[None, :]
        y = base.y + base.turn * (x - base.x) + self._influence(base, x, loads.x) @ loads.force
        turn = np.where(s < b, s * (2 * b - s), b**2) / (2 * self.stiffness)
        return y, base.turn + turn @ loads.force

    def _integrals(self, base, loads: Loads, end: float):
        """Return ½∫|y'|² dx and ½∫|M|²/EI dx from the base to `end`, or to the last force."""
        breaks = np.unique(np.concatenate([[base.x], loads.x, [] if np.isinf(end) else [end]]))
        breaks = breaks[breaks <= end]
        left, half = breaks[:-1, None], np.diff(breaks)[:, None] / 2
        x = (left + half * (1 + _GAUSS_X)).ravel()
        share = (half * _GAUSS_W).ravel()
        turn = self._shape(base, loads, x)[1]
        moment = np.maximum(loads.x[None, :] - x[:, None], 0.0) @ loads.force
        return share @ np.abs(turn) ** 2 / 2, share @ np.abs(moment) ** 2 / (2 * self.stiffness)


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
            y_front = y0 + turn0 * (cut.front - x0)
            line = y_front + turn0 * self.cuts
            rate = cut.spin / (tip_x - x0)
            offset, gained = _offsets(bevel.offset_mm * pose.bevel, rate, bevel.length_mm, self.cuts)
            q = cut.bevel_rest - y_front if cut.front > 0.0 else offset
            self.bevel_rest, self.follow = line + q * decay + gained - (1 - g) * line, 1 - g
        self.compressing = np.eye(count + 1)
        self.compressing[:-1, -1] = -self.along
        self.compressing[-1, -1] = 1 - self.follow

    def forces(self, y):
        """Return compressions of contacts and tip, and forces."""
        u = self.compressing @ y - np.append(self.rest, self.bevel_rest)
        force, tip_force = ogden(self.tissue, u[:-1]).force, ogden(self.pieces, u[-1]).force
        return u, np.append(self.ramp * force, tip_force.sum() + self.load)

    def slope(self, u):
        """Return derivatives of the forces by y and z: −(c_t I + (c_r − c_t) n nᵀ) of each compression."""
        contacts, tip = ogden(self.tissue, u[:-1]), ogden(self.pieces, u[-1])
        along = np.append(self.ramp * contacts.along, tip.along.sum())
        across = np.append(self.ramp * contacts.across, tip.across.sum())
        n, more = np.sign(u), along - across
        yy, yz, zz = across + more * n.real**2, more * n.real * n.imag, across + more * n.imag**2
        tangents = np.block([[np.diag(yy), np.diag(yz)], [np.diag(yz), np.diag(zz)]])
        return -tangents @ _on_both(self.compressing)

    def largest_share(self, u, y, change) -> float:
        """Return the share of a change that takes at most half of any remaining stretch."""
        heights = np.append(self.tissue.h, self.pieces.h.min(initial=np.inf))
        after = self.forces(y + change)[0]
        room = np.maximum(1.0 - np.abs(u) / heights, 0.1) * heights / 2
        return float(min(1.0, (room / np.maximum(np.abs(after - u), 1e-300)).min()))

    def result(self, y, x, fixed_x, reactions) -> _Trial:
        """Return the equilibrium at y."""
        u, force = self.forces(y)
        return _Trial(
            y[:-1],
            complex(y[-1]),
            self.rest + self.along * y[-1],
            complex(self.bevel_rest + self.follow * y[-1]),
            Loads(np.append(x, fixed_x), np.append(force, reactions)),
            reactions,
            self.ramp * ogden(self.tissue, u[:-1]).energy,
            float(ogden(self.pieces, u[-1]).energy.sum()),
        )


def _law_per_mm(layer):
    height, width = layer.compression_length_mm, layer.engaged_width_mm
    return 1e-3 * layer.shear_modulus_kpa, layer.alpha, height, width * height


def _interval_edges(scenario: Scenario, ends):
    """Return the edges of the intervals of length Δ, shorter below the skin, divided where a layer ends."""
    spacing = scenario.contact.spacing_mm
    depth = scenario.setup.stroke_mm - scenario.setup.tip_to_skin_mm
    count = max(int(np.ceil(max(depth, 0.0) / spacing)), 3) + 2
    grid = spacing * np.concatenate([[0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5], np.arange(3, count)])
    inside = [end for end in ends if end < grid[-1] and np.abs(grid - end).min() > 1e-6 * spacing]
    return np.sort(np.append(grid, inside))


def _essential(guide_x, guide_y, points, tip_x, held):
    """Return prescribed positions and values: guide first, held tip last."""
    pairs = [(guide_x, guide_y)] if guide_x is not None and guide_x < tip_x else []
    pairs += [(point[0], complex(*point[1:])) for point in points]
    pairs += [] if held is None else [(tip_x, held)]
    x, y = np.array(pairs, dtype=complex).reshape(-1, 2).T
    return x.real, y


def _spring(reference: Reference, start: float, end: float) -> Tissue:
    """Return the tip spring: the length of each layer between `start` and `end`."""
    tops = np.append(0.0, reference.ends[:-1])
    length = np.clip(np.minimum(reference.ends, end) - np.maximum(tops, start), 0.0, None)
    return reference.laws._replace(volume=reference.laws.volume * length)


def _offsets(end: complex, rate: float, length: float, cuts: float):
    """Return the steady offset of the spring at the start of a cut with the bevel `end` at its end, and its increase.

    The bevel turns by `rate` (rad/mm). The spring forgets with the relaxation length, so the cut adds an integral over
    its way back from the end.
    """
    back = cuts / 2 * (1 + _SPIN_X)
    fading = np.exp(-(1 / length + 1j * rate) * back)
    steady = end * np.exp(-1j * rate * cuts) / (1 + 1j * rate * length)
    return steady, end / length * cuts / 2 * (_SPIN_W @ fading)


def _parts(values):
    """Return the y of lateral numbers, then their z."""
    return np.concatenate([values.real, values.imag])


def _joined(parts):
    """Return lateral numbers from their y, then their z."""
    y, z = np.split(parts, 2)
    return y + 1j * z


def _on_both(matrix):
    """Return a matrix that acts on y and z alike."""
    return np.kron(np.eye(2), matrix)
