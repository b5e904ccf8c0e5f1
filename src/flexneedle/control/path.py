"""The current path: the guide over absolute depth and the depths at which the bevel rolls, and its corrections.

A sample corrects the path: lateral corrections of the guide at a few knots between now and the target, and the depths
of the rolls, `LEAST_SLOTS` or as many as the path has. Sample 0 corrects nothing, so the path is only replaced by
a better one on the same model.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.control.guide import most_guide_step
from flexneedle.control.interface import travel_left
from flexneedle.control.mpc import planned_base
from flexneedle.estimation.task import Task
from flexneedle.simulator.state import State
from flexneedle.types import Command, Floats, Plan

KNOTS = np.array([0.1, 0.3, 0.6, 1.0])
"""Positions of the corrections of the guide, as shares of the path from the tip to the target."""
LEAST_SLOTS = 4
"""Number of rolls in a search, or that of the current path if it is larger."""
_FINE, _COARSE = (
    2,
    2.0,
)  # first steps of the rollout, of one control step; length of its later steps, in control steps
_DUE = 0.05  # of a control step: a roll this near is made at once
_STEEPEST = 0.03  # slope of the largest correction of the guide, mm per mm of the path left
_SHARE_OF_A_STEP = 0.5  # of the guide's limit in a control step, added to it: largest next to the target
_FURTHEST = 0.3  # largest move of a roll, of the path left
_DECADES = 2.0  # over which the scales of the samples spread


@dataclass(frozen=True, eq=False)
class GuidePath:
    """The guide's lateral position (r,) over the depth (r,) of the tip, mm, and the depths of the rolls, ascending."""

    depth: Floats
    guide: Floats
    rolls: tuple[float, ...]


def of_plan(plan: Plan) -> GuidePath:
    """The plan's path."""
    rolls = plan.tips[:-1][plan.controls[:, 4] > 0.0][:, 0]
    keep = np.concatenate([[True], np.diff(plan.tips[:, 0]) > 1e-9])
    return GuidePath(plan.tips[keep, 0], plan.guide[keep], tuple(rolls.tolist()))


