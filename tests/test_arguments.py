"""An invalid argument is one line with value, rule and remedy, in all public functions."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import flexneedle
from flexneedle.arguments import check_point, check_whole, expand_home
from flexneedle.cli.main import main
from flexneedle.errors import FlexneedleError, InputError
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.scenario.files import dump_scenario
from synthetic import make_plan

PLAN = make_plan()
PHANTOM = flexneedle.load_scenario("phantom")
SIMULATOR = flexneedle.Simulator(PHANTOM, threads=1)
VALUES = PHANTOM.values()
BENCH = SimpleNamespace(now=float, wait=float, apply=tuple, stop=tuple, read=tuple, status="")


def planning(**values):
    return lambda: flexneedle.plan("phantom", **values)


def inserting(plan=PLAN, **values):
    return lambda: flexneedle.insert("phantom", plan, **values)


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (lambda: flexneedle.plan(3), "scenario = 3: must be a preset name, a path or a Scenario"),
        (lambda: flexneedle.insert(None, PLAN), "scenario = None: must be"),
        (lambda: flexneedle.Simulator(2.5), "scenario = 2.5: must be"),
        (planning(target="12"), "target = '12': must be two or three numbers"),
        (planning(target=40.0), "target = 40.0: must be"),
        (planning(target=(40.0,)), "target = (40.0,): must be"),
        (planning(target=(1, None)), "target = (1, None): must be"),
        (planning(target={1: 2, 3: 4}), "target = {1: 2, 3: 4}: must be"),
        (planning(target=(True, 5)), "target = (True, 5): must be"),
        (planning(seed=-1), "seed = -1: must be a whole number, at least 0"),
        (planning(seed=1.5), "seed = 1.5: must be"),
        (planning(seed=True), "seed = True: must be"),
        (inserting(seed="3"), "seed = '3': must be"),
        (planning(threads=0), "threads = 0: must be a whole number, at least 1; leave it out"),
        (lambda: flexneedle.Simulator("phantom", threads=0.5), "threads = 0.5: must be"),
        (inserting(threads=-2), "threads = -2: must be"),
        (inserting(plan="x"), "plan = 'x': must be a Plan; make one with flexneedle.plan"),
        (lambda: flexneedle.load(3), "run_dir = 3: must be a path"),
        (lambda: flexneedle.run_study(3), "source = 3: must be a path"),
        (lambda: flexneedle.Control(db_x="1"), "db_x = '1': must be a number"),
        (lambda: flexneedle.Control(flip=-1), "flip = -1: must be True or False"),
        (lambda: SIMULATOR.step(None, flexneedle.Control()), "state = None: must be a State; begin with"),
        (
            lambda: SIMULATOR.step(SIMULATOR.start(), (1.0, 0.0)),
            "control = (1.0, 0.0): must be a Control; make",
        ),
        (lambda: PHANTOM.with_values("x"), "changes = 'x': must be values by key; such as"),
        (inserting(rig="arm"), "rig = 'arm': must be a RigSource; such as a VirtualRig, a Rig"),
        (lambda: flexneedle.Rig(1, 2, 3), "clock = 1: must be an object with now, wait; see"),
        (lambda: flexneedle.Rig(BENCH, 2, 3), "driver = 2: must be an object with apply, stop; see"),
        (lambda: flexneedle.Rig(BENCH, BENCH, 3), "tracker = 3: must be an object with read, status; see"),
        (lambda: flexneedle.Rig(float, BENCH, BENCH), "clock = <class 'float'>: must be an object with"),
        (lambda: flexneedle.Rig(BENCH, BENCH, BENCH, 0.0), "truth = 0.0: must be a function of ()"),
        (lambda: flexneedle.VirtualRig(tracker=3), "tracker = 3: is an int, not a function of (scenario, "),
        (lambda: flexneedle.VirtualRig(phantom="gel"), "phantom = 'gel': must be one of exact, model"),
        (lambda: flexneedle.VirtualRig(phantom={"exact": 1}), "phantom = {'exact': 1}: is a dict, not a"),
        (inserting(controller=3), "controller = 3: is an int, not a flexneedle.Controller, missing: name"),
        (inserting(controller="pid"), "controller = 'pid': must be one of adaptive-mpc, "),
        (lambda: flexneedle.Scenario(needle=3), "name: missing\nneedle = 3: must be a table\nsetup: missing"),
        (lambda: flexneedle.Scenario(**{**VALUES, "needle": 3}), "needle = 3: must be a table"),
        (
            lambda: flexneedle.Scenario(**{**VALUES, "target": {"depth_mm": "a", "lateral_mm": None}}),
            'target.depth_mm = "a": must be a number\ntarget.lateral_mm: must be a number',
        ),
    ],
)
def test_a_wrong_argument_names_value_rule_and_remedy(call, start):
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(start)


def test_a_file_in_a_run_folder_is_rejected_with_the_folder(tmp_path):
    run, stray = tmp_path / "run.json", tmp_path / "other" / "trace.mcap"
    stray.parent.mkdir()
    for file in (run, stray):
        file.write_text("{}")
    rule = "is a file: must be the folder of a run"
    for file, line in ((run, f"{run}: {rule}, here {tmp_path}"), (stray, f"{stray}: {rule}")):
        with pytest.raises(InputError, match=f"^{line}$"):
            flexneedle.load(file)


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
    path = tmp_path / "mine.toml"
    path.write_text(dump_scenario(PHANTOM))
    for source in ("phantom", str(path), path):
        assert flexneedle.Simulator(source).scenario == PHANTOM


def test_insert_executes_a_plan_on_the_ports_of_any_rig():
    """On the virtual phantom it gives the same result as `insert`, and a scenario may be given by name."""
    scenario = PHANTOM.with_values({"target.depth_mm": 5.0, "plan.max_iterations": 1, "plan.iterations": 1})
    plan = flexneedle.plan(scenario, threads=1)
    rig = virtual_rig(PHANTOM, plan.roll, Seeds.of(4))
    options = {"controller": "open-loop", "force": True}
    done = flexneedle.insert(PHANTOM, replace(plan, scenario=None), 4, rig=rig, **options)
    same = flexneedle.insert("phantom", replace(plan, scenario=None), 4, **options)
    assert [period.true_tip for period in done.periods] == [period.true_tip for period in same.periods]
    assert (done.phantom, done.tracker, same.phantom, same.tracker) == ("", "", "exact", "scenario")


@pytest.mark.parametrize(
    ("given", "home", "expected"),
    [
        ("~/x", "/home/me", "/home/me/x"),
        ("~", "/home/me", "/home/me"),
        ("~nobody_here/x", "/home/me", "~nobody_here/x"),
        ("x/~/y", "/home/me", "x/~/y"),
        ("x", None, "x"),
    ],
)
def test_the_home_in_a_path_is_expanded(given, home, expected, monkeypatch):
    monkeypatch.setenv("HOME", home) if home else monkeypatch.delenv("HOME", raising=False)
    assert str(expand_home(given)) == str(expand_home(Path(given))) == expected


def test_a_home_that_is_not_known_is_refused_in_one_line(monkeypatch):
    def no_entry(_uid):
        raise KeyError

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("pwd.getpwuid", no_entry)
    with pytest.raises(InputError, match=r"^~/x: no home folder is known: give the whole path$"):
        expand_home("~/x")


def test_records_and_commands_take_the_home(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    plan = replace(PLAN, scenario=PHANTOM)
    assert flexneedle.save(plan, "~/one") == tmp_path / "one"
    assert flexneedle.load("~/one").target == plan.target
    (tmp_path / "mine.toml").write_text(dump_scenario(PHANTOM))
    assert flexneedle.load_scenario("~/mine.toml") == PHANTOM
    for command in (["view", "~/one"], ["scenario", "check", "~/mine.toml"]):
        assert main(command) == 0, capsys.readouterr().err
    assert not (tmp_path / "~").exists()
