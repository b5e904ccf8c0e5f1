"""`flexneedle insert` and `view`: results, records, exit status."""

import csv
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import fake_engine
from commands import names, run
from flexneedle.cli import main as cli
from flexneedle.control.controllers import CONTROLLERS, DEFAULT
from flexneedle.errors import RunError
from flexneedle.invasiveness import format_number
from flexneedle.phantom import kernels
from flexneedle.record.reader import read_trace
from flexneedle.scenario.files import dump_scenario
from zoned import SPHERE, with_zones

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")

INSERTION_FILES = ["insertion.png", "insertion.svg", "run.json", "trace.mcap"]
INSERT_KEYS = [
    *("controller", "phantom", "rig", "dry_run", "disturbed"),
    *("target_mm", "tip_true_mm", "tip_measured_mm", "true_error_mm", "residual_mm", "planned_error_mm"),
    *("reached", "outcome", "reason", "warning", "flips", "planned_flips"),
    *("strain_energy_mj", "planned_strain_energy_mj"),
    *("peak_energy_uj", "mean_energy_uj", "end_energy_uj", "least_stretch", "guide_travel_mm"),
    *("planned_peak_energy_uj", "planned_mean_energy_uj", "planned_end_energy_uj", "planned_least_stretch"),
    *("planned_guide_travel_mm", "energy_scale_uj", "energy_estimated"),
    *("clearance_mm", "true_clearance_mm", "planned_clearance_mm", "steps", "held_s"),
    *("converged", "seed", "run_dir", "timing"),
]


def read(folder):
    return json.loads((Path(folder) / "run.json").read_text())


def insert_json(capsys, *argv):
    """Return exit status, result and stderr of `flexneedle insert --json`; the result always has the same keys."""
    status, out, err = run(capsys, "insert", "--json", *argv)
    result = json.loads(out)
    assert list(result) == INSERT_KEYS
    return status, result, err


def without_place(result):
    return {key: value for key, value in result.items() if key not in ("run_dir", "timing")}


def test_insert_writes_a_record_and_a_table(engine, capsys):
    engine()
    status, out, err = run(capsys, "insert", "--out", "here")
    assert status == 0
    assert names(Path("here")) == INSERTION_FILES
    assert out.startswith("Reached: the tip ended 0.070 mm from the target\n")
    assert "Record and figures: here" in out
    result = read("here")["result"]
    for by in ("", "planned_"):
        peak, mean, end = (format_number(result[f"{by}{of}_energy_uj"]) for of in ("peak", "mean", "end"))
        assert f"{peak}, {mean}, {end} µJ" in out
    assert "Planning 100%" in err
    assert "Inserting" in err
    assert "\x1b" not in out + err


def test_insert_json_is_one_object_with_all_digits(engine, capsys):
    engine()
    status, result, _ = insert_json(capsys, "--seed", "3", "--target", "40", "-4.5")
    assert (status, result["target_mm"], result["reached"]) == (0, [40.0, -4.5, 0.0], True)
    assert (result["controller"], result["phantom"]) == (DEFAULT, "exact")
    assert result["true_error_mm"] == pytest.approx(0.07)
    assert (result["flips"], result["planned_flips"], result["steps"], result["seed"]) == (3, 1, 23, 3)
    assert result["strain_energy_mj"] == pytest.approx(1.25 * result["planned_strain_energy_mj"])
    assert result["end_energy_uj"] == 1e3 * result["strain_energy_mj"]
    assert result["mean_energy_uj"] < result["peak_energy_uj"]
    assert result["planned_end_energy_uj"] == 1e3 * result["planned_strain_energy_mj"]
    assert result["energy_estimated"] is False
    assert set(result["timing"]) == {"plan_seconds", "period_ms"}
    assert result["timing"]["period_ms"]["max"] == pytest.approx(5.1 + 0.01 * 22)
    stored = read(result["run_dir"])
    assert (stored["result"], stored["status"]) == (without_place(result), "done")
    assert stored["scenario"]["target"] == {"depth_mm": 40.0, "lateral_mm": -4.5, "lateral_z_mm": 0.0}