@dataclass(frozen=True, eq=False)
class Ahead:
    """The path from the tip to the target in m steps: depth (m + 1,) of their ends, base (m, 2) of each; mm, rad.

    state: the estimated needle; path: the current one; step, reach: the guide's limits (mm), per control step, in all;
    advance: longest control step (mm).
    """

    depth: Floats
    base: Floats
    state: State
    path: GuidePath
    step: float
    reach: float
    advance: float

    @staticmethod
    def of(task: Task, state: State, path: GuidePath) -> "Ahead":
        """Two control steps, then longer ones."""
        setup, left = task.scenario.setup, travel_left(task.scenario, task.plan, state)
        longest = setup.max_advance_mm
        fine = min(_FINE * longest, left)
        first = np.linspace(0.0, fine, max(1, int(np.ceil(fine / longest - 1e-9))) + 1)
        rest = left - fine
        steps = int(np.ceil(rest / (_COARSE * longest) - 1e-9))
        depth = float(state.tip[0]) + np.append(first, fine + rest * np.arange(1, steps + 1) / max(steps, 1))
        return Ahead(
            depth,
            planned_base(setup, task.plan, state, depth[1:]),
            state,
            path,
            most_guide_step(setup, task.plan.strategy),
            setup.max_guide_travel_mm,
            longest,
        )

    @property
    def left(self) -> float:
        """Path left to the target depth (mm)."""
        return float(self.depth[-1] - self.depth[0])

    @property
    def slots(self) -> int:
        """Rolls that a sample describes."""
        return max(LEAST_SLOTS, len(self.path.rolls))

    @property
    def unused(self) -> float:
        """Depth (mm) of a roll that is not made."""
        return float(self.depth[-1]) + 0.5 * self.left + self.advance

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Bounds of a sample, (d,) each."""
        wide = 2.0 * self.reach if self.step > 0.0 else 0.0
        lower = [np.full(KNOTS.size, -wide), np.full(self.slots, self.depth[0])]
        upper = [np.full(KNOTS.size, wide), np.full(self.slots, self.unused)]
        return np.concatenate(lower), np.concatenate(upper)

    @property
    def current(self) -> Floats:
        """The sample (d,) that corrects nothing."""
        rolls = np.full(self.slots, self.unused)
        rolls[: len(self.path.rolls)] = np.maximum(self.path.rolls, self.depth[0])
        return np.concatenate([np.zeros(KNOTS.size), rolls])

    @property
    def constant(self) -> Floats:
        """Samples (4, d) that roll before the first step or not, and after it or not (last index), and never again."""
        z = np.tile(self.current, (4, 1))
        z[:, KNOTS.size :] = self.unused
        z[2:, KNOTS.size] = self.depth[0]
        z[1::2, KNOTS.size + 1] = self.depth[1]
        return z

    def controls(self, z: Floats) -> tuple[Floats, Floats]:
        """Controls (N, m, 5) of samples z (N, d), and the tip's depths (N, m + 1) before and after each step."""
        depth, roll = self._grid(z[:, KNOTS.size :])
        guide = self._guide(z[:, : KNOTS.size], depth)
        controls = np.zeros((*depth[:, 1:].shape, 5))
        controls[:, :, 0] = np.diff(depth, axis=1)
        controls[:, :, 1:3] = self.base
        controls[:, :, 3] = np.diff(guide, axis=1)
        controls[:, :, 4] = np.where(roll, 1.0, -1.0)
        return controls, depth

    def _grid(self, rolls: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths (N, m + 1) with a boundary at each roll (N, s), and whether the bevel rolls before each step (N, m).

        So the cost is continuous in the depth of a roll. Each roll has its own boundary, the nearest or the next one
        that is free, if there is one before the last step; two rolls at one depth cancel.
        """
        n, m = len(rolls), self.depth.size - 1
        depth, rolled = np.tile(self.depth, (n, 1)), np.zeros((n, m + 1), dtype=bool)
        middle = 0.5 * (self.depth[1:] + self.depth[:-1])
        rows, last = np.arange(n), np.full(n, -1)
        for roll in _without_twins(np.sort(rolls, axis=1), _DUE * self.advance).T:
            nearest = np.searchsorted(middle, roll)
            made = (roll < self.depth[-1]) & (nearest < m)
            at = np.minimum(np.maximum(nearest, last + 1), m - 1)
            inner = made & (at > 0)
            depth[rows[inner], at[inner]] = roll[inner]
            rolled[rows[made], at[made]] ^= True
            last = np.where(made, at, last)
        return depth, rolled[:, :m]

    def _guide(self, corrections: Floats, depth: Floats) -> Floats:
        """Guide positions (N, m + 1) within the limits, for corrections (N, k) at the knots."""
        share = (depth - self.depth[0]) / max(self.left, 1e-9)
        knots = np.append(0.0, KNOTS)
        padded = np.concatenate([np.zeros((len(corrections), 1)), corrections], axis=1)
        at = np.clip(np.searchsorted(knots, share, side="right") - 1, 0, KNOTS.size - 1)
        part = (share - knots[at]) / (knots[at + 1] - knots[at])
        rows = np.arange(len(corrections))[:, None]
        wanted = np.interp(depth, self.path.depth, self.path.guide)
        wanted += (1.0 - part) * padded[rows, at] + part * padded[rows, at + 1]
        wanted = np.clip(wanted, -self.reach, self.reach)
        most = self.step * np.diff(depth, axis=1) / self.advance
        guide = np.empty_like(wanted)
        guide[:, 0] = self.state.guide
        for k in range(most.shape[1]):
            guide[:, k + 1] = np.clip(wanted[:, k + 1], guide[:, k] - most[:, k], guide[:, k] + most[:, k])
        return guide

    def corrected(self, z: Floats) -> GuidePath:
        """The path with the corrections of a sample (d,)."""
        controls, depth = self.controls(z[None])
        guide = self.state.guide + np.append(0.0, np.cumsum(controls[0, :, 3]))
        return GuidePath(depth[0], guide, tuple(depth[0, :-1][controls[0, :, 4] > 0.0].tolist()))

    def first(self, path: GuidePath) -> tuple[Command, GuidePath]:
        """The command of this period, and the rest of a path after it.

        A roll that is due is made at once; the advance ends at the depth of the next one.
        """
        x = float(self.depth[0])
        due = x + _DUE * self.advance
        later = tuple(roll for roll in path.rolls if roll > due)
        flip = (len(path.rolls) - len(later)) % 2 == 1
        advance = min(self.advance, self.left, *(roll - x for roll in later[:1]))
        guide = float(np.interp(x + advance, path.depth, path.guide)) - self.state.guide
        db_y, db_theta = (
            (self.base[0] * advance / (self.depth[1] - x)).tolist() if self.left > 0.0 else (0.0, 0.0)
        )
        step = max(-self.step, min(self.step, guide))
        return (advance, db_y, db_theta, step, 1 if flip else -1), replace(path, rolls=later)


def _without_twins(rolls: Floats, near: float) -> Floats:
    """Ascending rolls (N, s); pairs within `near` (mm), which cancel, are infinite."""
    left = rolls.copy()
    for k in range(left.shape[1] - 1):
        twins = np.isfinite(left[:, k]) & (left[:, k + 1] - left[:, k] <= near)
        left[twins, k : k + 2] = np.inf
    return left


def proposals(ahead: Ahead, count: int, rng: np.random.Generator) -> Floats:
    """Samples (count, d) around the current path, which is the first, with scales over two decades.

    With a guide a quarter changes it alone, a quarter the rolls alone, a sixth adds a pair of rolls, the rest changes
    all; without one three quarters change the rolls, a half adds a pair.
    """
    z = np.tile(ahead.current, (count, 1))
    k = KNOTS.size
    kind = np.arange(count) % 12
    scale = 10.0 ** rng.uniform(-_DECADES, 0.0, (count, 2))
    widest = _STEEPEST * ahead.left + _SHARE_OF_A_STEP * ahead.step
    guide = widest * scale[:, :1] * rng.standard_normal((count, k))
    rolls = _FURTHEST * ahead.left * scale[:, 1:] * rng.standard_normal((count, ahead.slots))
    if ahead.step > 0.0:
        z[:, :k] += np.where(((kind < 3) | (kind >= 8))[:, None], guide, 0.0)
    used = z[0, k:] < ahead.depth[-1]
    z[:, k:] += np.where((kind >= 3)[:, None] & used, rolls, 0.0)
    pair = np.flatnonzero((kind == 6) | (kind == 7)) if ahead.step > 0.0 else np.flatnonzero(kind % 2 == 0)
    if used.sum() <= ahead.slots - 2:
        middle = rng.uniform(ahead.depth[0], ahead.depth[-1], pair.size)
        half = 0.5 * ahead.left * 10.0 ** rng.uniform(-1.5, 0.0, pair.size)
        z[pair, -2], z[pair, -1] = middle - half, middle + half
    z[0] = ahead.current
    return np.clip(z, *ahead.bounds)
