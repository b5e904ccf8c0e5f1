"""Insertions for the injection of faults: a family of scenarios by number, the same for each fault.

Every second scenario is in space, with each kind of driver alternately. Half of the scenarios are presets with a random
target, the others random worlds (needle, bevel, 1 to 4 layers, target). All have a guide and fit the shipped rig file.
Trials are short: at most 40 mm from the start of the tip to the target. In every third case a fault that may occur in
a roll does so, and the rotation's motor takes the faults of the base's motor.
"""

from dataclasses import dataclass
from functools import cache
from itertools import count
from math import pi, radians

import numpy as np

import flexneedle
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.worlds import world

FIRST_WORLD, FIRST_SEED = 15_000_000, 750_000
MOST_PATH_MM = 40.0
_WORLDS_OF_A_CASE = 1000  # the first of these numbers that fits
_STREAM = 0x6661756C74
_PLANE = "plane"
_DRIVERS = {
    "two-axes": (2, "free"),
    "one-axis": (1, "free"),
    "two-axes-half-turns": (2, "half-turns"),
    "one-axis-half-turns": (1, "half-turns"),
}
"""Axes of the guide and rolls of the needle in space, by name of a world's rig."""
_TURNS_DEG = 1080.0  # the range of the rotation in the shipped rig file
_STEERED = 0.2  # of a world's offset along z, where only the bevel steers: within reach of most bevels
_SITES = (0.1, 0.25, 0.45, 0.7)  # from the tip, of the needle's length
_PLANNER = {"plan.samples": 64, "plan.iterations": 10, "plan.max_iterations": 20}
"""A search that is shorter than the default: the plan is only where the insertion begins."""


@dataclass(frozen=True)
class Case:
    """A number and its scenario. rolls: whether faults that may do so fall in a roll."""

    number: int
    scenario: Scenario
    rolls: bool

    @property
    def seed(self) -> int:
        """Seed of phantom, tracker and controller."""
        return FIRST_SEED + self.number

    @property
    def with_fibre(self) -> Scenario:
        """The scenario with a fibre in the needle."""
        sites = [round(share * self.scenario.needle.length_mm, 1) for share in _SITES]
        return self.scenario.with_values({"sensor": [{"kind": "fbg", "sites_mm": sites}]})

    @property
    def path_mm(self) -> float:
        """From the tip's start to the target depth."""
        return self.scenario.setup.tip_to_skin_mm + self.scenario.target.depth_mm

    @property
    def steps(self) -> float:
        """The path in longest steps."""
        return self.path_mm / self.scenario.setup.max_advance_mm

    def roll(self, rng: np.random.Generator) -> float:
        """The roll (rad) in which a fault falls: half a turn, or any angle from 60° where the driver has them."""
        return pi if self.scenario.setup.half_turns else float(rng.choice([-1, 1]) * rng.uniform(pi / 3, pi))

    def roll_s(self, roll: float) -> float:
        """Duration of a roll at its speed, without acceleration."""
        return abs(roll) / radians(self.scenario.setup.rotation_speed_deg_s)


@cache
def case(number: int) -> Case:
    """The case of a number."""
    rng = np.random.default_rng([_STREAM, number])
    driver = list(_DRIVERS)[number // 4 % len(_DRIVERS)] if number % 2 else _PLANE
    scenario = _world(number, driver) if number // 2 % 2 else _preset(rng, driver)
    return Case(number, _limited(scenario.with_values(_PLANNER)), rolls=number % 3 == 2)


def _limited(scenario: Scenario) -> Scenario:
    """The scenario with the rolls that the shipped rig can do."""
    turns = {} if scenario.setup.half_turns else {"setup.max_rotation_deg": _TURNS_DEG}
    return scenario.with_values(turns)


def _preset(rng: np.random.Generator, driver: str) -> Scenario:
    depth, lateral, out, gap = rng.uniform((25.0, -5.0, -3.0, 2.0), (35.0, 5.0, 3.0, 5.0)).round(2).tolist()
    values = {"target.depth_mm": depth, "target.lateral_mm": lateral, "setup.tip_to_skin_mm": gap}
    if driver == _PLANE:
        return flexneedle.load_scenario("phantom").with_values(values)
    guides, rotation = _DRIVERS[driver]
    reach = {2: 1.0, 1: 0.3 if rotation == "free" else 0.0}[guides]  # along z the bevel steers, or nothing
    values |= {
        "target.lateral_z_mm": round(reach * out, 2),
        "setup.guide_axes": guides,
        "setup.rotation": rotation,
    }
    return flexneedle.load_scenario("phantom3d").with_values(values)


def _world(number: int, driver: str) -> Scenario:
    rig, first = load_rig("emulated"), FIRST_WORLD + _WORLDS_OF_A_CASE * number
    for at in count(first):
        found = world(at)
        path = found.setup.tip_to_skin_mm + found.target.depth_mm
        if found.setup.has_guide and path <= MOST_PATH_MM:
            scenario = world(at, rig=driver)
            if scenario.setup.guide_axes == 1:
                out = round(_STEERED * scenario.target.lateral_z_mm, 3)
                scenario = scenario.with_values({"target.lateral_z_mm": out})
            if not fit_problems(rig, _limited(scenario)):
                return scenario
    raise AssertionError
