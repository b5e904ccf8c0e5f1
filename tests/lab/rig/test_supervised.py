"""The driver of the loop on a supervisor: columns and axes, rolls, limits; and whole insertions on the emulated rig."""

import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

import flexneedle
from emulated_rig import emulated_rig, rig_file
from flexneedle.control.interface import Decision
from flexneedle.errors import CommandError, DriverError, RefusedError, RigError
from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.rig.axis_columns import AxisColumns
from flexneedle.lab.rig.rig_file import SensorSection, load_rig
from flexneedle.lab.rig.supervised import SupervisedDriver, SupervisedRig, Tick
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import MotionResult, TickReport
from flexneedle.loop.closed_loop import _carry_out
from flexneedle.loop.events import Gate, PeriodEnded, Stream
from flexneedle.loop.step import Step as LoopStep
from flexneedle.record.topics import READINGS
from flexneedle.results import Action
from flexneedle.simulator.control import travel_time
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import UNKNOWN, Control, Pose, Reading
from stages import RIG
from synthetic import make_plan
from traces import contents

PHANTOM = flexneedle.load_scenario("phantom")
SPACE = flexneedle.load_scenario("phantom3d")
STEPS = st.floats(-1.0, 1.0)


@given(st.lists(STEPS, min_size=5, max_size=5), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), STEPS)
def test_travelled_axes_give_the_control_that_has_moved_them(steps, slope_y, slope_z, spin):
    columns = AxisColumns(complex(slope_y, slope_z))
    db_x, db_y, db_z, dg_y, dg_z = steps
    row = Control(db_x=db_x, db_y=db_y, db_z=db_z, dg_y=dg_y, dg_z=dg_z, spin=spin)
    np.testing.assert_allclose(columns.to_control(columns.to_travel(row), 0.0, spin), row, atol=1e-9)


def test_along_a_tilted_entry_only_the_insertion_axis_moves():
    columns = AxisColumns(0.1 - 0.05j)
    travel = columns.to_travel(Control(db_x=1.0, db_y=0.1, db_z=-0.05))
    assert travel == {"insertion": pytest.approx(math.sqrt(1.0 + 0.1**2 + 0.05**2))}


class Axes:
    """A supervisor that moves as commanded, with errors of the rotation."""

    rig = load_rig("emulated")

    def __init__(self, *more):
        self.more, self.steps = list(more), []

    def step(self, roll, travel, duration, expected, roll_duration):
        self.steps.append((roll, dict(travel), duration, expected, roll_duration))
        turned = roll + travel.get("rotation", 0.0) + (self.more.pop(0) if self.more else 0.0)
        return MotionResult(
            len(self.steps), {**travel, "rotation": turned}, 1.0, 1.4, SupervisorState.INSERTING, "", None
        )


def test_half_turns_alternate_and_do_not_drift():
    axes = Axes(0.003, -0.004, 0.002, 0.001)
    driver = SupervisedDriver(axes, PHANTOM, 0.0)
    done = [driver.apply(Control(db_x=0.5, flip=True), 0.2).control for _ in range(4)]
    assert [step[0] for step in axes.steps] == [math.pi, -math.pi, math.pi, -math.pi]
    assert [(row.roll, row.spin) for row in done] == [(roll, 0.0) for roll, *_ in axes.steps]
    rolled = Axes()
    SupervisedDriver(rolled, PHANTOM, math.pi).apply(Control(flip=True), 0.2)
    assert rolled.steps[0][0] == -math.pi


def test_a_half_turn_that_was_interrupted_ends_the_insertion_unless_it_did_not_begin():
    driver = SupervisedDriver(Axes(-1.0), PHANTOM, 0.0)
    with pytest.raises(DriverError, match=r"interrupted at 122\.7° of 180°: the bevel angle is unknown"):
        driver.apply(Control(flip=True), 0.2)
    none = SupervisedDriver(Axes(-math.pi), PHANTOM, 0.0).apply(Control(flip=True), 0.2)
    assert none.control.roll == 0.0


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


