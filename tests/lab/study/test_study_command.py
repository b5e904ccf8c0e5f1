"""`flexneedle study`: results, exit status, progress."""

import json
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from flexneedle.cli import main as cli
from flexneedle.lab.commands import study as study_command
from flexneedle.lab.study import jobs, pools
from flexneedle.lab.study.runner import StudyProgress

STUDY = """\
name = "my study"
title = "Two targets"
[values]
plan = { samples = 16, iterations = 2 }
control.ce_mpc = { samples = 8, iterations = 1, horizon = 2 }
setup.tip_to_skin_mm = 4.0
target.lateral_mm = 0.5
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }
[[axes]]
key = "plant"
values = ["exact", "model"]
[[axes]]
key = "target.depth_mm"
values = [8, 10]
"""


@pytest.fixture(autouse=True)
def in_threads_and_tmp(tmp_path, monkeypatch):
    """Run in an empty folder, with threads of this process as workers."""

    @contextmanager
    def local(workers=None):
        with ThreadPoolExecutor(workers or 1) as pool:
            yield pool

    monkeypatch.setattr(pools, "open_processes", local)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.toml").write_text(STUDY)
    return tmp_path


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(("study", *argv))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_a_study_writes_tables_to_a_new_folder_and_prints_one(capsys, in_threads_and_tmp):
    status, out, err = run(capsys, "my.toml")
    assert status == 0
    (folder,) = (in_threads_and_tmp / "runs").iterdir()
    assert re.fullmatch(r"\d{8}T\d{6}Z-study-my-study", folder.name)
    assert sorted(path.name for path in folder.iterdir()) == [
        *("journal.jsonl", "plans", "runs.parquet", "study.json", "timing.parquet")
    ]
    assert out.startswith("Two targets\n")
    assert re.search(r"^ exact +2 of 2 +0\.\d{3} ± 0\.\d{3} ", out, re.MULTILINE)
    assert re.search(r"^ all +4 of 4 ", out, re.MULTILINE)
    assert out.endswith(f"Tables: runs/{folder.name}\n")
    assert re.search(r"^Inserting 100%: 4 of 4, [\d.]+/s, 0 s left$", err, re.MULTILINE)
    assert "Planning 100%: 2 of 2 plans" in err
    assert f"Two targets: 4 insertions, folder runs/{folder.name}\n" in err
    assert "\x1b" not in out + err


def test_json_is_one_object(capsys):
    status, out, _ = run(capsys, "my.toml", "--out", "a", "--json")
    result = json.loads(out)
    assert status == 0
    assert (result["study"], result["folder"], result["complete"]) == ("my study", "a", True)
    assert (result["insertions"], result["outcomes"]) == (4, {"done": 4})
    assert set(result["true_error_mm"]) == {"mean", "sd", "median", "p95", "max"}
    assert [group["settings"] for group in result["groups"]] == [{"plant": "exact"}, {"plant": "model"}]
    assert set(result["time"]) == {"plan_s", "control_s", "plant_s", "rest_s", "wall_s"}


def test_the_record_has_the_command_versions_and_the_whole_study(capsys):
    run(capsys, "my.toml", "--out", "a", "--workers", "2")
    record = json.loads(Path("a/study.json").read_text())
    assert record["command"] == "flexneedle study my.toml --workers 2 --out a"
    assert record["study"]["scenario"]["name"] == "Two-layer tissue phantom"
    assert record["study"]["axes"] == {"plant": ["exact", "model"], "target.depth_mm": [8, 10]}
    assert set(record["versions"]) == {"flexneedle", "python", "numpy", "numba", "source"}


def test_an_existing_study_folder_is_used_only_to_resume(capsys):
    assert run(capsys, "my.toml", "--out", "a")[0] == 0
    status, out, err = run(capsys, "my.toml", "--out", "a")
    assert (status, out) == (2, "")
    assert err.splitlines()[-1] == (
        "flexneedle: a: already contains a study: add --resume to continue it, or set another --out"
    )
    assert run(capsys, "my.toml", "--out", "a", "--resume")[0] == 0


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["my.toml", "--resume"], "--resume needs the folder of the study: add --out DIR"),
        (
            ["my.toml", "--workers", "2", "--scheduler", "x"],
            "--workers sets local processes: remove it, or remove --scheduler",
        ),
        (["no.toml"], "no.toml: no such file, and no such study (choices: controllers, gauges, "),
    ],
)
def test_bad_input_is_one_line(capsys, argv, line):
    status, out, err = run(capsys, *argv)
    assert (status, out) == (2, "")
    assert err.startswith(f"flexneedle: {line}")
    assert err.count("\n") == 1


def test_some_failures_are_counted_and_all_failures_fail(capsys, monkeypatch):
    insert = jobs.insert

    def some(scenario, made, seed, **options):
        if seed == 0:
            raise ZeroDivisionError
        return insert(scenario, made, seed, **options)

    monkeypatch.setattr(jobs, "insert", some)
    status, out, err = run(capsys, "my.toml", "--out", "some", "--json")
    assert (status, json.loads(out)["outcomes"]) == (0, {"error": 2, "done": 2})
    assert ", 2 not finished" in err
    monkeypatch.setattr(jobs, "insert", None)
    status, out, _ = run(capsys, "my.toml", "--out", "all", "--json")
    assert (status, json.loads(out)["outcomes"]) == (1, {"error": 4})
    status, out, _ = run(capsys, "my.toml", "--out", "table")
    assert status == 1
    assert re.search(r"^ all +0 of 4 +– ± – ", out, re.MULTILINE)


def test_the_rate_is_that_of_the_insertions_of_this_run(monkeypatch):
    now, notes = 100.0, []
    monkeypatch.setattr(study_command.time, "monotonic", lambda: now)

    class Listener:
        def show(self, stage, _done, _total, note):
            notes.append((stage, note))

    show = study_command._StudyProgress(Listener())
    for plans, done, later in ((0, 40, 50.0), (1, 40, 8.0), (2, 41, 10.0), (2, 46, 0.0)):
        show.advance(StudyProgress(plans, 2, done, 100, 3))
        now += later
    message = [note for stage, note in notes if stage == "Inserting"]
    assert message[:3] == [f"{done} of 100, 3 not finished" for done in (40, 40, 41)]
    assert message[3] == "46 of 100, 0.5/s, 1 min 48 s left, 3 not finished"


def test_unconverged_periods_are_reported(capsys, monkeypatch):
    insert = jobs.insert

    def unconverged(*args, **options):
        done = insert(*args, **options)
        return replace(done, periods=(replace(done.periods[0], converged=False), *done.periods[1:]))

    monkeypatch.setattr(jobs, "insert", unconverged)
    _, out, _ = run(capsys, "my.toml", "--out", "a")
    assert "4 periods did not converge: see column unconverged_periods of runs.parquet." in out


def test_a_lost_worker_is_one_line_with_the_command_to_resume(capsys, monkeypatch):
    monkeypatch.setattr(jobs, "versions", lambda: {"flexneedle": "0"})
    status, out, err = run(capsys, "my.toml", "--out", "a")
    assert (status, out) == (1, "")
    assert err.splitlines()[-1].startswith(
        "flexneedle: package versions of a worker differ from this process: "
    )
    assert err.splitlines()[-1].endswith(": flexneedle study my.toml --out a --resume")