@pytest.mark.long
@pytest.mark.usefixtures("real_figures")
def test_parts_are_recorded_and_drawn_and_view_redraws_the_same_bytes(engine, capsys):
    engine()
    parts = ("--controller", "open-loop", "--phantom", "model")
    status, out, _ = run(capsys, "insert", *parts, "--out", "a")
    assert status == 0
    assert re.search(r"^ controller +open-loop", out, re.MULTILINE)
    assert re.search(r"^ phantom +model", out, re.MULTILINE)
    about, stored = read_trace(Path("a/trace.mcap")).about, read("a")
    for values in (about, stored, stored["result"]):
        assert (values["controller"], values["phantom"]) == ("open-loop", "model")
    drawn = {path: path.read_bytes() for path in Path("a").glob("insertion.*")}
    assert b"open-loop, model phantom" in drawn[Path("a/insertion.svg")]
    Path("a/insertion.png").unlink()
    assert run(capsys, "view", "a")[0] == 0
    assert {path: path.read_bytes() for path in Path("a").glob("insertion.*")} == drawn


def test_every_controller_is_listed_with_its_summary(capsys):
    status, out, err = run(capsys, "insert", "--list")
    assert (status, err) == (0, "")
    lines = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert list(lines) == list(CONTROLLERS)
    assert all(lines[name].startswith(method.summary) for name, method in CONTROLLERS.items())
    assert [name for name, line in lines.items() if line.endswith("(default)")] == [DEFAULT]


def test_the_plan_may_have_its_own_seed(engine, capsys):
    engine()
    for argv, seed in (([], 5), (["--plan-seed", "0"], 0)):
        run(capsys, "insert", "--seed", "5", "--out", f"a{seed}", *argv)
        stored = read(f"a{seed}")
        assert (stored["seed"], stored["plans"]["manipulation"]["seed"]) == (5, seed)


@pytest.mark.parametrize(
    ("argv", "made", "names"),
    [
        ("plan phantom", "", "the plane (first run only, about 15 s)"),
        ("plan phantom3d", "the plane, the exact phantom", "space (first run only, about 15 s)"),
        ("insert phantom", "", "the plane and the exact phantom (first run only, about 30 s)"),
        ("insert phantom", "the plane", "the exact phantom (first run only, about 15 s)"),
        ("insert phantom3d", "the plane, the exact phantom", "space (first run only, about 15 s)"),
        ("plan phantom", "the plane", ""),
        ("insert phantom3d", "space, the exact phantom", ""),
    ],
)
def test_the_first_compilation_is_announced(engine, capsys, monkeypatch, tmp_path, argv, made, names):
    """With what is compiled, and about how long it takes."""
    engine()
    monkeypatch.setattr(
        kernels, "_mark", lambda name: tmp_path / ("" if name in made.split(", ") else "none")
    )
    monkeypatch.setattr(kernels, "compile_kernels", lambda _axes, **_: None)
    announced = [line for line in run(capsys, *argv.split())[2].splitlines() if "Compiling" in line]
    assert announced == ([f"Compiling kernels for {names} …"] if names else [])


def test_a_target_in_space_has_two_lateral_offsets_and_two_entry_angles(engine, capsys):
    engine()
    _, out, _ = run(capsys, "insert", "phantom3d", "--target", "30", "-4.5", "2")
    assert "target (depth, lateral offsets)" in out
    assert "30, -4.5, 2 mm" in out
    assert re.search(r"^ bevel rolls +\d", out, re.MULTILINE)
    angle = r"[+-]\d+\.\d\d°"
    for scenario, line in (
        ("phantom3d", rf"entry angles +{angle}, {angle}"),
        ("phantom", f"entry angle +{angle}"),
    ):
        assert re.search(f"^ {line} $", run(capsys, "plan", scenario)[1], re.MULTILINE)


@pytest.mark.parametrize(
    ("options", "line", "status"),
    [
        ({"miss": 1.4}, "MISSED: the tip ended 1.410 mm from the target, more than 1 mm", "done"),
        ({"outcome": "held"}, "Held 40.0 mm deep after 23 periods: no sample for 1.00 s", "held"),
    ],
)
def test_an_insertion_that_does_not_reach_its_target_fails(engine, capsys, options, line, status):
    engine(**options)
    code, out, _ = run(capsys, "insert", "--out", "here")
    assert (code, out.splitlines()[0], read("here")["status"]) == (1, line, status)
    code, result, _ = insert_json(capsys)
    assert (code, result["outcome"], result["steps"], result["reached"]) == (1, status, 23, False)