@pytest.mark.parametrize("command", [Control(db_x=1.0), Control(db_y=0.01), Control(dg_y=0.5, flip=True)])
def test_a_travel_faster_than_the_speeds_of_the_scenario_is_not_sent(command):
    axes, shortest = Axes(), travel_time(PHANTOM.setup, command)
    driver = SupervisedDriver(axes, PHANTOM, 0.0)
    for duration in (0.999 * shortest, 0.0, math.nan):
        with pytest.raises(RefusedError, match=rf"must take at least {shortest:g} s, at the speeds"):
            driver.apply(command, duration)
    assert axes.steps == []
    driver.apply(command, shortest)
    assert axes.steps[0][2] == shortest


@given(st.integers(1, 8), st.floats(0.0, 1e-5))
def test_the_loop_gives_a_travel_the_duration_that_its_driver_requires(readings, more):
    """Also a travel of a whole number of readings with a rounding error."""
    axes = Axes()
    advance = PHANTOM.setup.insertion_speed_mm_s * PHANTOM.tracker.period * (readings + more)
    command = Control(db_x=min(advance, PHANTOM.setup.max_advance_mm))
    moved = LoopStep(Action.MOVE, Decision(command, "as planned"))
    _carry_out(PHANTOM, SimpleNamespace(driver=SupervisedDriver(axes, PHANTOM, 0.0)), moved, 0.0)
    assert len(axes.steps) == 1


@pytest.mark.parametrize("command", [Control(db_x=1.0), Control(db_x=1.0, db_y=0.4, dg_y=-0.3, flip=True)])
def test_the_tip_is_expected_where_the_model_moves_it_from_its_estimate(command):
    """Base, guide and bevel move the tip off the line of the needle, most of all in air."""
    axes = Axes()
    driver = SupervisedDriver(axes, PHANTOM, 0.0)
    simulator = Simulator(PHANTOM)
    state, _ = simulator.replay(simulator.start(), np.array([Control(db_x=1.0)] * 5))
    off = np.array([0.2, 0.3, 0.0, 0.01, 0.0])
    estimate = SimpleNamespace(simulator=simulator, state=state, tip=state.tip + off, tip_sd=0.2)
    driver.expect(estimate, command, True)
    driver.apply(command, 0.2)
    expected = axes.steps[0][3]
    assert expected.begin == pytest.approx((state.tip + off)[:3])
    assert expected.end == pytest.approx((simulator.step(state, command).tip + off)[:3])
    assert (expected.most_off, expected.sensed) == (pytest.approx(2.0 + 3 * 0.2), True)


class Resting:
    """A supervisor of a rig at rest, with positions of axes and tip; records its calls."""

    status = "ok"
    tip_problem = "port 1 cannot be initialised: worn"

    def __init__(self, tips=((-28.5, 0.0, 0.0),), **positions):
        emulated = load_rig("emulated")
        quick = emulated.loop.model_copy(update={"decision_ms": 70.0})
        self.rig = emulated.model_copy(update={"loop": quick})
        self.positions = {name: 0.0 for name, _ in self.rig.axes.items()} | positions
        self.tips, self.calls = list(tips), []

    def __call__(self, *_task):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_exception):
        self.calls.append("closed")

    def read(self):
        self.calls.append("read")

    def tip(self, _within):
        return self.tips[0] and Pose(*(self.tips.pop(0) if len(self.tips) > 1 else self.tips[0]), *UNKNOWN)

    def arm(self, deepest):
        self.calls.append(("armed", round(deepest, 6)))

    def move_to(self, axis, _position, speed):
        self.calls.append(axis if speed == math.radians(360.0) else (axis, speed))

    def wait(self, _seconds):
        pass

    def now(self):
        return 0.0


@pytest.fixture
def opened(monkeypatch):
    """Return a function that opens a rig at rest for a plan 40 mm deep and returns the calls, "asked" included."""

    def open_rig(rest, dry=False, scenario=PHANTOM):
        monkeypatch.setattr("flexneedle.lab.rig.supervised.SupervisorClient", rest)
        plan, gate = make_plan("manipulation", (40.0, 5.0, 0.0), 0), Gate()
        gate.confirm = lambda _supervisor: rest.calls.append("asked")
        with SupervisedRig(rest.rig, dry_run=dry).open(scenario, plan, 0, Stream(gate=gate)) as ports:
            if not dry:
                assert ports.expect == ports.driver.expect
            assert ports.deadline == (None if dry else pytest.approx(0.07))
        return rest.calls

    return open_rig


