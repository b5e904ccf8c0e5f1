"""Recorded insertions carried out by the model: the pose of the tip at each step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.calibration.parameters import Needle
from flexneedle.lab.calibration.session import STILL, Recording, Session
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import DB_X, DB_Y, DG_Y, ROLL, Flags, Floats

_LEAST_STEPS = 3  # for a turn that is no outlier
_AIR_MM = 1.0  # from the start of the model to the skin, and to the first step, at least
_LONGEST_MM = 1.0  # advance in a step of the model
STEEP = 0.5
"""Turn of a needle (rad) up to which it is fitted: the model's angles are small, and its curvature 40 % off there."""


@dataclass(frozen=True, eq=False)
class Replay:
    """Recordings as sequences of commands of the model.

    depths: x (mm) of the tip at each step of each recording, as commanded: after `corrected` the tip is at the recorded
    depths, although a bent needle is shorter.
    """

    recordings: tuple[Recording, ...]
    order: tuple[int, ...]  # of each recording within its session
    guide_order: str
    depths: tuple[Floats, ...]

    @staticmethod
    def of(session: Session) -> "Replay":
        """Return the recordings of a session."""
        depths = tuple(one.depth for one in session.recordings)
        return Replay(session.recordings, session.order, session.guide_order, depths)

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return self.recordings[0].axes

    @property
    def reached(self) -> float:
        """Depth (mm) of the deepest step."""
        return max(float(one.depth.max()) for one in self.recordings)

    @cached_property
    def begin(self) -> float:
        """Depth at which all insertions start in the model, in air."""
        return min(0.0, *(float(depth[0]) for depth in self.depths)) - _AIR_MM

    @cached_property
    def _parts(self) -> int:
        """Parts of the advance between two steps, for all intervals."""
        longest = max((abs(np.diff(depth)).max(initial=0.0) for depth in self.depths), default=0.0)
        first = max(float(depth[0]) for depth in self.depths) - self.begin
        return max(1, int(np.ceil(max(longest, first) / _LONGEST_MM - 1e-9)))

    @cached_property
    def commands(self) -> Floats:
        """Commands (n, m, 9): for each step a roll, `_parts` of the advance, and a motion of guide and base."""
        steps, width = max(len(depth) for depth in self.depths), self._parts + 2
        rows = np.zeros((len(self.recordings), steps, width, 9))
        at = {"before": slice(0, 1), "with": slice(1, -1), "after": slice(-1, None)}[self.guide_order]
        for row, one, depth in zip(rows, self.recordings, self.depths, strict=True):
            size = len(depth)
            row[:size, 1:-1, DB_X] = np.diff(depth, prepend=self.begin)[:, None] / self._parts
            for column, moved in ((DG_Y, one.guide), (DB_Y, one.base)):
                change = np.diff(moved, axis=0, prepend=moved[:1])
                for axis in range(self.axes):
                    row[:size, at, column + axis] = change[:, axis, None] / row[:size, at].shape[1]
            row[:size, 0, ROLL] = np.diff(one.roll, prepend=one.roll[:1])
        return rows.reshape(len(rows), -1, 9)

    @cached_property
    def _ends(self) -> Any:
        width = self._parts + 2
        return np.arange(width - 1, self.commands.shape[1], width)

    def predict(self, needles: Sequence[Needle]) -> tuple[Floats, Flags]:
        """Return tips (v, n, k, 5) by each of v needles at the steps of n recordings, and whether all solves converged.

        Recordings with fewer than k steps repeat their last tip.
        """
        return self.carry_out(needles)[:2]

    def carry_out(
        self, needles: Sequence[Needle], outputs: tuple[str, ...] = ()
    ) -> tuple[Floats, Flags, Floats]:
        """Return as `predict`, and the poses (v, n, k, nodes, 5) of needles; without "shapes" in outputs no nodes."""
        states, models = [], []
        zero = (0.0,) * self.axes
        for needle in needles:
            rolls = [needle.roll + float(one.roll[0]) for one in self.recordings]
            starts = {roll: needle.simulator.start(roll, (self.begin, *zero), zero) for roll in set(rolls)}
            states += [starts[roll] for roll in rolls]
            models += [needle.model(order) for order in self.order]
        rows = np.tile(self.commands, (len(needles), 1, 1))
        out = needles[0].simulator.rollout(states, rows, models=models, limits=False, outputs=outputs)
        shape = len(needles), len(self.recordings), len(self._ends)
        good = np.logical_and.reduce(np.asarray(out.converged).reshape(*shape[:2], -1), axis=2)
        nodes = out.shapes.shape[-2] if outputs else 0
        shapes = out.shapes[:, self._ends] if outputs else np.zeros(0)
        return out.tips[:, self._ends].reshape(*shape, 5), good, shapes.reshape(*shape, nodes, 5)

    def corrected(self, tips: Floats) -> "Replay":
        """Return the replay with the advances corrected by the depths of the tips (n, k, 5) that it has led to."""
        depths = tuple(
            depth + (one.depth - tip[: len(depth), 0])
            for depth, one, tip in zip(self.depths, self.recordings, tips, strict=True)
        )
        return replace(self, depths=depths)


def shallow(session: Session) -> Session:
    """Return the session with each insertion up to the step from which the needle has turned by more than `STEEP`."""
    return replace(session, recordings=tuple(one.first(_shallow_steps(one)) for one in session.recordings))


def read_sensors(scenario: Scenario, session: Session) -> tuple[Sensor, ...]:
    """Return the sensors along the needle of a scenario that have readings in a session."""
    read = {each.sensor for one in session.recordings for each in one.readings}
    return tuple(each for each in scenario.sensor if each.title in read)


def _shallow_steps(one: Recording) -> int:
    """Return the number of steps, at least two, before the needle turns too far; single outliers do not count."""
    if len(one.depth) < _LEAST_STEPS:
        return len(one.depth)
    advance = np.maximum(np.abs(np.gradient(one.depth)), _LONGEST_MM)[:, None]
    course = np.gradient(one.position, axis=0) / advance
    turn = np.where(np.isfinite(one.slope), one.slope - one.slope[0], course)
    steep = np.linalg.norm(turn, axis=1) > STEEP
    lasting = np.flatnonzero(steep[:-1] & steep[1:])
    return len(steep) if not len(lasting) else max(2, int(lasting[0]))


def fitting_scenario(scenario: Scenario, session: Session) -> Scenario:
    """Return the scenario with the axes of the recordings, and a stroke for their depths.

    Raises InputError if the needle is too short for them, or the scenario lacks a guide that moves in them.
    """
    deepest = max(float(one.depth.max()) for one in session.recordings)
    setup, length = scenario.setup, scenario.needle.length_mm
    if deepest + (setup.guide_to_skin_mm or 0.0) > length - 1.0:
        until = f"and {setup.guide_to_skin_mm:g} mm from skin to guide " if setup.has_guide else ""
        raise InputError(
            f"needle.length_mm = {length:g}: too short for recordings to {deepest:.1f} mm {until}in this scenario"
        )
    if not setup.has_guide and any(one.guide_moves > STILL for one in session.recordings):
        raise InputError("setup.guide_to_skin_mm: missing: the guide moves in the recordings")
    changes: dict[str, object] = {}
    if session.axes != scenario.setup.axes:
        changes["setup.axes"] = session.axes
    if scenario.setup.max_depth < deepest + 1.0:
        changes["setup.stroke_mm"] = deepest + 1.0 + scenario.setup.tip_to_skin_mm
    return scenario.with_values(changes) if changes else scenario