def test_a_plan_that_misses_names_its_limit(engine, capsys):
    """The default controller, and any with --force, inserts nevertheless; another one refuses."""
    engine(plan_miss=2.5)
    status, _, err = run(capsys, "insert", "--out", "missed")
    assert status == 1
    assert "flexneedle: warning: the plan MISSES the target: best distance 2.510 mm" in err
    assert "limited by setup.max_guide_travel_mm = 15" in err
    status, forced, _ = insert_json(capsys, "--force", "--controller", "open-loop")
    assert (status, forced["steps"], forced["planned_error_mm"]) == (1, 23, pytest.approx(2.51))
    status, refused, err = insert_json(capsys, "--out", "here", "--controller", "open-loop")
    assert (status, err.splitlines()[-1]) == (1, f"flexneedle: {refused['reason']}")
    assert "limited by setup.max_guide_travel_mm" in refused["reason"]
    assert (refused["outcome"], refused["reached"], refused["steps"]) == ("refused", False, 0)
    assert (refused["planned_error_mm"], refused["planned_flips"]) == (pytest.approx(2.51), 1)
    assert (refused["run_dir"], refused["timing"]["plan_seconds"]) == ("here", 0.71)
    assert names(Path("here")) == ["plan.png", "plan.svg", "run.json", "trace.mcap"]
    stored = read("here")
    assert (stored["status"], stored["controller"], stored["phantom"]) == ("failed", "open-loop", "exact")
    assert stored["result"] == without_place(refused)


@pytest.mark.parametrize(
    ("argv", "target", "reason"),
    [
        (
            ["--strategy", "steering", "--controller", "resolved-rate"],
            [40.0, 5.0, 0.0],
            "strategy = 'steering'",
        ),
        (["case.toml", "--controller", "broyden-mpc"], [40.0, 5.0, 0.0], "setup.guide_to_skin_mm"),
        (["nowhere.toml"], None, "nowhere.toml"),
        (["phantom", "--target", "45", "20"], [45.0, 20.0, 0.0], "target.lateral_mm = 20"),
        (["phantom3d", "--target", "45", "2", "-20"], [45.0, 2.0, -20.0], "target.lateral_z_mm = -20"),
        (["--out", "full"], [40.0, 5.0, 0.0], "full: already contains a run (run.json)"),
    ],
)
def test_a_refusal_before_the_plan_prints_the_same_keys(argv, target, reason, capsys, in_tmp, minimal_text):
    (in_tmp / "case.toml").write_text(minimal_text)
    (in_tmp / "full").mkdir()
    (in_tmp / "full/run.json").touch()
    status, result, err = insert_json(capsys, "--seed", "4", *argv)
    assert (status, err) == (2, f"flexneedle: {result['reason']}\n")
    assert reason in err
    assert (result["outcome"], result["reached"], result["seed"]) == ("refused", False, 4)
    assert (result["target_mm"], result["run_dir"], result["planned_error_mm"]) == (target, None, None)
    assert result["timing"] == {"plan_seconds": None, "period_ms": {"p50": None, "p99": None, "max": None}}
    assert (names(in_tmp), names(in_tmp / "full")) == (["case.toml", "full"], ["run.json"])


def test_a_failure_during_the_insertion_keeps_the_periods(engine, capsys):
    def fail():
        raise RunError("the driver is gone")

    engine(stop=(20, fail))
    status, out, err = run(capsys, "insert", "--out", "here")
    assert (status, out) == (1, "")
    assert err.splitlines()[-2:] == ["flexneedle: incomplete record: here", "flexneedle: the driver is gone"]
    assert names(Path("here")) == INSERTION_FILES
    assert (read("here")["status"], read("here")["reason"]) == ("failed", "the driver is gone")
    status, result, _ = insert_json(capsys)
    assert (status, result["outcome"], result["steps"]) == (1, "failed", 20)
    assert result["reason"] == "the driver is gone"
    assert result["timing"]["period_ms"]["max"] == pytest.approx(5.1 + 0.01 * 19)


