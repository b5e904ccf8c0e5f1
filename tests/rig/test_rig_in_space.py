"""The virtual rig in space: its start at the entry, the checks of its readings, the range of its rotation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flexneedle import Control, load_scenario
from flexneedle.errors import CommandError
from flexneedle.rig.monitor.monitor import Monitor
from flexneedle.rig.phantom.draw import Truth
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import PLANTS
from flexneedle.types import Measurement, VerdictKind

SPACE = load_scenario("phantom").with_values({"setup.axes": 2, "phantom.motor_resolution_mm": 0.0})
ENTERED = SPACE.with_values(
    {
        "entry.lateral_mm": 3.0, "entry.lateral_z_mm": -2.0, "entry.slope_mrad": 60.0, "entry.slope_z_mrad": 25.0,
        "target.lateral_mm": 5.0, "phantom.guide_clearance_mm": 0.0,
    }
)  # fmt: skip


@pytest.mark.parametrize("kind", PLANTS)
def test_a_plant_starts_straight_on_the_line_of_the_entry(kind):
    """And goes on along it in air."""
    phantom = Phantom(Truth(ENTERED), 0.0, kind)
    for _ in range(2):
        pose = phantom.pose_at(phantom.now())
        line = ENTERED.entry.lateral(pose.x)
        assert complex(pose.y, pose.z) == pytest.approx(line, abs=2e-3)
        assert complex(pose.theta, pose.psi) == pytest.approx(ENTERED.entry.slope, abs=2e-4)
        phantom.apply(Control(db_x=1.0), 0.2)


@pytest.mark.parametrize("kind", PLANTS)
def test_the_limits_of_the_guide_are_those_of_its_travel_from_the_entry(kind):
    phantom = Phantom(Truth(ENTERED.with_values({"setup.max_guide_travel_mm": 1.0})), 0.0, kind)
    for _ in range(2):
        phantom.apply(Control(dg_y=0.5), 0.2)
    with pytest.raises(CommandError, match=r"dg_y = 1\.1: sum of the steps must be at most 1 mm"):
        phantom.apply(Control(dg_y=0.1), 0.2)


def test_the_range_of_the_rotation_counts_from_the_roll_at_the_start():
    scenario = SPACE.with_values({"setup.max_rotation_deg": 90.0})
    phantom = Phantom(Truth(scenario), 1.0, "model")
    phantom.apply(Control(roll=-2.0), 0.2)
    phantom.apply(Control(roll=0.3, spin=0.2), 0.2)
    with pytest.raises(CommandError, match="angle of the needle must be at most"):
        phantom.apply(Control(roll=-1.2), 0.2)


def verdict(reading, axes=2, limit=1.0, predicted=(10.0, 1.0, -2.0)):
    monitor = Monitor(SPACE.monitor, axes)
    return monitor.check(reading, lambda _: predicted, 0.0, 1.0, limit)[1]


def test_in_space_the_distance_from_the_prediction_has_three_components():
    """In the plane z is not compared, but limited."""
    good = Measurement(0.0, 10.0, 1.0, -2.0)
    assert verdict(good).ok
    off = replace(good, z=-3.1)
    assert verdict(off).kind is VerdictKind.INNOVATION
    assert verdict(off, axes=1).ok
    far = replace(good, z=-12.0)
    assert verdict(far, predicted=(10.0, 1.0, -12.0)).ok
    assert verdict(far, axes=1, predicted=(10.0, 1.0, 0.0)).kind is VerdictKind.OUT_OF_PLANE


def test_in_space_a_reading_without_z_is_missing():
    assert verdict(Measurement(0.0, 10.0, 1.0)).kind is VerdictKind.MISSING
    assert verdict(Measurement(0.0, 10.0, 1.0), axes=1).ok


def test_the_tracker_of_a_needle_in_space_measures_all_of_it():
    """Position and, where it is in use, direction, of a needle that has left the plane."""
    from flexneedle.rig.virtual import Seeds, virtual_rig

    scenario = SPACE.with_values({"tracker.direction_jitter_mrad": 1.0, "tracker.jitter_mm": 0.01})
    seeds = Seeds(*np.random.SeedSequence(4).spawn(3))
    rig = virtual_rig(scenario, math.pi / 2, seeds, "model")
    for _ in range(45):
        rig.driver.apply(Control(db_x=1.0, dg_z=0.05), 0.2)
    reading = rig.tracker.read()[-1]
    true = rig.truth().tip
    assert reading.z == pytest.approx(true[2], abs=0.3)
    assert reading.direction[1] == pytest.approx(true[4], abs=0.01)
    assert abs(true[2]) > 0.5
