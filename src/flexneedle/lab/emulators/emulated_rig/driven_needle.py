"""True needle, which follows the axes of a rig in small parts, and the pose of its sensor in the tracker's frame."""

import math
from dataclasses import dataclass

import numpy as np

from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.emulators.emulated_rig.axes import ROTATION, control_between
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import tip_of
from flexneedle.phantom.plants import ExactPlant
from flexneedle.types import Floats, Point, Pose

RESOLUTION_MM, RESOLUTION_RAD = 1e-3, 1e-3
"""Motions below are not followed before the axes rest. The tip of a bent needle is less than 1 mm off its axis, and the
guide moves it by at most three times its own motion: so it is followed to 3 µm, a thirteenth of a tracker's noise."""

_PART_RAD = 0.1  # largest rotation in one step of the plant


class DrivenNeedle:
    """The exact needle of a true phantom, with its base, guide and roll at positions (6,) of `axes.NAMES`."""

    def __init__(self, truth: Truth, positions: Floats) -> None:
        self._truth, self._positions = truth, positions.copy()
        self._plant = ExactPlant(truth, 0.0)
        self._part = truth.scenario.phantom.step_mm
        self.least_stretch = 1.0
        self.tip = tip_of(self._plant, truth)

    def follow(self, positions: Floats, *, exactly: bool) -> int:
        """Move to positions (6,) in small parts; return their number, 0 for a motion below the resolution.

        exactly: follow any motion.
        """
        moved = np.abs(positions - self._positions)
        turn, moved[ROTATION] = float(moved[ROTATION]), 0.0
        way = float(moved.max())
        if not (turn > 0.0 or way > 0.0) if exactly else (way < RESOLUTION_MM and turn < RESOLUTION_RAD):
            return 0
        parts = max(1, math.ceil(way / self._part - 1e-9), math.ceil(turn / _PART_RAD - 1e-9))
        row = control_between(self._positions, positions) / parts
        for _ in range(parts):
            self._plant.step(row)
            self.least_stretch = min(self.least_stretch, self._plant.least_stretch)
        self._positions = positions.copy()
        self.tip = tip_of(self._plant, self._truth)
        return parts

    @property
    def shape(self) -> tuple[float, ...]:
        """Roll (rad) and the nodes x, y, z (mm) from base to tip, one after the other."""
        return self._plant.roll, *self._plant.nodes.ravel().tolist()

    @property
    def strain_energy(self) -> float:
        """Strain energy of the tissue, weighted by layer (mJ)."""
        return self._plant.strain_energy

    @property
    def converged(self) -> bool:
        """True if all steps converged to an equilibrium."""
        return self._plant.converged


@dataclass(frozen=True)
class PhantomSensor:
    """The tip's sensor, `offset` mm behind the tip, in the tracker's frame without noise.

    to_tracker: map from the stage's frame, with the error of the registration; bias: constant error (mm).
    """

    to_tracker: Rigid
    offset: float = 0.0
    bias: Point = (0.0, 0.0, 0.0)

    def at(self, tip: Floats) -> tuple[float, ...]:
        """Return position x, y, z (mm) and direction of the needle, a unit vector, for a pose (5,) of the tip."""
        pose = Pose.of(tip)
        axis = np.array(pose.axis)
        place = np.array(pose.point) + self.bias - self.offset * axis
        return (*self.to_tracker.apply(place).tolist(), *(self.to_tracker.rotation @ axis).tolist())
