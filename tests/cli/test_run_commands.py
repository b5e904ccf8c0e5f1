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
from flexneedle.phantom.plants import DEFAULT_PLANT, PLANTS
from flexneedle.record.reader import read_trace

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")

OWN = ", or module:NAME of your own"
INSERTION_FILES = ["insertion.png", "insertion.svg", "run.json", "trace.mcap"]
INSERT_KEYS = [
    *("controller", "phantom", "rig", "dry_run", "disturbed"),
    *("target_mm", "tip_true_mm", "tip_measured_mm", "true_error_mm", "residual_mm", "planned_error_mm"),
    *(
        "reached",
        "outcome",
        "reason",
        "warning",
        "flips",
        "planned_flips",
        "strain_energy_mj",
        "planned_strain_energy_mj",
        "steps",
    ),
    "held_s",
    *("converged", "seed", "run_dir", "timing"),
]


def reproducible(folder):
    """Return the reproducible part of a run: run.json without timing, and the figures."""
    values = json.loads((folder / "run.json").read_text())
    del values["timing"]
    drawn = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".png", ".svg")}
    return json.dumps(values), drawn


def run_process(signal_name, *argv):
    """Run a command in a separate process that receives a signal in its 12th period."""
    command = [sys.executable, fake_engine.__file__, signal_name, *argv]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_insert_writes_a_record_and_a_table(engine, capsys, in_tmp):
    engine()
    status, out, err = run(capsys, "insert", "--out", "here")
    assert status == 0
    assert names(in_tmp / "here") == INSERTION_FILES
    assert out.startswith("Reached: the tip ended 0.070 mm from the target\n")
    assert "Record and figures: here" in out
    assert "Planning 100%" in err
    assert "Inserting" in err
    assert "\x1b" not in out + err


def test_insert_json_is_one_object_with_all_digits(engine, capsys):
    engine()
    status, out, _ = run(capsys, "insert", "--json", "--seed", "3")
    result = json.loads(out)
    assert status == 0
    assert list(result) == INSERT_KEYS
    assert result["target_mm"] == [40.0, 5.0, 0.0]
    assert result["reached"] is True
    assert result["true_error_mm"] == pytest.approx(0.07)
    assert (result["flips"], result["planned_flips"], result["steps"], result["seed"]) == (3, 1, 69, 3)
    assert result["strain_energy_mj"] == pytest.approx(1.25 * result["planned_strain_energy_mj"])
    assert set(result["timing"]) == {"plan_seconds", "period_ms"}
    assert result["timing"]["period_ms"]["max"] == pytest.approx(5.1 + 0.01 * 68)
    stored = json.loads((Path(result["run_dir"]) / "run.json").read_text())
    assert stored["result"] == {key: result[key] for key in INSERT_KEYS if key not in ("run_dir", "timing")}
    assert stored["status"] == "done"


@pytest.mark.usefixtures("real_figures")
def test_controller_and_phantom_are_used_and_recorded(engine, capsys, in_tmp):
    engine()
    status, out, _ = run(capsys, "insert", "--controller", "open-loop", "--phantom", "model", "--out", "a")
    assert status == 0
    assert re.search(r"^ controller +open-loop", out, re.MULTILINE)
    assert re.search(r"^ phantom +model", out, re.MULTILINE)
    stored = json.loads((in_tmp / "a/run.json").read_text())
    for values in (stored, stored["result"]):
        assert (values["controller"], values["phantom"]) == ("open-loop", "model")
    about = read_trace(in_tmp / "a/trace.mcap").about
    assert (about["controller"], about["phantom"]) == ("open-loop", "model")
    assert "open-loop, model phantom" in (in_tmp / "a/insertion.svg").read_text()


def test_the_defaults_are_the_default_controller_and_the_exact_phantom(engine, capsys):
    engine()
    result = json.loads(run(capsys, "insert", "--json")[1])
    assert (result["controller"], result["phantom"]) == (DEFAULT, DEFAULT_PLANT) == (DEFAULT, "exact")
    with pytest.raises(SystemExit):
        cli.main(["insert", "--help"])
    message = " ".join(capsys.readouterr().out.split())
    assert f"(default: {DEFAULT})" in message
    assert all(f"{kind}," in message for kind in PLANTS)


def test_every_controller_is_listed_with_its_summary(capsys, in_tmp):
    status, out, err = run(capsys, "insert", "--list")
    assert (status, err, names(in_tmp)) == (0, "", [])
    lines = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert list(lines) == list(CONTROLLERS)
    assert all(lines[name].startswith(method.summary) for name, method in CONTROLLERS.items())
    assert [name for name, line in lines.items() if line.endswith("(default)")] == [DEFAULT]


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["--controller", "pid"], f"controller = 'pid': must be one of {', '.join(CONTROLLERS)}{OWN}"),
        (["--phantom", "jelly"], f"phantom = 'jelly': must be one of exact, model{OWN}"),
        (["--tracker", "eye"], f"tracker = 'eye': must be one of scenario{OWN}"),
    ],
)
def test_an_unknown_name_is_one_line_with_the_choices(capsys, in_tmp, argv, line):
    assert run(capsys, "insert", *argv) == (2, "", f"flexneedle: {line}\n")
    assert names(in_tmp) == []


