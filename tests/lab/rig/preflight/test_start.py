"""Start of an insertion: limits of axes and tip, which follow from the scenario and the rig."""

import math
import shlex

import numpy as np
import pytest
import tomli_w

import bench_rig
from bench_rig import rig
from flexneedle.lab.rig.preflight.start import StartLimits, _Mount, axis_start_problem, tip_problems
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.phantom.tracking.stage import median_pose, tilt_of
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import UNKNOWN, Control, Measurement, Pose

PLANE, SPACE = load_scenario("phantom"), load_scenario("phantom3d")
FREE = PLANE.with_values({"setup.guide_to_skin_mm": None})
TILTED = PLANE.with_values({"entry.lateral_mm": 3.0, "entry.slope_mrad": 50.0})
THICK = PLANE.with_values({"needle.outer_diameter_mm": 1.27})
REGISTERED = PLANE.with_values(
    {
        "tracker.registration.localisation_mm": 0.5,
        "tracker.registration.fiducials_mm": [[0, -40, 0], [0, 40, 0], [60, 0, 40], [60, 0, -40]],
    }
)
BACKLASH = {"axes__guide_y__backlash_mm": 0.1}


@pytest.mark.parametrize(
    ("changes", "name", "position", "problem"),
    [
        ({}, "guide_y", 0.02, ""),  # the tolerance
        (
            {},
            "guide_y",
            -0.03,
            "must be within 0.02 mm of 0, on the needle's axis: flexneedle rig ready RIG --scenario SCENARIO",
        ),
        ({}, "guide_z", 1.5, "must be within 0.02 mm"),
        ({}, "base_y", 0.3, "must be within 0.02 mm"),
        ({}, "base_z", math.nan, "must"),
        (BACKLASH, "guide_y", 0.07, ""),
        (BACKLASH, "guide_y", 0.08, "must be within 0.07 mm"),
        ({}, "insertion", 20.0, ""),  # anywhere
        ({}, "rotation", 1.0, ""),  # rolled before the insertion
    ],
)
def test_a_lateral_axis_starts_where_a_motion_to_0_may_end(changes, name, position, problem):
    made = rig(**changes)
    axes = dict(made.axes.items())
    axis = axes.get(name, axes["guide_y"])
    found = axis_start_problem(made, name, axis, position)
    assert found.startswith(problem)
    assert bool(found) == bool(problem)


@pytest.mark.parametrize(
    ("scenario", "control", "expected"),
    [
        (PLANE, Control(db_y=0.2), lambda mount: -0.2 * mount.offset),
        (PLANE, Control(db_theta=0.002), lambda mount: -0.002 * mount.turn),
        (PLANE, Control(dg_y=0.2), lambda mount: 0.2 * mount.guide),
        (FREE, Control(db_y=0.2), lambda mount: 0.2 * mount.offset),
        (FREE, Control(db_theta=0.002), lambda mount: 0.002 * mount.turn),
    ],
)
def test_a_base_off_the_axis_moves_the_tip_as_the_model_does(scenario, control, expected):
    simulator = Simulator(scenario)
    start = simulator.start()
    moved = simulator.step(start, control).tip - start.tip
    assert moved[1] == pytest.approx(expected(_Mount.of(scenario)), rel=0.02)


@pytest.mark.parametrize(
    ("scenario", "roll", "expected"),
    [
        # 3 sd of 0.068 (offset), 0.019 (angle) and 0.04 mm (tracker), half of 0.819, 0.057 of the clearance, 0.6.
        (PLANE, 0.0, (3.0024, 1.311, 0.588)),
        (PLANE, math.pi, (3.0024, 1.311, 0.588)),
        (PLANE, math.pi / 2, (3.0024, 1.311, 1.188)),
        (SPACE, 0.0, (3.0024, 1.311, 1.311)),
        (THICK, 0.0, (3.0024, 1.536, 0.813)),
        (FREE, 0.0, (3.0024, 3.031, 0.531)),
        (REGISTERED, 0.0, None),
    ],
)
def test_the_limits_of_the_tip_are_those_of_mount_tracker_and_needle(scenario, roll, expected):
    limits = StartLimits.of(scenario, roll)
    found = (limits.axial, *limits.lateral)
    if expected is None:
        assert all(np.greater(found, StartLimits.of(PLANE).lateral[1]))
        assert limits.slope > StartLimits.of(PLANE).slope
    else:
        assert found == pytest.approx(expected, abs=1e-3)


