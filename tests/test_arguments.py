"""An invalid argument is one line with value, rule and remedy, in all public functions."""

from types import SimpleNamespace

import numpy as np
import pytest

import flexneedle
from flexneedle.arguments import check_point, check_whole
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import FlexneedleError, InputError
from flexneedle.scenario.files import dump_scenario
from synthetic import make_plan

PLAN = make_plan()
SIMULATOR = flexneedle.Simulator("phantom", threads=1)
SCENARIO = "must be a preset name, a path or a Scenario"
WHOLE = "must be a whole number, at least"
CORES = "leave it out for one per core"
TARGET = "must be two or three numbers, depth and lateral offsets in mm"
MAKE = "make one with flexneedle.plan(scenario)"
OWN = "module:NAME of your own"
MISSING = "name: missing\nneedle = 3: must be a table\nsetup: missing\ntissue: missing"
VALUES = flexneedle.load_scenario("phantom").values()
BENCH = SimpleNamespace(now=float, wait=float, apply=tuple, stop=tuple, read=tuple, status="")


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: flexneedle.plan(3), f"scenario = 3: {SCENARIO}"),
        (lambda: flexneedle.insert(None, PLAN), f"scenario = None: {SCENARIO}"),
        (lambda: flexneedle.Simulator(2.5), f"scenario = 2.5: {SCENARIO}"),
        (lambda: flexneedle.plan("phantom", target="a"), f"target = 'a': {TARGET}"),
        (lambda: flexneedle.plan("phantom", target="12"), f"target = '12': {TARGET}"),
        (lambda: flexneedle.plan("phantom", target=40.0), f"target = 40.0: {TARGET}"),
        (lambda: flexneedle.plan("phantom", target=(40.0,)), f"target = (40.0,): {TARGET}"),
        (lambda: flexneedle.plan("phantom", target=(1, None)), f"target = (1, None): {TARGET}"),
        (lambda: flexneedle.plan("phantom", seed=-1), f"seed = -1: {WHOLE} 0"),
        (lambda: flexneedle.plan("phantom", seed=1.5), f"seed = 1.5: {WHOLE} 0"),
        (lambda: flexneedle.plan("phantom", seed=True), f"seed = True: {WHOLE} 0"),
        (lambda: flexneedle.insert("phantom", PLAN, seed="3"), f"seed = '3': {WHOLE} 0"),
        (lambda: flexneedle.plan("phantom", threads=0), f"threads = 0: {WHOLE} 1; {CORES}"),
        (lambda: flexneedle.Simulator("phantom", threads=0.5), f"threads = 0.5: {WHOLE} 1; {CORES}"),
        (lambda: flexneedle.insert("phantom", PLAN, threads=-2), f"threads = -2: {WHOLE} 1; {CORES}"),
        (lambda: flexneedle.insert("phantom", "x"), f"plan = 'x': must be a Plan; {MAKE}"),
        (lambda: flexneedle.plan("phantom", target={1: 2, 3: 4}), f"target = {{1: 2, 3: 4}}: {TARGET}"),
        (lambda: flexneedle.plan("phantom", target=(True, 5)), f"target = (True, 5): {TARGET}"),
        (lambda: flexneedle.load(3), "run_dir = 3: must be a path"),
        (lambda: flexneedle.run_study(3), "source = 3: must be a path"),
        (lambda: flexneedle.Control(db_x="1"), "db_x = '1': must be a number, in mm or rad"),
        (lambda: flexneedle.Control(flip=-1), "flip = -1: must be True or False"),
        (
            lambda: SIMULATOR.step(None, flexneedle.Control()),
            "state = None: must be a State; begin with simulator.start()",
        ),
        (
            lambda: SIMULATOR.step(SIMULATOR.start(), (1.0, 0.0)),
            "control = (1.0, 0.0): must be a Control; make one with flexneedle.Control(db_x=1.0)",
        ),
        (
            lambda: SIMULATOR.scenario.with_values("x"),
            "changes = 'x': must be values by key; such as {\"target.depth_mm\": 35.0}",
        ),
        (
            lambda: flexneedle.insert("phantom", PLAN, rig="arm"),
            "rig = 'arm': must be a VirtualRig, a Rig with its ports, or the rig of a rig file; "
            "see flexneedle.devices.open_rig",
        ),
        (
            lambda: flexneedle.Rig(1, 2, 3),
            "clock = 1: must be an object with now, wait; see flexneedle.ports.Clock",
        ),
        (
            lambda: flexneedle.Rig(BENCH, 2, 3),
            "driver = 2: must be an object with apply, stop; see flexneedle.ports.Driver",
        ),
        (
            lambda: flexneedle.Rig(BENCH, BENCH, SimpleNamespace(read=1)),
            "tracker = namespace(read=1): must be an object with read, status; "
            "see flexneedle.ports.TipTracker",
        ),
        (
            lambda: flexneedle.Rig(float, BENCH, BENCH),
            "clock = <class 'float'>: must be an object with now, wait; see flexneedle.ports.Clock",
        ),
        (
            lambda: flexneedle.Rig(BENCH, BENCH, BENCH, 0.0),
            "truth = 0.0: must be a function of () that returns a Condition, or None",
        ),
        (
            lambda: flexneedle.VirtualRig(tracker=3),
            f"tracker = 3: is an int, not a function of (scenario, phantom, rng); choices: scenario, or {OWN}",
        ),
        (
            lambda: flexneedle.VirtualRig(phantom={"exact": 1}),
            f"phantom = {{'exact': 1}}: is a dict, not a function of (truth, roll); choices: exact, model, or {OWN}",
        ),
        (
            lambda: flexneedle.insert("phantom", PLAN, controller=3),
            "controller = 3: is an int, not a flexneedle.Controller, missing: name, summary, decide; "
            f"choices: {', '.join(CONTROLLERS)}, or {OWN}",
        ),
        (lambda: flexneedle.Scenario(needle=3), MISSING),
        (lambda: flexneedle.Scenario(**{**VALUES, "needle": 3}), "needle = 3: must be a table"),
        (
            lambda: flexneedle.Scenario(**{**VALUES, "target": {"depth_mm": "a", "lateral_mm": None}}),
            'target.depth_mm = "a": must be a number\ntarget.lateral_mm: must be a number',
        ),
    ],
)
def test_a_wrong_argument_is_one_line(call, line):
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value) == line