@pytest.mark.parametrize(("argv", "seed"), [([], 5), (["--plan-seed", "0"], 0), (["--plan-seed", "8"], 8)])
def test_the_plan_may_have_its_own_seed(engine, capsys, in_tmp, argv, seed):
    engine()
    run(capsys, "insert", "--seed", "5", "--out", "a", *argv)
    stored = json.loads((in_tmp / "a/run.json").read_text())
    assert (stored["seed"], stored["plans"]["manipulation"]["seed"]) == (5, seed)


def test_an_insertion_that_fails_is_recorded_with_its_controller(engine, capsys, in_tmp):
    engine(plan_miss=2.5)
    run(capsys, "insert", "--controller", "ce-mpc", "--out", "a")
    stored = json.loads((in_tmp / "a/run.json").read_text())
    assert (stored["status"], stored["controller"], stored["phantom"]) == ("failed", "ce-mpc", "exact")


def test_the_first_compilation_is_announced(engine, capsys, monkeypatch):
    engine()
    monkeypatch.setattr("flexneedle.phantom.kernels.all_compiled", lambda _axes: False)
    assert "Compiling kernels (first run only) …" in run(capsys, "plan")[2]
    monkeypatch.setattr("flexneedle.phantom.kernels.all_compiled", lambda _axes: True)
    assert "Compiling" not in run(capsys, "plan")[2]


def test_a_target_has_two_or_three_numbers(capsys):
    for given in (["1"], ["1", "2", "3", "4"], ["40", "5", "phantom"]):
        with pytest.raises(SystemExit) as caught:
            cli.main(["insert", "--target", *given])
        assert caught.value.code == 2
        line = capsys.readouterr().err.splitlines()[-1]
        rule = "must be two or three numbers (depth, y and, in space, z); put SCENARIO before --target"
        assert line.endswith(f"{' '.join(given)}: {rule}")


def test_a_target_in_space_has_two_lateral_offsets(engine, capsys):
    engine()
    status, out, _ = run(capsys, "insert", "phantom3d", "--target", "30", "-4.5", "2")
    assert status in (0, 1)
    assert "target (depth, lateral offsets)" in out
    assert "30, -4.5, 2 mm" in out
    assert re.search(r"^ bevel rolls +\d", out, re.MULTILINE)


def test_a_plan_in_space_has_two_entry_angles(engine, capsys):
    engine()
    _, out, _ = run(capsys, "plan", "phantom3d")
    assert re.search(r"^ entry angles +[+-]\d+\.\d\d°, [+-]\d+\.\d\d° $", out, re.MULTILINE)
    _, out, _ = run(capsys, "plan", "phantom")
    assert re.search(r"^ entry angle +[+-]\d+\.\d\d° $", out, re.MULTILINE)


def test_the_target_is_depth_then_lateral_offset(engine, capsys):
    engine()
    status, out, _ = run(capsys, "insert", "--json", "--target", "30", "-4.5")
    result = json.loads(out)
    assert status == 0
    assert result["target_mm"] == [30.0, -4.5, 0.0]
    stored = json.loads((Path(result["run_dir"]) / "run.json").read_text())
    assert stored["scenario"]["target"] == {"depth_mm": 30.0, "lateral_mm": -4.5, "lateral_z_mm": 0.0}


def test_a_miss_is_reported_and_fails(engine, capsys):
    engine(miss=1.4)
    status, out, _ = run(capsys, "insert")
    assert status == 1
    assert out.startswith("MISSED: the tip ended 1.410 mm from the target, more than 1 mm\n")


def test_a_held_insertion_fails_with_its_reason(engine, capsys, in_tmp):
    engine(outcome="held")
    status, out, _ = run(capsys, "insert", "--out", "here")
    assert status == 1
    assert out.startswith("Held after 69 periods: no sample for 1.00 s\n")
    assert json.loads((in_tmp / "here/run.json").read_text())["status"] == "held"