def test_ctrl_c_keeps_and_marks_the_record(engine, capsys, monkeypatch):
    def interrupt(*_args, **_options):
        raise KeyboardInterrupt

    engine(stop=(12, interrupt))
    status, out, err = run(capsys, "insert", "--json", "--out", "here")
    assert (status, out) == (130, "")
    summary = "interrupted 7.5 mm deep after 12 periods: stopped by the user"
    assert err.splitlines()[-1] == f"flexneedle: {summary}; record: here"
    assert (read("here")["status"], read("here")["result"]["steps"]) == ("interrupted", 12)
    assert names(Path("here")) == INSERTION_FILES
    monkeypatch.setattr("flexneedle.record.plans.make_plan", interrupt)
    status, out, err = run(capsys, "insert", "--out", "unplanned")
    assert (status, out, err.splitlines()[-1]) == (130, "", "flexneedle: interrupted")
    assert read("unplanned")["status"] == "interrupted"
    assert run(capsys, "view", "unplanned")[0] == 1


def test_a_killed_run_can_be_viewed_and_exported(capsys):
    command = [sys.executable, fake_engine.__file__, "SIGKILL", "insert", "--out", "here"]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    assert names(Path("here")) == ["run.json", "trace.mcap"]
    assert run(capsys, "view", "here")[:2] == (0, "here/insertion.png\nhere/insertion.svg\n")
    status, out, err = run(capsys, "export", "here", "--csv", "-")
    assert status == 0
    assert len(list(csv.DictReader(out.splitlines()))) == 12
    assert "incomplete: 12 complete periods read" in err


@pytest.mark.parametrize(
    "argv",
    [
        ["insert", "nowhere.toml"],
        ["insert", "--target", "1000", "0"],
        ["insert", "--json", "--controller", "pid"],
        ["insert", "--phantom", "jelly"],
        ["insert", "--tracker", "eye"],
        ["plan", "--target", "nan", "0"],
        ["plan", "--out", "full"],
        ["view", "nowhere"],
        ["export", "nowhere", "--csv"],
        ["export", "nowhere", "--readings"],
    ],
)
def test_bad_input_is_one_line_with_status_2_and_writes_nothing(argv, capsys, in_tmp):
    (in_tmp / "full").mkdir()
    (in_tmp / "full/run.json").touch()
    status, out, err = run(capsys, *argv)
    assert (status, out) == (2, "")
    assert err.startswith("flexneedle: ")
    assert err.count("\n") == 1
    assert (names(in_tmp), names(in_tmp / "full")) == (["full"], ["run.json"])


@pytest.mark.parametrize(
    ("target", "misplaced"),
    [(["40,5"], False), (["40", "5mm"], False), (["40", "1,5"], False), (["40", "5", "./a.toml"], True)],
)
def test_a_wrong_target_blames_the_order_only_if_a_scenario_follows(target, misplaced, capsys):
    with pytest.raises(SystemExit):
        cli.main(["plan", "--target", *target])
    err = capsys.readouterr().err
    assert "with spaces between and decimal points" in err
    assert ("put SCENARIO before --target" in err) is misplaced


@pytest.mark.parametrize(
    "argv",
    [
        ["insert", "--seed", "-1"],
        ["insert", "--plan-seed", "-1"],
        ["insert", "--target", "1"],
        ["insert", "--target", "1", "2", "3", "4"],
        ["insert", "--target", "40", "5", "phantom"],
        ["insert", "--strategy", "both"],
        ["export", "x", "--csv", "-", "--readings", "-"],
    ],
)
def test_wrong_arguments_exit_with_status_2(argv, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(argv)
    assert caught.value.code == 2
    assert capsys.readouterr().out == ""


def test_a_controller_that_does_not_avoid_zones_is_one_line_if_there_are_zones(engine, capsys, in_tmp):
    engine()
    (in_tmp / "zoned.toml").write_text(dump_scenario(with_zones("phantom", SPHERE)))

    def count(scenario, *controller):
        _, _, err = run(capsys, "insert", scenario, *controller)
        return err.count("does not avoid zones")

    assert count("zoned.toml", "--controller", "open-loop") == 1
    assert count("zoned.toml") == count("phantom", "--controller", "open-loop") == 0