def test_the_tip_is_measured_again_after_the_confirmation(opened):
    rest = Resting(tips=[(-28.5, 0.0, 0.0), (-27.0, 0.0, 0.0)])
    assert opened(rest) == ["read", "asked", "read", ("armed", 69.0), "rotation", "closed"]


def test_the_loop_gets_the_sensors_of_the_rig_and_in_a_dry_run_virtual_ones(monkeypatch):
    closed = []

    def gratings(_settings, clock, sensor):
        reading = Reading(clock.now(), ((1e-3, 0.0),) * len(sensor.sites_mm))
        found = [(reading,), (reading,)]  # before and after the start
        return SimpleNamespace(read=found.pop, status="ok", close=lambda: closed.append(sensor.title))

    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(gratings=gratings))
    monkeypatch.setattr("flexneedle.lab.rig.supervised.SupervisorClient", Resting())
    parts = (SensorSection(name="fbg", kind="own:gratings"),)
    rig = load_rig("emulated").model_copy(update={"sensor": parts})
    scenario = PHANTOM.with_values({"sensor": [{"kind": "fbg", "sites_mm": [20.0, 60.0]}]})
    plan = make_plan("manipulation", (40.0, 5.0, 0.0), 0)
    for dry in (False, True):
        with SupervisedRig(rig, dry_run=dry).open(scenario, plan, 0, Stream(gate=Gate())) as ports:
            assert list(ports.sensors) == ["fbg"]
            assert len(ports.sensors["fbg"].read()) == (0 if dry else 1)
            assert closed == ["fbg"] * dry
    assert closed == ["fbg"]


def test_the_needle_rolls_at_the_scenarios_speed(opened):
    slow = PHANTOM.with_values({"setup.rotation_speed_deg_s": 90.0})
    assert ("rotation", math.radians(90.0)) in opened(Resting(), scenario=slow)
    axes = Axes()
    driver = SupervisedDriver(axes, slow, 0.0)
    driver.apply(Control(db_x=0.5, flip=True), 0.2)
    assert axes.steps[0][4] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("rest", "line"),
    [
        # 110 mm less 40 mm + 2 mm + 28.5 mm are 39.5 mm.
        (Resting(insertion=39.6), "insertion: at 39.6 mm, 70.4 mm to the high end of range_mm (110)"),
        (Resting(rotation=math.radians(1090)), "rotation: at 1090 deg: beyond the soft limits"),
        (Resting(tips=[(-20.0, 0.0, 0.0)]), "tip = -20.0, 0.0, 0.0 mm: x must be within 3.0 mm of -28.5"),
        (Resting(tips=[None]), "tip: not measured for 1 s (port 1 cannot be initialised: worn): measure it"),
        (Resting(guide_z=1.5), "guide_z: at 1.5 mm: must be within 0.02 mm of 0, on the needle's axis"),
    ],
)
def test_an_insertion_without_room_is_refused_before_anybody_is_asked(opened, rest, line):
    with pytest.raises(RigError) as caught:
        opened(rest)
    assert str(caught.value).startswith(line)
    assert rest.calls == ["read", "closed"]


def test_an_insertion_that_just_has_room_begins_unless_the_room_is_lost_during_the_question(opened):
    assert ("armed", 70.5) in opened(Resting(insertion=39.5))
    rest = Resting(insertion=39.5, tips=[(-28.5, 0.0, 0.0), (-29.0, 0.0, 0.0)])
    with pytest.raises(RigError, match=r"the target is 71 mm"):
        opened(rest)
    assert rest.calls == ["read", "asked", "read", "closed"]


