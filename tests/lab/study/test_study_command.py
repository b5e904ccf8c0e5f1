"""`flexneedle study`: results, exit status, messages, progress."""

import json
import re
from dataclasses import replace
from math import nan
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest

from flexneedle.cli import main as cli
from flexneedle.cli.progress import Progress
from flexneedle.invasiveness import format_number
from flexneedle.lab.commands import study as study_command
from flexneedle.lab.study import jobs, pools, provenance
from flexneedle.lab.study.runner import StudyProgress
from small_study import STUDY

SIZE = 8


@pytest.fixture
def here(tmp_path, monkeypatch, in_threads):  # noqa: ARG001
    """An empty folder with the file of a study, the current one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.toml").write_text(STUDY)
    return tmp_path


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(tuple(map(str, argv)))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_a_study_writes_tables_to_a_new_folder_and_prints_one(capsys, here, monkeypatch):
    insert = jobs.insert

    def unconverged(*args, **options):
        done = insert(*args, **options)
        return replace(done, periods=(replace(done.periods[0], converged=False), *done.periods[1:]))

    monkeypatch.setattr(jobs, "insert", unconverged)
    status, out, err = run(capsys, "study", "my.toml")
    assert status == 0
    (folder,) = (here / "runs").iterdir()
    assert re.fullmatch(r"\d{8}T\d{6}Z-study-mine", folder.name)
    assert sorted(path.name for path in folder.iterdir()) == [
        *("journal.jsonl", "plans", "runs.parquet", "study.json", "timing.parquet")
    ]
    assert out.startswith("Mine\n")
    assert re.search(r"^ phantom.tracker_bias_mm 0.3 +4 of 4 +\d\.\d{3} ± \d\.\d{3} ", out, re.MULTILINE)
    assert re.search(r"^ open-loop, all +8 of 8 ", out, re.MULTILINE)
    rows = pq.read_table(folder / "runs.parquet").to_pandas()
    peak, mean, end = (format_number(rows[f"{of}_energy_uj"].mean()) for of in ("peak", "mean", "end"))
    assert re.search(rf"^ open-loop, all +{peak}, {mean}, {end} ", out, re.MULTILINE)
    assert f" {rows.guide_travel_mm.mean():.1f} ({rows.planned_guide_travel_mm.mean():.1f}) " in out
    assert "8 periods did not converge" in out
    assert out.endswith(f"Tables: runs/{folder.name}\n")
    assert re.search(r"^Inserting 100%: 8 of 8, [\d.]+/s, 0 s left$", err, re.MULTILINE)
    assert "Planning 100%: 2 of 2 plans" in err
    assert f"Mine: 8 insertions, folder runs/{folder.name}\n" in err
    assert "\x1b" not in out + err


def test_sensors_along_the_needle_have_columns_and_a_table(capsys, here):
    sensor = (
        "sensor = [{ kind = 'slice', plane_mm = 2, phantom = { fault = { kind = 'frozen', depth_mm = 3 } } }]"
    )
    (here / "my.toml").write_text(f"{STUDY}[[cases]]\nname = 'slice'\nvalues = {{ {sensor} }}\n")
    status, out, _ = run(capsys, "study", "my.toml", "--out", "a")
    assert status == 0
    rows = pq.read_table("a/runs.parquet").to_pylist()
    verdicts = {
        case: {row["sensor_slice_excluded"] for row in rows if row["case"] == case}
        for case in ("base", "slice")
    }
    assert verdicts == {"base": {None}, "slice": {"frozen"}}
    assert all(row["sensor_slice_excluded_mm"] > 3.0 for row in rows if row["case"] == "slice")
    assert re.search(r"^ slice, phantom.tracker_bias_mm 0.3 +slice +2 +– +2 frozen ", out, re.MULTILINE)


def test_margins_are_entered_by_no_number_of_insertions_that_did_not_run():
    zones = SimpleNamespace(entered=0, count=3, least_clearance_mm=nan, has_clearances=False)
    assert study_command._format_zones(zones) == ("–", "–")
    ran = SimpleNamespace(entered=0, count=3, least_clearance_mm=1.0, has_clearances=True)
    assert study_command._format_zones(ran) == ("1.000", "0 of 3")


@pytest.mark.usefixtures("here")
def test_json_is_one_object_and_a_study_is_only_resumed_on_request(capsys):
    status, out, _ = run(capsys, "study", "my.toml", "--out", "a", "--workers", "2", "--json")
    result = json.loads(out)
    assert status == 0
    assert (result["study"], result["folder"], result["missing"]) == ("Mine", "a", 0)
    assert (result["insertions"], result["outcomes"]) == (SIZE, {"done": SIZE})
    assert [group["levels"]["phantom.tracker_bias_mm"] for group in result["groups"]] == ["0", "0.3"]
    assert set(result["time"]) == {"plan_s", "control_s", "plant_s", "rest_s", "wall_s"}
    record = json.loads(Path("a/study.json").read_text())
    assert record["command"] == "flexneedle study my.toml --workers 2 --out a"
    assert set(record["versions"]) == {"flexneedle", "python", "numpy", "numba", "scipy", "source"}
    status, out, err = run(capsys, "study", "my.toml", "--out", "a")
    assert (status, out) == (2, "")
    assert "a: already contains a study: add --resume" in err.splitlines()[-1]
    assert run(capsys, "study", "my.toml", "--out", "a", "--resume")[0] == 0


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["my.toml", "--resume"], "--out DIR"),
        (["my.toml", "--workers", "2", "--scheduler", "x"], "remove --scheduler"),
        (["nope", "--scheduler", "foo"], '--scheduler = "foo"'),
        (["no.toml"], "no.toml: no such file, and no such study (choices: controllers, gauges, "),
        (["my.toml", "--out", "a" * 300], "a: cannot be written"),
    ],
)
def test_bad_input_is_one_line(capsys, argv, words):
    status, out, err = run(capsys, "study", *argv)
    assert (status, out) == (2, "")
    assert words in err.splitlines()[-1]


def test_an_invalid_number_of_workers_is_rejected(capsys):
    for text in ("two", "0", "1.5", "٢"):
        with pytest.raises(SystemExit) as caught:
            cli.main(("study", "phantom", f"--workers={text}"))
        assert caught.value.code == 2
        assert f"--workers: {text}" in capsys.readouterr().err


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(("failing", "status"), [((0, 1), 0), (range(4), 1)])
def test_a_study_fails_if_no_insertion_finishes(capsys, monkeypatch, failing, status):
    insert = jobs.insert

    def broken(scenario, made, seed, **options):
        if seed in failing:
            raise ZeroDivisionError("by\nnothing")
        return insert(scenario, made, seed, **options)

    monkeypatch.setattr(jobs, "insert", broken)
    found, out, err = run(capsys, "study", "my.toml", "--out", "a")
    assert found == status
    assert re.search(rf", all +{SIZE - 2 * len(failing)} of 8 ", out)
    assert f", {2 * len(failing)} not finished" in err
    assert ("no insertion finished" in err.splitlines()[-1]) == (status == 1)
    assert ("error: ZeroDivisionError: by nothing" in err.splitlines()[-1]) == (status == 1)


@pytest.mark.usefixtures("here")
def test_a_lost_worker_is_one_line_with_the_command_to_resume(capsys, monkeypatch):
    monkeypatch.setattr(provenance, "find_difference", lambda _: "version of flexneedle is 0 there")
    status, out, err = run(capsys, "study", "my.toml", "--out", "a")
    assert (status, out) == (1, "")
    assert "version of flexneedle is 0 there" in err.splitlines()[-1]
    assert err.splitlines()[-1].endswith(": flexneedle study my.toml --out a --resume")


def progress_of(monkeypatch, *advances):
    """Return (stage, done, note) shown for reports (plans, all plans, insertions, seconds until the next)."""
    now, shown = 100.0, []
    monkeypatch.setattr(study_command.time, "monotonic", lambda: now)

    class Listener:
        def show(self, stage, done, _total, note):
            shown.append((stage, done, note))

    show = study_command._StudyProgress(Listener())
    for plans, all_plans, done, later in advances:
        show.advance(StudyProgress(plans, all_plans, done, 100, 3))
        now += later
    return [(done, note) for stage, done, note in shown if stage == "Planning"], [
        note for stage, _, note in shown if stage == "Inserting"
    ]


def test_rate_and_remaining_time_are_of_this_run(monkeypatch):
    """From the first completed plan and insertion; completed planning is shown once."""
    advances = ((40, 105, 40, 30.0), (41, 105, 40, 20.0), (45, 105, 40, 20.0), (105, 105, 41, 10.0))
    planning, inserting = progress_of(monkeypatch, *advances, (105, 105, 46, 0.0))
    assert planning == [
        (40, "40 of 105 plans"),
        (41, "41 of 105 plans"),
        (45, "45 of 105 plans, 0.2/s, 5 min 0 s left"),
        (105, "105 of 105 plans, 1.6/s, 0 s left"),
    ]
    assert inserting[-2:] == [
        "41 of 100, 3 not finished",
        "46 of 100, 0.5/s, 1 min 48 s left, 3 not finished",
    ]
    assert progress_of(monkeypatch, (0, 0, 100, 0.0))[0] == [(1, "0 of 0 plans")]


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_a_cluster_without_workers_is_reported(capsys, monkeypatch):
    def cluster(_address, _code, on_no_workers):
        on_no_workers()
        return pools.open_processes(1)

    monkeypatch.setattr(pools, "open_cluster", cluster)
    monkeypatch.setattr("flexneedle.lab.study.runner._CLUSTER_JOBS", 4)
    status, _, err = run(capsys, "study", "my.toml", "--scheduler", "tcp://host:1", "--out", "a")
    assert status == 0
    assert "tcp://host:1: no workers yet, waiting\n" in err


def test_no_run_is_written_to_the_folder_of_a_study(capsys, tmp_path):
    (tmp_path / "study.json").write_text("{}")
    for command in ("insert", "plan"):
        status, out, err = run(capsys, command, "phantom", "--out", tmp_path)
        assert (status, out) == (2, "")
        assert "already contains a study" in err.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["study.json"]


def test_a_separate_line_is_printed_unchanged_also_in_a_terminal(monkeypatch, capsys):
    for terminal in (False, True):
        monkeypatch.setattr("sys.stderr.isatty", lambda terminal=terminal: terminal)
        with Progress() as progress:
            progress.print_line("[red]x")
        assert "[red]x\n" in capsys.readouterr().err