def test_an_unreachable_plan_is_refused_and_recorded(engine, capsys, in_tmp):
    engine(plan_miss=2.5)
    status, out, err = run(capsys, "insert", "--json", "--out", "here", "--controller", "open-loop")
    result, stored = json.loads(out), json.loads((in_tmp / "here/run.json").read_text())
    assert (status, list(result)) == (1, INSERT_KEYS)
    assert err.splitlines()[-1] == f"flexneedle: {result['reason']}"
    assert result["reason"].startswith("plan misses the target by 2.51 mm, limited by setup.")
    assert (result["outcome"], result["reached"], result["steps"]) == ("refused", False, 0)
    assert (result["planned_error_mm"], result["planned_flips"]) == (pytest.approx(2.51), 1)
    assert (result["run_dir"], result["timing"]["plan_seconds"]) == ("here", 0.71)
    assert names(in_tmp / "here") == ["plan.png", "plan.svg", "run.json", "trace.mcap"]
    assert stored["status"] == "failed"
    assert stored["result"] == {key: result[key] for key in INSERT_KEYS if key not in ("run_dir", "timing")}


@pytest.mark.parametrize(
    ("argv", "reason"),
    [
        (
            ["--strategy", "steering", "--controller", "resolved-rate"],
            "controller = 'resolved-rate': needs a guide that moves, strategy = 'steering' does not move it: "
            "use 'manipulation'",
        ),
        (
            ["case.toml", "--controller", "broyden-mpc"],
            "controller = 'broyden-mpc': needs a guide that moves: set setup.guide_to_skin_mm",
        ),
    ],
)
def test_a_refusal_before_the_plan_prints_the_same_keys(argv, reason, capsys, in_tmp, minimal_text):
    (in_tmp / "case.toml").write_text(minimal_text)
    status, out, err = run(capsys, "insert", "--json", "--seed", "4", *argv)
    result = json.loads(out)
    assert (status, list(result), err) == (2, INSERT_KEYS, f"flexneedle: {reason}\n")
    assert (result["outcome"], result["reason"], result["reached"]) == ("refused", reason, False)
    assert (result["controller"], result["target_mm"], result["seed"]) == (argv[-1], [40.0, 5.0, 0.0], 4)
    assert (result["run_dir"], result["planned_error_mm"]) == (None, None)
    assert result["timing"] == {"plan_seconds": None, "period_ms": {"p50": None, "p99": None, "max": None}}
    assert names(in_tmp) == ["case.toml"]


def test_a_held_insertion_prints_its_object(engine, capsys):
    engine(outcome="held")
    status, out, _ = run(capsys, "insert", "--json")
    result = json.loads(out)
    assert (status, list(result)) == (1, INSERT_KEYS)
    assert (result["outcome"], result["reason"], result["steps"]) == ("held", "no sample for 1.00 s", 69)


def test_a_failure_during_the_insertion_prints_the_partial_result(engine, capsys):
    def fail():
        raise RunError("the driver is gone")

    engine(stop=(20, fail))
    status, out, err = run(capsys, "insert", "--json")
    result = json.loads(out)
    assert (status, list(result)) == (1, INSERT_KEYS)
    assert (result["outcome"], result["reason"], result["steps"]) == ("failed", "the driver is gone", 20)
    assert result["timing"]["period_ms"]["max"] == pytest.approx(5.1 + 0.01 * 19)
    assert err.splitlines()[-1] == "flexneedle: the driver is gone"


def test_an_invalid_argument_prints_no_object(capsys):
    status, out, _ = run(capsys, "insert", "--json", "--controller", "pid")
    assert (status, out) == (2, "")


def test_what_limits_a_plan_that_misses_is_named(engine, capsys):
    """The default controller inserts nevertheless."""
    engine(plan_miss=2.5)
    status, _, err = run(capsys, "insert", "--out", "missed")
    assert status == 1
    assert "flexneedle: warning: the plan MISSES the target: best distance 2.510 mm" in err
    assert "limited by setup.max_guide_travel_mm = 15" in err
    engine()
    assert "warning" not in run(capsys, "insert", "--out", "reached")[2]


def test_force_inserts_despite_a_planned_miss(engine, capsys):
    engine(plan_miss=2.5)
    status, out, _ = run(capsys, "insert", "--json", "--force", "--controller", "open-loop")
    assert status == 1
    assert json.loads(out)["planned_error_mm"] == pytest.approx(2.51)


def test_a_failure_during_the_insertion_keeps_the_periods(engine, capsys, in_tmp):
    def fail():
        raise RunError("the driver is gone")

    engine(stop=(20, fail))
    status, out, err = run(capsys, "insert", "--out", "here")
    assert (status, out) == (1, "")
    assert err.splitlines()[-2:] == [
        "flexneedle: incomplete record: here",
        "flexneedle: the driver is gone",
    ]
    assert names(in_tmp / "here") == INSERTION_FILES
    stored = json.loads((in_tmp / "here/run.json").read_text())
    assert (stored["status"], stored["reason"]) == ("failed", "the driver is gone")


