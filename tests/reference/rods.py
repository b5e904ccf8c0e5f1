"""Rods for the tests of `phantom.rod`: alone on a bench, or the plant of a scenario without imperfections."""

import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from flexneedle import load_scenario
from flexneedle.phantom import Truth
from flexneedle.phantom import rod as rd
from flexneedle.phantom.plants import ExactPlant

ZEROS = (
    "shear_modulus_variation",
    "layer_shift_sd_mm",
    "start_offset_sd_mm",
    "start_angle_sd_mrad",
    "initial_bend_mm",
    "run_out_mm",
    "guide_clearance_mm",
    "friction_mn_per_mm",
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
"""Changes that leave a rig without any imperfection."""

IDEAL = load_scenario("phantom").with_values(PERFECT)

_ON_A_BENCH = {
    "stiffness": 1000.0,
    "curvature": 0.0,
    "bevel_offset": 0.0,
    "bevel_length": 1.0,
    "guide_x": math.nan,
    "clearance": 0.0,
    "guide_stiffness": 1e3,
    "friction": 0.0,
    "spacing": 0.5,
    "cell": 1.0,
    "alpha": np.array([6.0]),
    "height": np.array([20.0]),
    "force": np.array([0.0]),
    "energy": np.array([0.0]),
    "weight": np.array([1.0]),
}


class Bench:
    """A rod of EI = 1000 N·mm² far from any tissue, every scalar of which a test may reach; steps in place."""

    def __init__(self, length=100.0, segments=64, base=(-1000.0, 0.0, 0.0), bevel=1, **constants):
        self.rod = rd.Rod(**{**_ON_A_BENCH, "segment": length / segments, **constants})
        self.s = np.zeros(rd.SIZE)
        self.s[[rd.BASE_X, rd.BASE_Y, rd.BASE_TURN]] = base
        self.s[rd.BEVEL] = bevel
        self.theta = np.full(segments, float(base[2]))
        self.work = np.zeros((rd.WORK_ROWS, segments + 1))
        self.channel = np.zeros((rd.CHANNEL_ROWS, 400))
        self.count = 0

    def step(self, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0, flip=-1.0):
        """Move and settle."""
        row = np.array([db_x, db_y, db_theta, dg_y, flip])
        self.count = rd.step(self.rod, self.s, self.theta, self.channel, self.count, self.work, row)
        return self

    def loaded(self, x=0.0, y=0.0):
        """The same under a dead load (N) at the tip."""
        self.s[rd.LOAD_X], self.s[rd.LOAD_Y] = x, y
        return self.step()

    @property
    def converged(self):
        return self.s[rd.CONVERGED] > 0.0

    @property
    def tip(self):
        """x, y, θ; place as seen from the base."""
        return self.s[[rd.TIP_X, rd.TIP_Y, rd.TIP_TURN]] - [self.s[rd.BASE_X], self.s[rd.BASE_Y], 0.0]

    @property
    def nodes(self):
        """(N + 1, 2) as seen from the base."""
        return (self.work[[rd.X, rd.Y]] - self.s[[rd.BASE_X, rd.BASE_Y]][:, None]).T


def plant(scenario=IDEAL, *, bevel=1, cell=None, **truth):
    """The exact plant of a scenario; `truth` are fields of `Truth`."""
    cell = 0.5 * scenario.phantom.contact_spacing_mm if cell is None else cell
    return ExactPlant(Truth(scenario, cell_mm=cell, **truth), bevel)


def move(plant, db_x=0.0, db_y=0.0, db_theta=0.0, dg_y=0.0, flip=False, times=1):
    """Step a plant, `times` alike; a step that finds no equilibrium is an error of the test."""
    for _ in range(times):
        plant.step(np.array([db_x, db_y, db_theta, dg_y, 1.0 if flip else -1.0]))
    if not plant.converged:
        raise ValueError(f"residual {plant._s[rd.RESIDUAL]:.3g} mm")
    return plant


def uncompiled(module: ModuleType) -> ModuleType:
    """A copy of a kernel module that runs as plain Python: slow, without compilation."""
    text = Path(module.__file__).read_text(encoding="utf-8")
    plain = text.replace("from flexneedle.mechanics.compile import", "from reference.plain import")
    if plain == text:
        raise ValueError(f"{module.__file__}: imports no decorators")
    copy = ModuleType(f"uncompiled_{module.__name__.rsplit('.', 1)[-1]}")
    sys.modules[copy.__name__] = copy  # NamedTuple looks its module up
    exec(compile(plain, module.__file__, "exec"), vars(copy))
    return copy