def start_of(scenario, x=0.0, y=0.0, z=0.0, theta=0.0, psi=0.0):
    """Return the pose at the start with these deviations."""
    at, slope = scenario.entry.lateral(scenario.setup.start_tip_x + x), scenario.entry.slope
    return Pose(
        scenario.setup.start_tip_x + x, at.real + y, at.imag + z, slope.real + theta, slope.imag + psi
    )


@pytest.mark.parametrize("scenario", [PLANE, SPACE, FREE, TILTED, THICK])
@pytest.mark.parametrize(
    ("off", "line"),
    [
        ({}, ""),
        ({"x": -2.9, "y": 0.5}, ""),
        ({"x": 3.2}, "x must be within 3.0 mm of -28.5: flexneedle rig ready RIG --scenario SCENARIO"),
        ({"y": -3.6}, "y must be within"),
        ({"z": 1.7}, "z must be within"),
        ({"theta": 0.02, "psi": 0.02}, ""),
        ({"theta": 0.1}, "dy/dx = "),
        ({"psi": -0.1}, "dz/dx = -100 mrad"),
        ({"theta": math.nan, "psi": math.nan}, ""),  # a tracker without directions
    ],
)
def test_a_tip_that_is_elsewhere_or_turned_is_a_line(scenario, off, line):
    found = tip_problems(rig(), scenario, start_of(scenario, **off))
    assert len(found) == bool(line)
    assert all(line in one for one in found)


@pytest.mark.parametrize("scenario", [PLANE, SPACE, FREE])
@pytest.mark.parametrize("x", [-1.0, 15.0])
def test_a_needle_that_may_be_in_tissue_is_withdrawn_before_anything_else(scenario, x):
    """Motions of a guide would bend it."""
    found = tip_problems(
        rig(), scenario, start_of(scenario, x=x - scenario.setup.start_tip_x, y=4.0, theta=0.2)
    )
    assert len(found) == 3
    assert all("withdraw it first: flexneedle rig retract RIG" in line for line in found)
    assert not any("jog" in line or "ready" in line for line in found)


def test_the_pose_of_the_tip_is_the_median_of_what_is_measured():
    found = [
        Measurement(0.0, 1.0, 2.0, 3.0, direction=(0.1, 0.2)),
        Measurement(0.1, 1.2, 2.2, None),
        Measurement(0.2, 9.0, 2.4, 3.4, direction=(math.nan, 0.0)),
        Measurement(0.3, None, None, None),
        Measurement(0.4, math.nan, 0.0, 0.0),
    ]
    assert median_pose(found) == Pose(1.2, 2.2, 3.0, 0.1, 0.2)
    assert median_pose(found[3:]) is None
    assert math.isnan(median_pose(found[1:2]).theta)


@pytest.mark.parametrize("turn", [0.3, 1.2, 2.5, 3.0, math.pi])
@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_a_sensor_that_points_elsewhere_is_a_line_also_where_its_sides_are_noise(turn, jitter):
    rng = np.random.default_rng(0)
    x = PLANE.setup.start_tip_x
    axes = [
        np.array([math.cos(turn), math.sin(turn) * math.cos(side), math.sin(turn) * math.sin(side)])
        for side in (rng.uniform(-3.0, 3.0, 99) if turn > 2.9 else np.full(99, 0.4))
    ]
    slopes = [tilt_of(axis + jitter * rng.standard_normal(3)) for axis in axes]
    pose = median_pose(Measurement(0.0, x, 0.0, 0.0, direction=slope) for slope in slopes)
    assert any("mrad: must be within" in line for line in tip_problems(rig(), PLANE, pose))
    assert all(map(math.isnan, UNKNOWN))


@pytest.mark.parametrize("name", ["rig.toml", "my rig.toml"])
def test_a_suggested_command_names_the_rig_as_the_user_did(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text(tomli_w.dumps(bench_rig.VALUES))
    made = load_rig(name)
    command = f"flexneedle rig ready {shlex.quote(name)} --scenario SCENARIO"
    assert axis_start_problem(made, "guide_y", made.axes.guide_y, 1.5).endswith(f": {command}")
    assert (
        f"flexneedle rig ready {shlex.quote(name)}" in tip_problems(made, PLANE, start_of(PLANE, y=-3.6))[0]
    )