def test_ctrl_c_keeps_and_marks_the_record(in_tmp):
    done = run_process("SIGINT", "insert", "--json", "--out", "here")
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.splitlines()[-1] == "flexneedle: interrupted; record: here"
    stored = json.loads((in_tmp / "here/run.json").read_text())
    assert (stored["status"], stored["result"]["steps"]) == ("interrupted", 12)
    assert names(in_tmp / "here") == INSERTION_FILES


@pytest.mark.usefixtures("real_figures")
def test_ctrl_c_while_planning_marks_the_record(engine, capsys, in_tmp, monkeypatch):
    engine()

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("flexneedle.record.recording.make_plan", interrupted)
    status, out, err = run(capsys, "insert", "--out", "here")
    assert (status, out, err.splitlines()[-1]) == (130, "", "flexneedle: interrupted")
    assert json.loads((in_tmp / "here/run.json").read_text())["status"] == "interrupted"
    assert run(capsys, "view", "here")[0] == 1


def test_a_killed_run_can_be_viewed_and_exported(in_tmp, capsys):
    assert run_process("SIGKILL", "insert", "--out", "here").returncode == -signal.SIGKILL
    assert names(in_tmp / "here") == ["run.json", "trace.mcap"]
    assert run(capsys, "view", "here")[:2] == (0, "here/insertion.png\nhere/insertion.svg\n")
    status, out, err = run(capsys, "export", "here", "--csv", "-")
    assert status == 0
    assert len(list(csv.DictReader(out.splitlines()))) == 12
    assert "incomplete: 12 complete periods read" in err


@pytest.mark.usefixtures("real_figures")
def test_the_same_seed_gives_the_same_bytes_and_view_redraws_them(engine, capsys, in_tmp):
    engine()
    for folder, seed in (("first", "5"), ("second", "5"), ("third", "6")):
        run(capsys, "insert", "--seed", seed, "--out", folder)
    first = reproducible(in_tmp / "first")
    assert first == reproducible(in_tmp / "second")
    assert first != reproducible(in_tmp / "third")
    (in_tmp / "first/insertion.png").unlink()
    assert run(capsys, "view", "first")[0] == 0
    assert reproducible(in_tmp / "first") == first


@pytest.mark.parametrize("command", ["plan", "insert"])
def test_a_folder_with_a_run_is_refused(engine, capsys, in_tmp, command):
    engine()
    run(capsys, "insert", "--out", "here")
    before = {path.name: path.read_bytes() for path in (in_tmp / "here").iterdir()}
    status, out, err = run(capsys, command, "--out", "here")
    assert (status, out) == (2, "")
    assert err == "flexneedle: here: already contains a run (run.json): choose another folder\n"
    assert {path.name: path.read_bytes() for path in (in_tmp / "here").iterdir()} == before


@pytest.mark.parametrize(
    "argv",
    [
        ["insert", "nowhere.toml"],
        ["insert", "--target", "1000", "0"],
        ["plan", "--target", "nan", "0"],
        ["view", "nowhere"],
        ["export", "nowhere", "--csv"],
        ["export", "nowhere", "--readings"],
    ],
)
def test_bad_input_is_one_line_with_status_2_and_writes_nothing(argv, capsys, in_tmp):
    status, out, err = run(capsys, *argv)
    assert (status, out) == (2, "")
    assert err.startswith("flexneedle: ")
    assert err.count("\n") == 1
    assert names(in_tmp) == []


@pytest.mark.parametrize(
    "argv",
    [
        ["insert", "--seed", "-1"],
        ["insert", "--plan-seed", "-1"],
        ["insert", "--target", "1"],
        ["insert", "--strategy", "both"],
        ["export", "x"],
        ["export", "x", "--csv", "-", "--readings", "-"],
    ],
)
def test_wrong_arguments_exit_with_status_2(argv, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(argv)
    assert caught.value.code == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("argv", "target", "reason"),
    [
        (["nowhere.toml"], None, "nowhere.toml"),
        (["phantom", "--target", "45", "20"], [45.0, 20.0, 0.0], "target.lateral_mm = 20"),
        (["phantom3d", "--target", "45", "2", "-20"], [45.0, 2.0, -20.0], "target.lateral_z_mm = -20"),
    ],
)
def test_a_refused_scenario_prints_the_same_keys(capsys, in_tmp, argv, target, reason):
    status, out, err = run(capsys, "insert", *argv, "--json")
    result = json.loads(out)
    assert (status, list(result), result["outcome"]) == (2, INSERT_KEYS, "refused")
    assert result["target_mm"] == target
    assert reason in result["reason"]
    assert reason in err
    assert names(in_tmp) == []


def test_a_folder_that_is_taken_is_a_refusal(engine, capsys):
    engine()
    run(capsys, "insert", "--out", "here")
    status, out, _ = run(capsys, "insert", "--out", "here", "--json")
    result = json.loads(out)
    assert (status, result["outcome"]) == (2, "refused")
    assert result["reason"].startswith("here: already contains a run (run.json)")
