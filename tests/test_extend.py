"""The examples of docs/extend.md run from a folder outside the package."""

import json
import re
import subprocess
import sys

import pyarrow.parquet as pq
import pytest

import flexneedle
from flexneedle.scenario.files import dump_scenario
from kits import run_kits
from markdown_examples import ROOT, blocks

DOCS = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
MODULES = {
    block.title.removesuffix(".py"): block.code for block in blocks(DOCS) if block.title.endswith(".py")
}
PARTS = {"controller": "follow_path:CONTROLLER", "phantom": "unicycle:Unicycle", "tracker": "camera:Camera"}
QUICK = {
    "plan.samples": 16, "plan.iterations": 2, "setup.tip_to_skin_mm": 4.0, "target.depth_mm": 8.0,
    "target.lateral_mm": 0.5, "phantom.step_mm": 1.0, "phantom.contact_spacing_mm": 2.0, "phantom.element_mm": 2.0,
}  # fmt: skip
STUDY = """
name = "own"
scenario = "quick.toml"

[[axes]]
key = "controller"
values = ["open-loop", "follow_path:CONTROLLER"]

[[axes]]
key = "control.follow_path.gain"
values = [0.0, 2.0]

[[cases]]
name = "scenario"

[[cases]]
name = "own"
values = { plant = "unicycle:Unicycle", tracker = "camera:Camera" }
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with the modules of the page and a quick scenario with settings for the controller."""
    folder = tmp_path_factory.mktemp("lab")
    for name, code in MODULES.items():
        (folder / f"{name}.py").write_text(code, encoding="utf-8")
    scenario = flexneedle.load_scenario("phantom").with_values(QUICK | {"control.follow_path.gain": 0.25})
    (folder / "quick.toml").write_text(dump_scenario(scenario), encoding="utf-8")
    (folder / "own.toml").write_text(STUDY, encoding="utf-8")
    return folder


@pytest.fixture
def imported(lab, monkeypatch):
    """Return a function that imports an object of the page by `module:NAME`."""
    monkeypatch.syspath_prepend(lab)

    def part(spec):
        module, _, name = spec.partition(":")
        return getattr(__import__(module), name)

    yield part
    for name in MODULES:
        sys.modules.pop(name, None)


def command(lab, *argv):
    """Run the command in the folder; -P: Python does not add the folder to its path."""
    line = [sys.executable, "-P", "-m", "flexneedle", *argv]
    return subprocess.run(line, cwd=lab, capture_output=True, text=True, check=False)


def insert(scenario, plan, controller, phantom, tracker):
    rig = flexneedle.VirtualRig(phantom, tracker)
    return flexneedle.insert(scenario, plan, 3, controller=controller, rig=rig, force=True)


def test_each_example_is_one_short_file():
    assert " ".join(MODULES) == "follow_path unicycle camera proximity bench fung tilt test_parts"
    assert all(len(code.splitlines()) < 47 for code in MODULES.values())


def test_the_parts_pass_their_kits(lab, imported):
    del lab
    run_kits(imported("test_parts:__dict__"))


@pytest.mark.long
def test_the_parts_are_used_and_recorded_by_name(lab):
    options = [word for key, name in PARTS.items() for word in (f"--{key}", name)]
    done = command(lab, "insert", "quick.toml", "--force", "--json", "--out", "one", *options)
    result, stored = json.loads(done.stdout), json.loads((lab / "one/run.json").read_text())
    assert result["outcome"] == stored["status"] == "done", done.stderr
    assert {key: stored[key] for key in PARTS} == PARTS
    assert (result["controller"], result["phantom"]) == (PARTS["controller"], PARTS["phantom"])
    assert stored["scenario"]["control"]["follow_path"] == {"gain": 0.25}
    again = command(lab, "view", "one")
    assert again.returncode == 0, again.stderr


@pytest.mark.long
def test_a_scenario_with_the_table_is_checked_with_the_controller(lab):
    refused = command(lab, "scenario", "check", "quick.toml")
    assert refused.returncode == 2
    assert refused.stderr.startswith("flexneedle: quick.toml: control.follow_path: unknown table; ")
    fine = command(lab, "scenario", "check", "quick.toml", "--controller", PARTS["controller"])
    assert (fine.returncode, fine.stderr) == (0, "")


@pytest.mark.slow
def test_an_unused_controller_table_is_one_warning(lab):
    for argv in (["plan"], ["insert", "--force", "--controller", "open-loop", "--phantom", "model"]):
        done = command(lab, *argv, "quick.toml", "--out", f"other-{argv[0]}")
        assert done.returncode in (0, 1)
        (line,) = [line for line in done.stderr.splitlines() if "follow_path" in line]
        assert line.startswith("flexneedle: control.follow_path: unknown table; tables: adaptive_mpc, ")
        assert line.endswith("; it is not used")


