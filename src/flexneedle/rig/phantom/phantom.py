"""A virtual phantom with the ports of a rig: a `Driver` and a `Clock`, and the true state for the record."""

import math
from typing import NamedTuple

import numpy as np

from flexneedle.rig.phantom.draw import Truth
from flexneedle.rig.phantom.plants import PlantFactory, plant
from flexneedle.simulator.control import Control, Limits
from flexneedle.types import Command, Floats

_WHOLE = 1e-8  # of a motor step: tolerance for a position on a whole step


class Condition(NamedTuple):
    """True state: tip pose (mm, rad), tissue strain energy (mJ), smallest stretch λ since the start, convergence."""

    tip: Floats
    strain_energy: float
    least_stretch: float
    converged: bool


class Phantom:
    """The true needle. It moves on command; its clock advances by the duration of each command."""

    def __init__(self, truth: Truth, bevel: int, kind: str | PlantFactory = "exact") -> None:
        self._plant = plant(kind, truth, bevel)
        self._truth = truth
        self._limits = Limits.of(truth.scenario)
        self._moved = np.zeros(4)
        self._remainder = np.zeros(4)  # of all commands after rounding to motor steps
        self._time = 0.0
        self._least_stretch = 1.0
        self._path = [(0.0, *self._tip().tolist())]  # time, x, y, slope

    def condition(self) -> Condition:
        """The true state, for the record only; not available to controllers."""
        return Condition(self._tip(), self._plant.strain_energy, self._least_stretch, self._plant.converged)

    def now(self) -> float:
        """Seconds since the start."""
        return self._time

    def wait(self, seconds: float) -> None:
        """Wait with the needle at rest."""
        self._time += seconds
        self._path.append((self._time, *self._tip().tolist()))

    def apply(self, command: Command, duration: float) -> Command:
        """Execute `command` at constant velocity within `duration` s, in steps of at most `phantom.step_mm`.

        Motors move to the multiple of their resolution nearest to the sum of all commands, so that rounding errors do
        not accumulate. Returns the command as applied. Raises CommandError if it exceeds a limit of the setup.
        """
        self._limits.check(self._moved, Control.from_row(command).row()[None])
        row = self._rounded(command)
        parts = max(1, math.ceil(abs(row[0]) / self._truth.scenario.phantom.step_mm - 1e-9))
        for k in range(parts):
            self._plant.step(np.append(row[:4] / parts, row[4] if k == 0 else -1.0))
            self._least_stretch = min(self._least_stretch, self._plant.least_stretch)
            self._path.append((self._time + duration * (k + 1) / parts, *self._tip().tolist()))
        self._moved += row[:4]
        self._time += duration
        db_x, db_y, db_theta, dg_y = row[:4].tolist()
        return db_x, db_y, db_theta, dg_y, command[4]

    def tip_at(self, time: float) -> tuple[float, float]:
        """Return the true tip (x, y) in mm at a time, for a simulated tracker; at rest before the start."""
        return self.pose_at(time)[:2]

    def pose_at(self, time: float) -> tuple[float, float, float]:
        """Return the true tip and its slope (x, y, θ), mm and rad, at a time; at rest before the start."""
        for (t0, x0, y0, a0), (t1, x1, y1, a1) in zip(self._path[-2::-1], self._path[:0:-1], strict=True):
            if time > t0:
                part = min(1.0, (time - t0) / (t1 - t0)) if t1 > t0 else 1.0
                return x0 + part * (x1 - x0), y0 + part * (y1 - y0), a0 + part * (a1 - a0)
        return self._path[0][1:]

    def _rounded(self, command: Command) -> Floats:
        """The command in whole motor steps, within the limits; the rotation of the base is not rounded."""
        row = np.array(command, dtype=float)
        grid = self._truth.scenario.phantom.motor_resolution_mm
        if grid > 0.0:
            lengths = [0, 1, 3]
            position, requested = self._moved[lengths], row[lengths] + self._remainder[lengths]
            step, travel = self._limits.step[lengths], self._limits.travel[lengths]
            lowest = np.ceil(np.maximum(position - step, travel[:, 0]) / grid - _WHOLE)
            highest = np.floor(np.minimum(position + step, travel[:, 1]) / grid + _WHOLE)
            goal = grid * np.clip(np.rint((position + requested) / grid), lowest, highest)
            row[lengths] = np.where(row[lengths] == 0.0, 0.0, goal - position)
            self._remainder[lengths] = np.clip(requested - row[lengths], -0.5 * grid, 0.5 * grid)
        return row

    def _tip(self) -> Floats:
        """The pose of the tip, which is offset from the needle's axis by the run-out."""
        x, y, theta = self._plant.tip
        offset = self._truth.run_out * self._plant.bevel
        return np.array([x - offset * math.sin(theta), y + offset * math.cos(theta), theta])
