"""Insertions of the exact needle in space: any start and any command, and the same turned about the axis."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from flexneedle import Control, controls
from flexneedle.phantom import rod as rd
from flexneedle.phantom.equilibrium import step
from flexneedle.types import COLUMNS
from reference.rods import IDEAL, plant

LATERAL = (("db_y", "db_z"), ("db_theta", "db_psi"), ("dg_y", "dg_z"))


class Inserted:
    """The needle and tissue of a scenario, with any pose of the base at the start."""

    def __init__(self, scenario=IDEAL, *, base=(0.0, 0.0), tilt=(0.0, 0.0), roll=0.0, bend=0.0, **truth):
        like = plant(scenario, bend=bend, **truth)
        self.rod, segments = like.rod, len(like.segments) - 1
        pose = (scenario.start_base_x, *base), tilt
        self.s, self.w = rd.start(*pose, scenario.needle.length_mm, segments, roll)
        self.channel, self.count = np.zeros(like.channel.size, rd.POINT), 0
        self.move()

    def move(self, row=None, times=1, **columns):
        """Step by a row, or by named columns; one that finds no equilibrium is an error of the test."""
        for _ in range(times):
            given = np.array(Control(**columns)) if row is None else row
            self.count = step(self.rod, self.s, self.w, self.channel, self.count, given)
            if not self.s["converged"] > 0.0:
                raise ValueError(f"residual {self.s['residual']:.3g} mm")
        return self

    @property
    def tip(self):
        """x, y, z (mm)."""
        return self.s["tip"].copy()

    @property
    def roll(self):
        """Of the tip (rad)."""
        return float(self.s["roll"] + self.s["twist"])

    @property
    def bevel(self):
        """Direction of the bevel (3,)."""
        return Rotation.from_quat(self.s["frame"], scalar_first=True).apply([0.0, 1.0, 0.0])


def turned(rows, angle):
    """Rows (m, 9) with their lateral motions turned about the axis."""
    changed, c, s = rows.copy(), math.cos(angle), math.sin(angle)
    for pair in LATERAL:
        y, z = (COLUMNS.index(name) for name in pair)
        changed[:, y], changed[:, z] = c * rows[:, y] - s * rows[:, z], s * rows[:, y] + c * rows[:, z]
    return changed


def wander(seed, steps=150, to_skin=26.5):
    """Random rows (m, 9) in all columns: to the skin, in, back and in again."""
    rng = np.random.default_rng(seed)
    rows = controls(steps)
    rows[:, 0] = rng.choice([0.5, 0.5, 0.25, -0.25], steps)
    rows[0, 0] = to_skin
    rows[:, 1:7] = rng.normal(0.0, [0.02, 0.02, 2e-4, 2e-4, 0.05, 0.05], (steps, 6))
    rows[:, 7] = np.where(rng.random(steps) < 0.1, rng.uniform(-3.0, 3.0, steps), 0.0)
    rows[:, 8] = np.where(rng.random(steps) < 0.3, rng.uniform(-1.0, 1.0, steps), 0.0)
    return rows


def angle_between(one, other):
    """Angle (rad) between two rotations of the clamp, as a vector of the world."""
    return (
        Rotation.from_quat(other, scalar_first=True) * Rotation.from_quat(one, scalar_first=True).inv()
    ).as_rotvec()