OF_A_PHANTOM = (
    "/needle/true_shape",
    "/tip/true",
    "/tissue/true_strain_energy",
    "/tissue/true_relative_energy",
)


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
@pytest.mark.parametrize("mode", ["tracking", "moves"])
def test_a_home_is_found_at_the_switch_of_the_emulated_rig_again_and_again(tmp_path, mode):
    """Each time at the same place; with moves the last target still waits as the axis reaches its switch."""
    home = 'channel = "C"\nhome = "reverse-limit"\nhome_mm = -15.0'
    replaced = {'channel = "C"': home, "speed_mm_s = 10.0": "speed_mm_s = 40.0"}
    path, truth = rig_file(tmp_path, **replaced, **{'kind = "galil"': f'kind = "galil"\nmode = "{mode}"'}), []
    with emulated_rig(path, "phantom", "--truth", tmp_path / "truth.csv") as rig:
        path.write_text(path.read_text().replace("127.0.0.1:0", rig.ready["ready"]["galil"]))
        with SupervisorClient.of_operator(load_rig(path)) as supervisor:
            for further in (0.37, 1.1, 0.0):
                supervisor.arm()
                supervisor.home("guide_y")
                assert supervisor.positions["guide_y"] == pytest.approx(-14.4, abs=0.02)
                truth.append(read_truth(tmp_path / "truth.csv").positions["guide_y"][-1])
                supervisor.arm()
                supervisor.move_to("guide_y", -14.4 + further)
    # The switch is 15 mm off, and the axis slows down there before it backs off.
    assert truth == pytest.approx([-14.6] * 3, abs=0.3)
    assert max(truth) - min(truth) < 0.04  # the distance in which it slows down from 4 mm/s


@pytest.mark.long
@pytest.mark.parametrize("dry", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_insertion_on_the_emulated_rig_ends_at_its_target(tmp_path, dry):
    """Also if the rig is checked meanwhile, which the tracker's port refuses."""
    checks = []

    def check(event):
        if isinstance(event, PeriodEnded) and event.period.index == 3:
            command = [sys.executable, "-m", "flexneedle", "rig", "check", path]
            checks.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))

    scenario = PHANTOM.with_values({"target.depth_mm": 12.0, "target.lateral_mm": 1.0})
    plan = flexneedle.plan(scenario, seed=0)
    path, truth = rig_file(tmp_path), tmp_path / "truth.csv"
    seed = 862  # its tip starts 2.5 mm behind the scenario's, more than it may go past the target
    with emulated_rig(path, "phantom", "--seed", str(seed), "--truth", truth) as rig:
        address = rig.ready["ready"]["galil"]
        path.write_text(path.read_text().replace("127.0.0.1:0", address))
        done = flexneedle.insert(
            scenario, plan, seed, rig=SupervisedRig(path, dry_run=dry), listeners=[check]
        )
        printed = checks[0].communicate()[0]
        counts = float(rig.ask("TPA").strip(" \r\n:"))
    assert "ok       driver     reply" in printed
    assert "PROBLEM  tracker    connection" in printed
    found = read_truth(truth)
    advanced = sum(period.applied.db_x for period in done.periods)
    scale = load_rig(path).axes.insertion.scale
    assert counts == pytest.approx(0.0 if dry else scale * advanced, abs=0.02 * scale)
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


@pytest.mark.long
def test_nothing_is_switched_on_where_the_tip_is_not_at_the_start(tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])  # where ros_rig is
    path, notes = tmp_path / "rig.toml", tmp_path / "notes"
    devices = {"driver": {"kind": "ros_rig:motors", "notes": str(notes)}, "tracker": {"kind": "ros_rig:Tip"}}
    path.write_text(tomli_w.dumps(RIG | devices))
    scenario = PHANTOM.with_values({"setup.tip_to_skin_mm": PHANTOM.setup.tip_to_skin_mm + 9.0})
    plan = make_plan("manipulation", (25.0, 1.0, 0.0), 4)
    with pytest.raises(RigError, match=r"tip = -28\.\d.* must be within"):
        flexneedle.insert(scenario, plan, 0, rig=SupervisedRig(path))
    assert {json.loads(line)[0] for line in notes.read_text().splitlines()} <= {"stop", "close"}


def test_a_listener_that_fails_keeps_no_event_from_the_others():
    seen, event = [], Tick(TickReport(0.0, SupervisorState.IDLE))

    def fail(_event):
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        Stream((seen.append, fail, seen.append)).send(event)
    assert seen == [event, event]
