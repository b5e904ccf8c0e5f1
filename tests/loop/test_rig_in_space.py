"""The virtual rig in space: its start at the entry, the checks of its readings, the range of its rotation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flexneedle import Control, Simulator, load_scenario
from flexneedle.errors import CommandError
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS
from flexneedle.simulator.control import limit_half_turn
from flexneedle.types import Measurement, VerdictKind
from rooms import STILL

SPACE = load_scenario("phantom").with_values({"setup.axes": 2, "phantom.motor_resolution_mm": 0.0})
ENTERED = SPACE.with_values(
    {
        "entry.lateral_mm": 3.0, "entry.lateral_z_mm": -2.0, "entry.slope_mrad": 60.0, "entry.slope_z_mrad": 25.0,
        "target.lateral_mm": 5.0, "phantom.guide_clearance_mm": 0.0,
    }
)  # fmt: skip


@pytest.mark.parametrize("kind", PLANTS)
def test_a_plant_starts_straight_on_the_line_of_the_entry(kind):
    """It then continues along the line in air."""
    phantom = Phantom(Truth(ENTERED), 0.0, kind)
    for _ in range(2):
        pose = phantom.pose_at(phantom.now())
        line = ENTERED.entry.lateral(pose.x)
        assert complex(pose.y, pose.z) == pytest.approx(line, abs=2e-3)
        assert complex(pose.theta, pose.psi) == pytest.approx(ENTERED.entry.slope, abs=2e-4)
        phantom.apply(Control(db_x=1.0), 0.2)


@pytest.mark.parametrize("kind", PLANTS)
def test_the_travel_of_the_guide_is_limited_from_the_entry(kind):
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
    phantom.apply(Control(roll=-1.0), 0.2)
    with pytest.raises(CommandError, match="angle of the needle must be at most"):
        phantom.apply(Control(roll=-0.1), 0.2)


def verdict(reading, axes=2, limit=1.0, predicted=(10.0, 1.0, -2.0)):
    monitor = Monitor(SPACE.monitor, axes)
    return monitor.check(reading, lambda _: predicted, 0.0, 1.0, limit)[1]


def test_in_space_the_distance_from_the_prediction_has_three_components():
    """In the plane z is not compared; it has a limit."""
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


def read(values, roll=1.0):
    """The last reading of a needle that has left the plane, and the true tip then."""
    rig = virtual_rig(SPACE.with_values(values), roll, Seeds(*np.random.SeedSequence(4).spawn(3)), "model")
    for _ in range(45):
        rig.driver.apply(Control(db_x=1.0, dg_z=0.05), 0.2)
    return rig.tracker.read()[-1], rig.truth().tip


def test_the_tracker_of_a_needle_in_space_measures_all_of_it():
    """The position and, if the tracker measures it, the direction."""
    reading, true = read({"tracker.direction_jitter_mrad": 1.0, "tracker.jitter_mm": 0.01}, math.pi / 2)
    assert reading.z == pytest.approx(true[2], abs=0.3)
    assert reading.direction[1] == pytest.approx(true[4], abs=0.01)
    assert abs(true[2]) > 0.5


@pytest.mark.parametrize("room", [{}, {"tracker.environment": STILL}])
def test_a_bias_of_the_tracker_is_in_all_coordinates(room):
    quiet = {"tracker.jitter_mm": 0.0, "phantom.delay_periods": 0.0, "phantom.missing_fraction": 0.0}
    reading, tip = read({**quiet, "phantom.tracker_bias_mm": 0.5, **room})
    off = np.array([reading.x, reading.y, reading.z]) - tip[:3]
    assert np.linalg.norm(off) == pytest.approx(0.5)
    assert np.abs(off).min() > 0.01


def test_an_error_of_the_registration_turns_the_measured_direction_with_the_position():
    """By the same rotation as the positions along the path."""
    fiducials = [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0], [0.0, 0.0, 60.0]]
    registration = {
        "rotation": [1.0, 0.0, 0.0, 0.0], "translation_mm": [0.0, 0.0, 0.0],
        "fiducials_mm": fiducials, "localisation_mm": 2.0,
    }  # fmt: skip
    straight = {
        "tracker.registration": registration, "tracker.direction_jitter_mrad": 1e-6, "tracker.jitter_mm": 0.0,
        "needle.bevel.offset_mm": 0.0, "phantom.start_angle_sd_mrad": 0.0, "phantom.initial_bend_mm": 0.0,
        "phantom.missing_fraction": 0.0, "phantom.start_offset_sd_mm": 0.0, "phantom.run_out_mm": 0.0,
    }  # fmt: skip
    rig = virtual_rig(SPACE.with_values(straight), 0.0, Seeds(*np.random.SeedSequence(4).spawn(3)), "model")
    first = rig.tracker.read()[-1]
    rig.driver.apply(Control(db_x=1.0), 0.2)
    rig.clock.wait(1.0)
    last = rig.tracker.read()[-1]
    seen = np.array([last.y - first.y, last.z - first.z]) / (last.x - first.x)
    assert np.abs(seen).min() > 1e-3
    np.testing.assert_allclose(np.tan(first.direction), seen, atol=1e-5)


def test_a_sensor_that_moves_along_z_alone_is_not_frozen():
    monitor = Monitor(SPACE.monitor, 2)
    for k in range(40):
        tip = (10.0, 1.0, -2.0 + 0.05 * k)
        reading = Measurement(0.025 * k, *tip)
        monitor, checked = monitor.check(reading, lambda _, tip=tip: tip, 0.025 * k, 1.0, 1.0)
        assert checked.ok


# ---- half turns


@pytest.mark.parametrize(
    ("angle", "roll", "expected"),
    [
        (0.0, math.pi, math.pi), (math.pi, math.pi, -math.pi), (0.0, -math.pi, math.pi), (-math.pi, math.pi, math.pi),
        (math.pi, 2.0 * math.pi, 0.0), (0.0, 3.0 * math.pi, math.pi), (math.pi, 0.0, 0.0),
    ],
)  # fmt: skip
def test_a_driver_of_half_turns_turns_to_and_fro(angle, roll, expected):
    assert limit_half_turn(angle, roll) == expected


@pytest.mark.parametrize("kind", PLANTS)
def test_with_half_turns_the_shaft_is_never_wound_up(kind):
    """After three flips it has turned by half a turn; the model's needle is at the same angle."""
    scenario = SPACE.with_values({"setup.rotation": "half-turns", "phantom.friction_mn_per_mm": 50.0})
    phantom, simulator = Phantom(Truth(scenario), 0.0, kind), Simulator(scenario)
    state, applied = simulator.start(), []
    for _ in range(3):
        applied.append(phantom.apply(Control(db_x=1.0, flip=True), 0.2).control)
        state = simulator.step(state, applied[-1])
    assert [each.roll for each in applied] == [math.pi, -math.pi, math.pi]
    assert state.roll == math.pi
    assert simulator.replay(simulator.start(), applied)[0].roll == math.pi
    free = Simulator(SPACE)
    assert free.step(free.step(free.start(), applied[0]), applied[0]).roll == 2.0 * math.pi


def test_rotation_friction_in_space_is_the_axial_friction_unless_set():
    """Friction times outer radius on each mm; in the plane a flip leaves no couple."""

    def couple(scenario):
        return PLANTS["exact"](Truth(scenario), 0.0).rod.rotation_friction

    radius = 0.5 * SPACE.needle.outer_diameter
    assert couple(SPACE) == pytest.approx(5e-3 * radius)
    assert couple(SPACE.with_values({"phantom.friction_mn_per_mm": 20.0})) == pytest.approx(20e-3 * radius)
    assert couple(SPACE.with_values({"phantom.rotation_friction_mn": 3.0})) == pytest.approx(3e-3)
    assert couple(load_scenario("phantom")) == 0.0
