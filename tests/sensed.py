"""A virtual needle that is followed by an estimate with sensors along it."""

from functools import cache

import numpy as np

import flexneedle
from flexneedle.estimation.identification import Identification
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control
from tasks import begun_with

FBG = {"kind": "fbg", "sites_mm": [11, 26, 70, 105], "delay_sd_s": 0.05}
SLICE = {"kind": "slice", "plane_mm": 12.0, "normal": [1.0, 0.2, -0.1], "delay_sd_s": 0.05}
POINTS = {"kind": "points", "from_mm": -15.0, "to_mm": 30.0, "rate_hz": 10.0}
ROLLS = {14: 0.7, 34: -1.9}


def command(k, turn):
    """An advance with a moving guide, and turns by odd angles, before it or (spin) during it."""
    more = {turn: ROLLS.get(k, 0.0)}
    return Control(db_x=1.0, dg_y=0.1 * np.sin(0.3 * k), dg_z=0.08 * np.cos(0.2 * k), **more)


@cache
def followed(axes=2, count=50, turn="roll", first=(), **changes):
    """An estimate that has followed a virtual needle with three sensors besides the tracker, and the rig.

    first: rolls (rad) at rest before the needle advances.
    """
    name = {1: "phantom", 2: "phantom3d"}[axes]
    scenario = flexneedle.load_scenario(name).with_values({"sensor": [FBG, SLICE, POINTS], **changes})
    rig = virtual_rig(scenario, 0.0, Seeds.of(2))
    estimate = Identification().begin(begun_with(Simulator(scenario, threads=1)))
    rows = [command(k, turn) for k in range(count)]
    if axes == 1:
        rows = [Control(db_x=1.0, dg_y=0.1 * np.sin(0.3 * k), flip=k in ROLLS) for k in range(count)]
    for row in (*(Control(roll=roll) for roll in first), *rows):
        estimate = estimate.move(rig.driver.apply(row, 0.2))
        along = {name: one.read() for name, one in rig.sensors.items()}
        good = {name: [one for one in readings if one.rows] for name, readings in along.items()}
        estimate = estimate.observe([one for one in rig.tracker.read() if one.x is not None], good)
    return estimate, rig