def test_a_file_in_a_run_folder_is_rejected_with_the_folder(tmp_path):
    run, stray = tmp_path / "run.json", tmp_path / "other" / "trace.mcap"
    stray.parent.mkdir()
    for file in (run, stray):
        file.write_text("{}")
    rule = "is a file: must be the folder of a run"
    for file, line in ((run, f"{run}: {rule}, here {tmp_path}"), (stray, f"{stray}: {rule}")):
        with pytest.raises(InputError) as caught:
            flexneedle.load(file)
        assert str(caught.value) == line


@pytest.mark.parametrize("value", [np.arange(3000.0), "x" * 900, [[1] * 99] * 99, {"a": "b\nc"}, object()])
def test_the_error_for_any_value_is_one_short_line(value):
    with pytest.raises(FlexneedleError) as caught:
        flexneedle.insert("phantom", value)
    (line,) = str(caught.value).splitlines()
    assert len(line) < 200


def test_numpy_numbers_are_accepted():
    assert check_whole("seed", np.int64(3), 0) == 3
    assert check_point("target", np.array([40.0, 5.0]), "x, y and z") == (40.0, 5.0, 0.0)
    assert check_point("target", np.array([40.0, 5.0, -2.0]), "x, y and z") == (40.0, 5.0, -2.0)


def test_a_scenario_may_be_given_by_name_or_path(tmp_path):
    scenario, path = flexneedle.load_scenario("phantom"), tmp_path / "mine.toml"
    path.write_text(dump_scenario(scenario))
    plan = flexneedle.plan(scenario, (5.0, 0.0), seed=1, threads=1)
    for source in ("phantom", str(path), path):
        again = flexneedle.plan(source, (5.0, 0.0), seed=1, threads=1)
        assert again.controls.tobytes() == plan.controls.tobytes()
        assert flexneedle.Simulator(source).scenario == scenario
    one, other = (
        flexneedle.insert(
            source, plan, 1, controller="open-loop", rig=flexneedle.VirtualRig("model"), threads=1
        )
        for source in ("phantom", scenario)
    )
    assert [period.true_tip for period in one.periods] == [period.true_tip for period in other.periods]


def test_insert_executes_a_plan_on_the_ports_of_any_rig(quick_plan):
    """On the virtual phantom it gives the same result as `insert`."""
    from flexneedle.loop.virtual import Seeds, virtual_rig

    phantom, tracker, _, room = np.random.SeedSequence(4).spawn(4)
    scenario = flexneedle.load_scenario("phantom")
    rig = virtual_rig(scenario, quick_plan.roll, Seeds(phantom, tracker, room))
    assert isinstance(rig, flexneedle.Rig)
    done = flexneedle.insert(scenario, quick_plan, 4, rig=rig, controller="open-loop")
    same = flexneedle.insert(scenario, quick_plan, 4, controller="open-loop")
    assert [period.true_tip for period in done.periods] == [period.true_tip for period in same.periods]
    assert (done.phantom, done.tracker, same.phantom, same.tracker) == ("", "", "exact", "scenario")
