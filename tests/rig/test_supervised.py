"""The driver of the loop on a supervisor: columns and axes, rolls, limits; and whole insertions on the emulated rig."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

import flexneedle
from emulated_rig import emulated_rig, rig_file
from flexneedle.errors import CommandError, DriverError, RigError
from flexneedle.rig.emulator.coupled.truth import read_truth
from flexneedle.rig.supervised import Columns, SupervisedDriver
from flexneedle.rig.supervisor.machine import State
from flexneedle.rig.supervisor.messages import Done
from flexneedle.scenario.rig import load_rig
from flexneedle.trace.topics import READINGS
from flexneedle.types import Control
from stages import RIG
from synthetic import make_plan
from traces import contents

PHANTOM = flexneedle.load_scenario("phantom")
SPACE = flexneedle.load_scenario("phantom3d")
STEPS = st.floats(-1.0, 1.0)


@settings(deadline=None)
@given(st.lists(STEPS, min_size=5, max_size=5), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), STEPS)
def test_travelled_axes_give_the_control_that_has_moved_them(steps, slope_y, slope_z, spin):
    columns = Columns(complex(slope_y, slope_z))
    db_x, db_y, db_z, dg_y, dg_z = steps
    row = Control(db_x=db_x, db_y=db_y, db_z=db_z, dg_y=dg_y, dg_z=dg_z, spin=spin)
    np.testing.assert_allclose(columns.control(columns.travel(row), 0.0, spin), row, atol=1e-9)


def test_along_a_tilted_entry_only_the_insertion_axis_moves():
    columns = Columns(0.1 - 0.05j)
    travel = columns.travel(Control(db_x=1.0, db_y=0.1, db_z=-0.05))
    assert travel == {"insertion": pytest.approx(math.sqrt(1.0 + 0.1**2 + 0.05**2))}


class Axes:
    """A supervisor that turns and travels as commanded, but for what it adds to the rotation."""

    rig = load_rig("emulated")

    def __init__(self, *more):
        self.more, self.steps = list(more), []

    def step(self, roll, travel, duration, expected):
        self.steps.append((roll, dict(travel), duration, expected))
        turned = roll + travel.get("rotation", 0.0) + (self.more.pop(0) if self.more else 0.0)
        return Done(len(self.steps), {**travel, "rotation": turned}, 1.0, 1.4, State.INSERTING, "", None)


def test_half_turns_go_to_and_fro_and_do_not_drift():
    axes = Axes(0.003, -0.004, 0.002, 0.001)
    driver = SupervisedDriver(axes, PHANTOM, 0.0)
    done = [driver.apply(Control(db_x=0.5, flip=True), 0.2).control for _ in range(4)]
    assert [step[0] for step in axes.steps] == [math.pi, -math.pi, math.pi, -math.pi]
    assert [(row.roll, row.spin) for row in done] == [(roll, 0.0) for roll, *_ in axes.steps]


def test_a_needle_that_begins_rolled_over_rolls_back():
    axes = Axes()
    SupervisedDriver(axes, PHANTOM, math.pi).apply(Control(flip=True), 0.2)
    assert axes.steps[0][0] == -math.pi


def test_a_half_turn_that_was_interrupted_ends_the_insertion():
    driver = SupervisedDriver(Axes(-1.0), PHANTOM, 0.0)
    with pytest.raises(DriverError, match=r"interrupted at 122\.7° of 180°: the bevel is not known"):
        driver.apply(Control(flip=True), 0.2)


def test_a_half_turn_that_did_not_begin_is_none():
    assert SupervisedDriver(Axes(-math.pi), PHANTOM, 0.0).apply(Control(flip=True), 0.2).control.roll == 0.0


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (Control(db_x=0.5, roll=0.7), (0.71, 0.0)),
        (Control(db_x=0.5, spin=0.3), (0.0, 0.31)),
        (Control(db_x=0.5, roll=0.7, spin=0.3), (0.7, 0.31)),
        (Control(db_x=0.5), (0.0, 0.01)),
    ],
)
def test_a_free_rotation_is_reported_as_measured(command, expected):
    free = SPACE.with_values({"setup.max_rotation_deg": 720.0})
    row = SupervisedDriver(Axes(0.01), free, 0.0).apply(command, 0.2).control
    assert (row.roll, row.spin) == pytest.approx(expected)


def test_a_command_beyond_a_limit_of_the_scenario_is_not_sent():
    axes = Axes()
    with pytest.raises(CommandError, match=r"db_x = 1\.1: must be at most 1 mm"):
        SupervisedDriver(axes, PHANTOM, 0.0).apply(Control(db_x=1.1), 0.2)
    assert axes.steps == []


def test_a_reading_is_expected_on_the_line_of_the_needle():
    axes = Axes()
    driver = SupervisedDriver(axes, PHANTOM, 0.0)
    tip = np.array([10.0, 2.0, 0.0, 0.1, 0.0])
    driver.expect(SimpleNamespace(tip=tip, tip_sd=0.2), Control(db_x=1.0))
    driver.apply(Control(db_x=1.0), 0.2)
    expected = axes.steps[0][3]
    assert expected.begin == (10.0, 2.0, 0.0)
    assert expected.end == pytest.approx((11.0, 2.0 + math.tan(0.1), 0.0))
    assert expected.most_off == pytest.approx(2.0 + 3 * 0.2)


OF_A_PHANTOM = ("/needle/true_shape", "/tip/true", "/tissue/true_strain_energy")


def assert_trace_of_a_simulated_run(done, folder, without):
    """It has the same topics, types and names of values, without the truth, which only a phantom knows."""
    simulated = flexneedle.insert(done.scenario, done.plan, done.seed)
    recorded = contents(flexneedle.save(done, folder / "recorded"))
    expected = contents(flexneedle.save(simulated, folder / "simulated"))
    assert set(expected) - set(recorded) == set(without)
    assert recorded[READINGS][1] >= expected[READINGS][1]  # a tracker may report more sensors
    expected[READINGS] = recorded[READINGS]
    assert recorded == {topic: found for topic, found in expected.items() if topic not in without}


@pytest.mark.long
@pytest.mark.parametrize("dry", [False, True])
def test_an_insertion_on_the_emulated_rig_ends_at_its_target(tmp_path, dry):
    scenario = PHANTOM.with_values({"target.depth_mm": 12.0, "target.lateral_mm": 1.0})
    plan = flexneedle.plan(scenario, seed=0)
    path, truth = rig_file(tmp_path), tmp_path / "truth.csv"
    seed = 862  # its tip starts 2.5 mm behind the scenario's, more than it may go past the target
    with emulated_rig(path, "phantom", "--seed", str(seed), "--truth", truth) as rig:
        address = rig.ready["ready"]["galil"]
        path.write_text(path.read_text().replace("127.0.0.1:0", address))
        done = flexneedle.insert(scenario, plan, seed, rig=path, dry_run=dry)
        assert rig.ask("TPA") == (" 0\r\n:" if dry else rig.ask("TPA"))
    found = read_truth(truth)
    assert found.tips[0, 0] < PHANTOM.setup.start_tip_x - PHANTOM.guard.past_target_mm
    assert done.outcome == "done"
    assert done.reached
    assert done.ticks["count"] > 100
    assert done.dry_run is dry
    assert_trace_of_a_simulated_run(done, tmp_path, without=() if dry else OF_A_PHANTOM)
    if dry:
        assert np.ptp(found.positions["insertion"]) == 0.0
        assert done.true_error_mm < 0.3
        return
    assert math.dist(found.tips[-1, :3], done.target) < 0.3
    assert done.periods[-1].true_tip is None
    assert np.mean([period.innovation[0] for period in done.periods]) == pytest.approx(0.0, abs=0.03)


def test_nothing_is_switched_on_where_the_tip_is_not_at_the_start(tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[1])  # where ros_rig is
    path, notes = tmp_path / "rig.toml", tmp_path / "notes"
    devices = {"driver": {"kind": "ros_rig:motors", "notes": str(notes)}, "tracker": {"kind": "ros_rig:Tip"}}
    path.write_text(tomli_w.dumps(RIG | devices))
    scenario = PHANTOM.with_values({"setup.tip_to_skin_mm": PHANTOM.setup.tip_to_skin_mm + 9.0})
    plan = make_plan("manipulation", (25.0, 1.0, 0.0), 4)
    with pytest.raises(RigError, match=r"tip = -28\.\d.* must be within"):
        flexneedle.insert(scenario, plan, 0, rig=path)
    assert {json.loads(line)[0] for line in notes.read_text().splitlines()} <= {"stop", "close"}
