"""The current path: the guide over absolute depth and the depths at which the bevel rolls, and its corrections.

A sample corrects the path: lateral corrections of the guide at a few knots between now and the target, on each axis of
the guide, and the rolls, `LEAST_SLOTS` or as many as the path has: their depths, and the needle's angles after them
where it rolls to any angle. Sample 0 corrects nothing, so the path is only replaced by a better one on the same model.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexneedle.control.interface import travel_left
from flexneedle.control.limits import guide_axes, guide_reach, largest_guide_step, limit_roll, shorten_roll
from flexneedle.control.mpc import steps_to_planned_base
from flexneedle.estimation.task import Task
from flexneedle.planning.primitives import LEAST_ROLL
from flexneedle.results import Plan
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.simulator.control import controls
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, DB_Y, DG_Y, ROLL, Control, Floats, Laterals, X

KNOTS = np.array([0.1, 0.3, 0.6, 1.0])
"""Positions of the corrections of the guide, as shares of the path from the tip to the target."""
LEAST_SLOTS = 4
"""Least number of rolls in a search, which has as many as the current path."""
DUE = 0.05
"""Share of a control step: a roll this near is made at once."""
LEAN = 0.1
"""Correction of the guide (mm) that shows its effect."""
_FINE = 2  # first steps of the rollout, each of one control step
_COARSE = 2.0  # length of its later steps, in control steps
_TURNS = 4.0 * np.pi  # from the present angle, to either side: bounds of an angle


@dataclass(frozen=True, eq=False)
class GuidePath:
    """A path of the guide, with the rolls of the needle."""

    depth: Floats  # depths (r,) of the tip, mm
    guide: Floats  # position y, z (r, 2) of the guide at these depths, mm
    rolls: Floats  # depths (mm), ascending, of the rolls, and the needle's angle (rad) after each, (k, 2)


def path_of_plan(plan: Plan) -> GuidePath:
    """Return the path of a plan."""
    rolled = plan.controls[:, ROLL] != 0.0
    angle = plan.roll + np.cumsum(plan.controls[:, ROLL])
    keep = np.concatenate([[True], np.diff(plan.tips[:, X]) > 1e-9])
    rolls = np.stack([plan.tips[:-1, X], angle], axis=1)[rolled]
    return GuidePath(plan.tips[keep, X], plan.guide[keep], rolls)


@dataclass(frozen=True, eq=False)
class Ahead:
    """The path from the tip to the target in m steps."""

    depth: Floats  # depths (m + 1,) of the ends of the steps, mm
    base: Floats  # motion of the base (m, 4) in each step, mm and rad
    state: State  # the estimated needle
    path: GuidePath  # the current path
    setup: Setup  # limits of the needle
    step: float  # largest step of the guide (mm)
    axes: int  # number of axes on which the guide moves

    @staticmethod
    def of(task: Task, state: State, path: GuidePath) -> "Ahead":
        """Return the path ahead of a state: two control steps, then longer steps."""
        setup, left = task.scenario.setup, travel_left(task.scenario, task.plan, state)
        longest = setup.max_advance_mm
        fine = min(_FINE * longest, left)
        first = np.linspace(0.0, fine, max(1, int(np.ceil(fine / longest - 1e-9))) + 1)
        rest = left - fine
        steps = int(np.ceil(rest / (_COARSE * longest) - 1e-9))
        depth = float(state.tip[X]) + np.append(first, fine + rest * np.arange(1, steps + 1) / max(steps, 1))
        strategy = task.plan.strategy
        return Ahead(
            depth,
            steps_to_planned_base(setup, task.plan, state, depth[1:]),
            state,
            path,
            setup,
            largest_guide_step(setup, strategy),
            guide_axes(setup, strategy) or 1,
        )

    @property
    def advance(self) -> float:
        """Longest control step (mm)."""
        return self.setup.max_advance_mm

    @property
    def left(self) -> float:
        """Path left to the target depth (mm)."""
        return float(self.depth[-1] - self.depth[0])

    @property
    def slots(self) -> int:
        """Number of rolls in a sample."""
        return max(LEAST_SLOTS, len(self.path.rolls))

    @property
    def knots(self) -> int:
        """Number of corrections of the guide in a sample."""
        return int(self.axes * KNOTS.size)

    @property
    def depths(self) -> slice:
        """Depths of the rolls in a sample."""
        return slice(self.knots, self.knots + self.slots)

    @property
    def angles(self) -> slice:
        """Angles after the rolls in a sample; none where the needle rolls by half turns."""
        last = self.depths.stop
        return slice(last, last if self.setup.half_turns else last + self.slots)

    @property
    def unused(self) -> float:
        """Depth (mm) of a roll that is not made."""
        return float(self.depth[-1]) + 0.5 * self.left + self.advance

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """Bounds of a sample, (d,) each."""
        wide = 2.0 * self.setup.max_guide_travel_mm if self.step > 0.0 else 0.0
        angles = self.angles.stop - self.angles.start
        lower = [np.full(self.knots, -wide), np.full(self.slots, self.depth[0])]
        upper = [np.full(self.knots, wide), np.full(self.slots, self.unused)]
        lower.append(np.full(angles, max(-self.setup.max_rotation, self.state.roll - _TURNS)))
        upper.append(np.full(angles, min(self.setup.max_rotation, self.state.roll + _TURNS)))
        return np.concatenate(lower), np.concatenate(upper)

    @property
    def current(self) -> Floats:
        """The sample (d,) that corrects nothing."""
        known = len(self.path.rolls)
        rolls = np.full((self.slots, 2), (self.unused, self.state.roll))
        rolls[:known] = self.path.rolls
        rolls[:known, 0] = np.maximum(rolls[:known, 0], self.depth[0])
        angles = rolls[:0, 1] if self.setup.half_turns else rolls[:, 1]
        return np.concatenate([np.zeros(self.knots), rolls[:, 0], angles])

    def lean_guide(self, rows: Floats) -> Floats:
        """Return copies (k, m, 9) of controls (m, 9), the guide `LEAN` further in +y at one knot each, if it moves."""
        others = np.tile(rows, (KNOTS.size, 1, 1))
        if self.step > 0.0:
            share = np.append(0.0, np.cumsum(rows[:, DB_X])) / max(self.left, 1e-9)
            knots, hats = np.append(0.0, KNOTS), LEAN * np.eye(KNOTS.size, KNOTS.size + 1, 1)
            others[:, :, DG_Y] += np.diff([np.interp(share, knots, hat) for hat in hats], axis=1)
        return others

    @property
    def constant(self) -> Floats:
        """Controls (4, m, 9) of all combinations of half a turn before the first step and after it (last index)."""
        rows, _ = self._without_rolls(self.current[None, : self.knots], np.tile(self.depth, (4, 1)))
        rows[2:, 0, ROLL] = np.pi
        if rows.shape[1] > 1:
            rows[1::2, 1, ROLL] = np.pi
        return rows

    def controls(self, z: Floats) -> tuple[Floats, Floats]:
        """Return controls (N, m, 9) of samples z (N, d), and the tip's depths (N, m + 1) before and after each step."""
        depth, roll = self._grid(z[:, self.depths], z[:, self.angles])
        rows, depth = self._without_rolls(z[:, : self.knots], depth)
        rows[:, :, ROLL] = roll
        return rows, depth

    def bevel_use(self, z: Floats) -> Laterals:
        """Return the integral (N,) of the bevel's direction, relative to the present one, over the path (mm)."""
        order = np.argsort(z[:, self.depths], axis=1)
        rolls, row = np.clip(z[:, self.depths], *self.depth[[0, -1]]), np.arange(len(z))[:, None]
        ends = np.full((len(z), 1), self.depth[-1])
        after = np.diff(np.concatenate([rolls[row, order], ends], axis=1), axis=1)
        if self.setup.half_turns:
            turned = np.pi * np.arange(1, self.slots + 1)
        else:
            turned = z[:, self.angles][row, order] - self.state.roll
        used: Laterals = self.left - after.sum(axis=1) + (after * np.exp(1j * turned)).sum(axis=1)
        return used

    def angle_at(self, z: Floats, depth: Floats) -> Floats:
        """Return the needle's angles (N,), rad, of samples z (N, d) at depths (N,), mm."""
        before = np.where(z[:, self.depths] < depth[:, None], z[:, self.depths], -np.inf)
        if self.setup.half_turns:
            angle: Floats = self.state.roll + np.pi * np.isfinite(before).sum(axis=1)
            return angle
        last = z[np.arange(len(z)), self.angles.start + before.argmax(axis=1)]
        return np.where(np.isfinite(before).any(axis=1), last, self.state.roll)

    def _without_rolls(self, corrections: Floats, depth: Floats) -> tuple[Floats, Floats]:
        """Return controls (N, m, 9) without rolls, of corrections (N, knots) or (1, knots), on depths (N, m + 1)."""
        advance = np.diff(depth, axis=1)
        rows = controls(*advance.shape, db_x=advance)
        guide = self._guide(corrections.reshape(-1, self.axes, KNOTS.size), depth, advance)
        rows[:, :, DG_Y : DG_Y + self.axes] = np.diff(guide, axis=0).swapaxes(0, 1)
        rows[:, :, DB_Y:DG_Y] = self.base
        return rows, depth

    def _grid(self, rolls: Floats, angles: Floats) -> tuple[Floats, Floats]:
        """Return depths (N, m + 1) with a boundary at each roll (N, s), and the roll (rad) before each step (N, m).

        So the cost is continuous in the depth of a roll. Each roll has its own boundary, the nearest or the next one
        that is free, if there is one before the last step; of two rolls at one depth the second counts, and two half
        turns cancel.
        """
        n, m, half = len(rolls), self.depth.size - 1, self.setup.half_turns
        order = np.argsort(rolls, axis=1, kind="stable")
        ascending = _without_twins(rolls[np.arange(n)[:, None], order], DUE * self.advance, both=half).T
        nearest = np.searchsorted(0.5 * (self.depth[1:] + self.depth[:-1]), ascending)
        made = (ascending < self.depth[-1]) & (nearest < m)
        turns = np.full_like(ascending, np.pi)
        if not half:
            angle = np.full(n, self.state.roll)
            for k, goal in enumerate(angles[np.arange(n)[:, None], order].T):
                turns[k] = shorten_roll(self.setup, angle, goal - angle)
                made[k] &= np.abs(turns[k]) >= LEAST_ROLL
                angle = np.where(made[k], angle + turns[k], angle)
        before = np.cumsum(made, axis=0) - made  # number of rolls at boundaries before
        free = np.maximum.accumulate(np.where(made, nearest - before, -m), axis=0) + before
        rolled, depth, roll = np.nonzero(made), np.tile(self.depth, (n, 1)), np.zeros((n, m))
        place = rolled[1], np.minimum(free[rolled], m - 1)
        depth[place] = np.where(place[1] > 0, ascending[rolled], self.depth[0])
        np.add.at(roll, place, turns[rolled])
        if half:
            return depth, np.pi * (np.rint(roll / np.pi) % 2.0)
        # Rolls that share the last boundary are one, the short way.
        roll[:, -1] = shorten_roll(self.setup, self.state.roll + roll[:, :-1].sum(axis=1), roll[:, -1])
        return depth, roll

    def _guide(self, corrections: Floats, depth: Floats, advance: Floats) -> Floats:
        """Return guide positions (m + 1, N, axes) within the limits.

        corrections (N, axes, k): at the knots; depth (N, m + 1), advance (N, m): before and in the steps.
        """
        limits = np.array([guide_reach(self.state.scenario, axis) for axis in range(self.axes)])
        share = (depth.T - self.depth[0]) / max(self.left, 1e-9)
        knots = np.append(0.0, KNOTS)
        padded = np.concatenate([np.zeros((*corrections.shape[:2], 1)), corrections], axis=2)
        at, row = np.searchsorted(KNOTS[:-1], share, side="right"), np.arange(len(corrections))
        part = ((share - knots[at]) / (knots[at + 1] - knots[at]))[..., None]
        paths = self.path.guide[:, : self.axes].T
        wanted = np.stack([np.interp(depth.T, self.path.depth, path) for path in paths], axis=-1)
        wanted += (1.0 - part) * padded[row, :, at] + part * padded[row, :, at + 1]
        guide: Floats = np.minimum(np.maximum(wanted, limits[:, 0]), limits[:, 1])
        guide[0] = self.state.guide[: self.axes]
        most = (self.step * advance.T / self.advance)[..., None]
        if ((guide[1:] < guide[:-1] - most) | (guide[1:] > guide[:-1] + most)).any():
            for before, step, after in zip(guide[:-1], most, guide[1:], strict=True):
                np.minimum(np.maximum(after, before - step), before + step, out=after)
        return guide

    def path_of(self, rows: Floats) -> GuidePath:
        """Return the path of controls (m, 9) from the tip to the target."""
        depth = self.depth[0] + np.append(0.0, np.cumsum(rows[:, DB_X]))
        guide = np.zeros((depth.size, 2))
        np.cumsum(rows[:, DG_Y : DG_Y + 2], axis=0, out=guide[1:])
        turned = rows[:, ROLL]
        rolls = np.stack([depth[:-1], self.state.roll + np.cumsum(turned)], axis=1)[turned != 0.0]
        return GuidePath(depth, guide + self.state.guide, rolls)

    def first_command(self, path: GuidePath) -> tuple[Control, GuidePath]:
        """Return the command of this period, and the rest of a path after it.

        A roll that is due is made at once; the advance ends at the depth of the next one.
        """
        x = float(self.depth[0])
        due = path.rolls[:, 0] <= x + DUE * self.advance
        later = path.rolls[~due]
        advance = min(self.advance, self.left, *(later[:1, 0] - x).tolist())
        row = controls(1, db_x=advance)[0]
        for axis in range(self.axes):
            place = self.state.guide[axis]
            step = float(np.interp(x + advance, path.depth, path.guide[:, axis])) - place
            row[DG_Y + axis] = max(-self.step, min(self.step, step))
        if self.left > 0.0:
            row[DB_Y:DG_Y] = self.base[0] * advance / (self.depth[1] - x)
        row[ROLL] = self._due_roll(path.rolls[due, 1])
        return Control.of(row.tolist()), replace(path, rolls=later)

    def _due_roll(self, angles: Floats) -> float:
        """Return the shortest roll (rad) to the last of these angles."""
        if self.setup.half_turns:
            return np.pi * (len(angles) % 2)
        present = self.state.roll
        return limit_roll(self.setup, present, float(angles[-1]) - present) if len(angles) else 0.0


def _without_twins(rolls: Floats, near: float, *, both: bool) -> Floats:
    """Return ascending rolls (N, s), in which the first of a pair within `near` (mm) is infinite.

    both: whether both rolls of a pair are, since half turns cancel.
    """
    left = rolls.copy()
    for k in range(left.shape[1] - 1):
        twins = np.isfinite(left[:, k]) & (left[:, k + 1] - left[:, k] <= near)
        left[twins, k : k + 1 + both] = np.inf
    return left