@pytest.mark.long
def test_a_sensor_by_name_is_used_recorded_and_drawn(lab):
    near = 'kind = "proximity:Proximity"'
    scenario = (lab / "quick.toml").read_text(encoding="utf-8")
    (lab / "near.toml").write_text(f"{scenario}\n[[sensor]]\n{near}\nat_mm = 2.0\n", encoding="utf-8")
    done = command(lab, "insert", "near.toml", "--force", "--json", "--out", "near")
    result, stored = json.loads(done.stdout), json.loads((lab / "near/run.json").read_text())
    assert result["outcome"] == "done", done.stderr
    (sensor,) = result["sensors"]
    assert sensor["name"] == "Proximity"
    assert 0.0 < sensor["mean_nis"] < 3.0
    assert stored["scenario"]["sensor"][0]["kind"] == "proximity:Proximity"
    again = command(lab, "view", "near")
    assert again.returncode == 0, again.stderr
    readings = command(lab, "export", "near", "--sensors", "-")
    assert ",Proximity," in readings.stdout


def test_objects_give_the_same_result_as_their_names(lab, imported, monkeypatch):
    monkeypatch.chdir(lab)
    scenario = flexneedle.load_scenario("quick.toml")
    plan = flexneedle.plan(scenario, seed=0)
    own = {key: imported(name) for key, name in PARTS.items()}
    by_object = insert(scenario, plan, **own)
    by_name = insert(scenario, plan, **PARTS)
    assert by_object.outcome == "done"
    assert [p.true_tip for p in by_object.periods] == [p.true_tip for p in by_name.periods]
    assert (by_object.controller, by_object.phantom) == ("follow-path", "Unicycle")
    assert (by_name.controller, by_name.phantom) == (PARTS["controller"], PARTS["phantom"])
    assert by_name.controller_name == by_object.controller_name == "follow-path"
    stiff = scenario.with_values({"control.follow_path.gain": 2.0})
    other = insert(stiff, plan, **own)
    assert other.periods[-1].guide != by_object.periods[-1].guide


@pytest.mark.long
def test_the_example_of_objects_runs_as_printed(lab, imported, monkeypatch):
    monkeypatch.chdir(lab)
    (lab / "mine.toml").write_bytes((lab / "quick.toml").read_bytes())
    example, *_ = [
        code for code in re.findall(r"```python\n(.*?)```", DOCS, re.DOTALL) if code.startswith("import")
    ]
    names = {}
    exec(compile(example, "extend.md", "exec"), names)
    own = {key: imported(name) for key, name in PARTS.items()}
    same = insert("quick.toml", names["plan"], **own)
    loaded = flexneedle.load("runs/mine")
    assert [p.true_tip for p in loaded.periods] == [p.true_tip for p in same.periods]
    assert (loaded.controller, loaded.phantom, loaded.tracker) == ("follow-path", "Unicycle", "Camera")


def test_a_plan_is_executed_on_the_bench(lab, imported, monkeypatch):
    monkeypatch.chdir(lab)
    scenario = flexneedle.load_scenario("quick.toml").with_values({"control.follow_path": None})
    plan = flexneedle.plan(scenario, seed=0)
    done = imported("bench:insert")(scenario, plan)
    assert (done.outcome, done.phantom) == ("done", "")
    assert done.periods[-1].measurement.x == pytest.approx(plan.target[0], abs=0.05)
    assert done.periods[-1].true_tip is None


@pytest.mark.slow
def test_a_study_loads_them_by_name_in_its_workers(lab):
    done = command(lab, "study", "own.toml", "--workers", "2", "--out", "study", "--json")
    assert done.returncode == 0, done.stderr
    rows = pq.read_table(lab / "study/runs.parquet").to_pylist()
    assert [(row["case"], row["controller"], row["control.follow_path.gain"]) for row in rows] == [
        (case, controller, gain)
        for case in ("scenario", "own")
        for controller in ("open-loop", PARTS["controller"])
        for gain in (0.0, 2.0)
    ]
    assert {(row["case"], row["plant"], row["tracker"]) for row in rows} == {
        ("scenario", "exact", "scenario"),
        ("own", PARTS["phantom"], PARTS["tracker"]),
    }
    assert {row["outcome"] for row in rows} == {"done"}, [row["reason"] for row in rows]
    assert "arning" not in done.stderr
    ends = {
        (row["case"], row["controller"], row["control.follow_path.gain"]): row["tip_y_mm"] for row in rows
    }
    for case in ("scenario", "own"):
        assert ends[case, "open-loop", 0.0] == ends[case, "open-loop", 2.0]
        assert ends[case, PARTS["controller"], 0.0] != ends[case, PARTS["controller"], 2.0]
    report = command(lab, "report", "study")
    assert report.returncode == 0, report.stderr


@pytest.mark.slow
def test_a_study_is_not_resumed_with_an_edited_module(lab, tmp_path):
    for file in lab.glob("*.*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    short = STUDY.replace("[0.0, 2.0]", "[0.0]")
    (tmp_path / "own.toml").write_text(short, encoding="utf-8")
    assert command(tmp_path, "study", "own.toml", "--out", "study").returncode == 0
    assert command(tmp_path, "study", "own.toml", "--out", "study", "--resume").returncode == 0
    with (tmp_path / "camera.py").open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    refused = command(tmp_path, "study", "own.toml", "--out", "study", "--resume")
    assert refused.returncode == 2
    assert "\nflexneedle: study: cannot resume: own.camera:Camera is " in refused.stderr
