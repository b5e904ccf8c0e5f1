"""Studies on real worker processes: identical tables for any number of workers and interruptions."""

import json
import shutil
import signal
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import flexneedle
from flexneedle.errors import InputError, RunError
from flexneedle.lab.study import jobs, pools, runner
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.runner import run_study
from flexneedle.lab.study.summary import summarize_study
from flexneedle.record.folder import versions

STOPPED = Path(__file__).with_name("stopped.py")
SIZE = 16


def tables(folder):
    return (folder / "runs.parquet").read_bytes()


def runs(folder):
    return pq.read_table(folder / "runs.parquet").to_pylist()


def stop(signal_name, after, *argv):
    """Run the command line in a process that receives a signal after `after` rows; returns once its workers ended."""
    command = [sys.executable, str(STOPPED), signal_name, str(after), *map(str, argv)]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=120, start_new_session=True
    )


def journalled(folder):
    """Return the indices of the rows in the journal, in the order of writing."""
    return [json.loads(line)["index"] for line in (folder / "journal.jsonl").read_text().splitlines()]


def test_a_study_writes_one_row_per_insertion_in_grid_order(quick, uninterrupted):
    study, table = load_study(quick), runs(uninterrupted)
    assert len(study) == SIZE
    for index, row in enumerate(table):
        insertion = study.insertion(index)
        point = insertion.point
        settings = {name: row[name] for name in point.scenario.flat()}
        assert row["index"] == index
        assert settings == point.scenario.flat()
        assert (row["target_depth_mm"], row["target_lateral_mm"]) == point.scenario.target.position[:2]
        assert (row["seed"], row["repeat"], row["case"]) == (insertion.seed, insertion.repeat, point.case)
        assert (row["controller"], row["plant"]) == (point.controller, point.plant)
        assert (row["strategy"], row["plan_seed"]) == ("manipulation", 0)
        assert {name: row[f"version_{name}"] for name in versions()} == versions()
        assert row["outcome"] == "done"


def test_a_row_agrees_with_insert_for_its_settings(quick, uninterrupted):
    point = load_study(quick).points[3]
    row = runs(uninterrupted)[7]
    plan = flexneedle.plan(point.scenario, seed=row["plan_seed"])
    insertion = flexneedle.insert(
        point.scenario,
        plan,
        row["seed"],
        controller=row["controller"],
        rig=flexneedle.VirtualRig(row["plant"]),
    )
    assert row["true_error_mm"] == insertion.true_error_mm
    assert row["residual_mm"] == insertion.residual_mm


def test_a_target_and_repeat_has_the_same_phantom_at_all_settings(uninterrupted):
    table = runs(uninterrupted)
    seeds = {(row["target_depth_mm"], row["repeat"]): set() for row in table}
    for row in table:
        seeds[row["target_depth_mm"], row["repeat"]].add(row["seed"])
    assert seeds == {(8.0, 0): {7}, (8.0, 1): {8}, (10.0, 0): {9}, (10.0, 1): {10}}


def test_wall_clock_times_are_in_a_separate_table(uninterrupted):
    timing = pq.read_table(uninterrupted / "timing.parquet").to_pylist()
    assert [row["index"] for row in timing] == list(range(SIZE))
    assert all(row["total_s"] > row["control_s"] + row["plant_s"] > 0.0 < row["plan_s"] for row in timing)
    names = set(pq.read_schema(uninterrupted / "runs.parquet").names)
    assert names & set(timing[0]) == {"index", "plan"}


def test_one_plan_is_made_for_each_target_and_used_by_all_cases_and_plants(uninterrupted):
    table = runs(uninterrupted)
    assert {(row["target_depth_mm"], row["plan"]) for row in table} == {
        (depth, next(row["plan"] for row in table if row["target_depth_mm"] == depth))
        for depth in (8.0, 10.0)
    }
    made = sorted(path.stem for path in (uninterrupted / "plans").iterdir())
    assert made == sorted({row["plan"] for row in table})
    assert len(made) == 2


@pytest.mark.slow
def test_one_worker_writes_the_same_bytes_as_two(quick, uninterrupted, tmp_path):
    assert tables(run_study(quick, tmp_path / "one", workers=1)) == tables(uninterrupted)


@pytest.mark.long
@pytest.mark.usefixtures("in_threads")
def test_a_killed_study_resumes_and_ends_with_the_same_bytes(quick, uninterrupted, tmp_path):
    """The workers exit with the parent, else `stop` would not return. Threads give the same bytes."""
    out = tmp_path / "killed"
    killed = stop("SIGKILL", 5, "study", quick, "--workers", 2, "--out", out)
    assert killed.returncode == -signal.SIGKILL
    before = journalled(out)
    assert len(before) == 5
    assert not (out / "runs.parquet").exists()
    run_study(quick, out, resume=True)
    assert journalled(out)[:5] == before
    assert sorted(journalled(out)) == list(range(SIZE))
    assert tables(out) == tables(uninterrupted)


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_ctrl_c_keeps_the_finished_rows_and_prints_how_to_resume(quick, uninterrupted, tmp_path):
    out = tmp_path / "stopped"
    stopped = stop("SIGINT", 4, "study", quick, "--workers", 1, "--out", out)
    assert stopped.returncode == 130
    again = f"flexneedle study {quick} --workers 1 --out {out} --resume"
    assert stopped.stderr.splitlines()[-1] == f"flexneedle: interrupted; resume with: {again}"
    assert "Traceback" not in stopped.stderr
    kept = runs(out)
    assert 4 <= len(kept) < SIZE
    assert {row["index"] for row in kept} == set(journalled(out))
    whole = runs(uninterrupted)
    assert all(row == whole[row["index"]] for row in kept)
    run_study(quick, out, resume=True)
    assert sorted(journalled(out)) == list(range(SIZE))
    assert tables(out) == tables(uninterrupted)


UNGUARDED = "from flexneedle import run_study\nrun_study({!r}, workers=1)\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "kept",
    [(), *(pytest.param(kept, marks=pytest.mark.long) for kept in (("runs",), ("runs", "runs/other")))],
)
def test_a_script_without_the_guard_leaves_no_folder(quick, tmp_path, kept):
    for folder in kept:
        (tmp_path / folder).mkdir()
    (tmp_path / "script.py").write_text(UNGUARDED.format(str(quick)))
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1
    assert "a script needs the guard `if __name__ == '__main__':`" in done.stderr.splitlines()[-1]
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {"script.py", *kept}


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("exists", [False, True])
def test_a_study_that_fails_before_its_first_plan_leaves_the_folders_as_they_were(
    quick, tmp_path, monkeypatch, exists
):
    monkeypatch.setattr(runner, "make_plan", lambda _: 1 / 0)
    out = tmp_path / "above" / "study"
    if exists:
        out.mkdir(parents=True)
    with pytest.raises(RunError, match="workers were lost"):
        run_study(quick, out)
    assert sorted(tmp_path.rglob("*")) == ([out.parent, out] if exists else [])


@pytest.mark.usefixtures("in_threads")
def test_a_plan_is_kept_when_a_study_fails_before_its_first_row(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "run_job", lambda _: 1 / 0)
    with pytest.raises(RunError, match="workers were lost"):
        run_study(quick, tmp_path / "study")
    assert list((tmp_path / "study" / "plans").iterdir())
    assert runs(tmp_path / "study") == []


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_finished_study_is_not_repeated(quick, tmp_path, monkeypatch):
    out = run_study(quick, tmp_path / "again")
    first = tables(out)
    (out / "runs.parquet").unlink()
    monkeypatch.setattr(runner, "run_job", None)
    assert tables(run_study(quick, out, resume=True)) == first


@pytest.mark.usefixtures("in_threads")
def test_a_resumed_study_does_not_repeat_its_plans(quick, tmp_path, monkeypatch):
    """Of two cases with the same two targets; interrupted in the first case."""
    made, study = [], tmp_path / "one-plant.toml"
    study.write_text(quick.read_text().replace('values = "all"', 'values = ["model"]'))
    monkeypatch.setattr(runner, "make_plan", lambda point: made.append(point) or jobs.make_plan(point))

    class StoppedError(Exception):
        pass

    def stop_after_three(advance):
        if advance.insertions == 3:
            raise StoppedError

    with pytest.raises(StoppedError):
        run_study(study, tmp_path / "a", on_advance=stop_after_three)
    run_study(study, tmp_path / "a", resume=True)
    assert sorted(point.scenario.target.depth_mm for point in made) == [8.0, 10.0]


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_study_reports_its_progress(quick, tmp_path):
    reports = []
    run_study(quick, tmp_path / "a", on_advance=reports.append)
    assert [(a.plans, a.insertions) for a in (reports[0], reports[-1])] == [(0, 0), (2, SIZE)]
    assert [a.insertions for a in reports] == sorted(a.insertions for a in reports)
    assert {(a.all_plans, a.all_insertions, a.unfinished) for a in reports} == {(2, SIZE, 0)}


@pytest.mark.usefixtures("in_threads")
def test_failures_are_rows_and_the_study_ends(quick, tmp_path, monkeypatch):
    def plan(scenario, **options):
        if scenario.target.depth_mm == 8.0:
            raise FloatingPointError("overflow")
        return flexneedle.plan(scenario, **options)

    def insert(scenario, made, seed, **options):
        if seed == 10:
            raise RunError("plan misses the target by 1.20 mm")
        return flexneedle.insert(scenario, made, seed, **options)

    monkeypatch.setattr(jobs, "plan", plan)
    monkeypatch.setattr(jobs, "insert", insert)
    reports = []
    out = run_study(quick, tmp_path / "a", on_advance=reports.append)
    table = runs(out)
    assert len(table) == SIZE
    outcomes = {row["seed"]: row["outcome"] for row in table}
    assert outcomes == {7: "error", 8: "error", 9: "done", 10: "refused"}
    assert {row["reason"] for row in table if row["seed"] < 9} == {"no plan: FloatingPointError: overflow"}
    assert all((row["true_error_mm"] is None) == (row["outcome"] != "done") for row in table)
    assert reports[-1].unfinished == 12
    summary = summarize_study(out, load_study(quick))
    assert summary["outcomes"] == {"error": 8, "done": 4, "refused": 4}
    assert summary["first_failure"] == "error: no plan: FloatingPointError: overflow"
    json.dumps(summary, allow_nan=False)


@pytest.mark.usefixtures("in_threads")
def test_a_worker_with_other_package_versions_is_rejected(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "versions", lambda: {**versions(), "numpy": "1.0"})
    with pytest.raises(
        RunError, match=r"package versions of a worker differ from this process: .*'numpy': '1.0'"
    ):
        run_study(quick, tmp_path / "a")
    assert runs(tmp_path / "a") == []


class Dying(Executor):
    """An executor that executes the first calls and then loses its workers."""

    def __init__(self, calls):
        self.left = calls

    def submit(self, function, /, *args, **kwargs):
        future = Future()
        self.left -= 1
        if self.left >= 0:
            future.set_result(function(*args, **kwargs))
        else:
            future.set_exception(BrokenExecutor("a process was terminated abruptly"))
        return future


@pytest.mark.slow
def test_a_lost_worker_ends_the_study_with_its_rows_kept(quick, uninterrupted, tmp_path, monkeypatch):
    @contextmanager
    def dying(_workers):
        yield Dying(6)

    with monkeypatch.context() as patch:
        patch.setattr(pools, "open_processes", dying)
        with pytest.raises(
            RunError, match=r"workers were lost \(BrokenExecutor .*\); finished rows are kept"
        ):
            run_study(quick, tmp_path / "a")
    assert len(runs(tmp_path / "a")) == 4
    run_study(quick, tmp_path / "a", workers=2, resume=True)
    assert tables(tmp_path / "a") == tables(uninterrupted)


def test_a_folder_with_a_study_is_not_overwritten(quick, uninterrupted):
    with pytest.raises(
        InputError, match="already contains a study: add --resume to continue it, or set another"
    ):
        run_study(quick, uninterrupted)


def test_a_folder_with_other_files_is_rejected(quick, tmp_path):
    (tmp_path / "thesis.tex").touch()
    for resume in (False, True):
        with pytest.raises(InputError, match="exists and is not an empty folder"):
            run_study(quick, tmp_path, resume=resume)


@pytest.mark.parametrize(
    ("old", "new", "difference"),
    [
        ("repeats = 2", "repeats = 3", "repeats is 2 in the folder, 3 now"),
        ("horizon = 2", "horizon = 3", "values.control.ce_mpc.horizon is 2 in the folder, 3 now"),
        ("-0.5]", "-0.6]", r"axes.target is \[.*-0.5\]\] in the folder, \[.*-0.6\]\] now"),
    ],
)
def test_another_study_cannot_resume_in_the_folder(quick, uninterrupted, tmp_path, old, new, difference):
    changed = tmp_path / "changed.toml"
    changed.write_text(quick.read_text().replace(old, new))
    before = tables(uninterrupted)
    with pytest.raises(InputError, match=f"cannot resume: {difference}"):
        run_study(changed, uninterrupted, resume=True)
    assert tables(uninterrupted) == before


def test_other_package_versions_cannot_resume_a_study(quick, uninterrupted, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.study.folder.versions", lambda: {**versions(), "numba": "0.1"})
    with pytest.raises(InputError, match=rf"versions.numba is {versions()['numba']} in the folder, 0.1 now"):
        run_study(quick, uninterrupted, resume=True)


def test_edited_code_cannot_resume_a_study(quick, uninterrupted, monkeypatch):
    monkeypatch.setattr(
        "flexneedle.lab.study.folder.versions", lambda: {**versions(), "source": "0123456789ab"}
    )
    with pytest.raises(InputError) as caught:
        run_study(quick, uninterrupted, resume=True)
    assert str(caught.value) == (
        f"{uninterrupted}: cannot resume: the code of flexneedle has changed since the start of the study: "
        f"versions.source is {versions()['source']} in the folder, 0123456789ab now"
    )


def test_a_study_without_a_recorded_code_version_cannot_resume(quick, uninterrupted, tmp_path):
    record = json.loads((uninterrupted / "study.json").read_text())
    del record["versions"]["source"], record["versions"]["numba"]
    (tmp_path / "study.json").write_text(json.dumps(record))
    with pytest.raises(
        InputError, match=r"cannot resume: .*versions\.\w+ is not recorded in the folder, \S+ now$"
    ):
        run_study(quick, tmp_path, resume=True)


def test_an_index_outside_the_study_is_rejected(quick, uninterrupted, tmp_path):
    out = shutil.copytree(uninterrupted, tmp_path / "a")
    text = (out / "journal.jsonl").read_text()
    beyond = json.loads(text.splitlines()[0]) | {"index": SIZE}
    (out / "journal.jsonl").write_text(f"{text}{json.dumps(beyond)}\n")
    with pytest.raises(
        InputError, match="damaged at line 17: index = 16: must be a whole number from 0 to 15"
    ):
        run_study(quick, out, resume=True)
    assert tables(out) == tables(uninterrupted)


def test_a_folder_name_that_is_too_long_is_rejected(quick, tmp_path):
    with pytest.raises(InputError, match=r"a: cannot be written: File name too long$"):
        run_study(quick, tmp_path / ("a" * 300))


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_study_killed_before_its_start_is_started_by_resume(quick, uninterrupted, tmp_path):
    (tmp_path / "journal.jsonl").touch()
    assert tables(run_study(quick, tmp_path, resume=True)) == tables(uninterrupted)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"workers": 0}, "workers = 0: must be a whole number, at least 1; omit it for one per core"),
        (
            {"workers": 1.5},
            "workers = 1.5: must be a whole number, at least 1; omit it for one per core",
        ),
        (
            {"workers": 1, "scheduler": "tcp://host:1"},
            "workers = 1: sets local processes: remove it, or remove the scheduler",
        ),
    ],
)
def test_workers_are_at_least_one_and_local(quick, tmp_path, options, line):
    with pytest.raises(InputError) as caught:
        run_study(quick, tmp_path / "a", **options)
    assert str(caught.value) == line


def test_the_summary_agrees_with_the_table(quick, uninterrupted):
    summary, table = summarize_study(uninterrupted, load_study(quick)), runs(uninterrupted)
    errors = sorted(row["true_error_mm"] for row in table)
    mean = sum(errors) / SIZE
    assert summary["complete"]
    assert summary["first_failure"] is None
    assert summary["outcomes"] == {"done": SIZE}
    spread = summary["true_error_mm"]
    assert (spread["mean"], spread["max"]) == (pytest.approx(mean), errors[-1])
    assert spread["sd"] == pytest.approx((sum((e - mean) ** 2 for e in errors) / (SIZE - 1)) ** 0.5)
    assert spread["median"] == pytest.approx((errors[7] + errors[8]) / 2)
    assert errors[-2] <= spread["p95"] <= errors[-1]
    energy, planned = (sum(r[f"{name}strain_energy_mj"] for r in table) for name in ("", "planned_"))
    assert summary["energy_ratio"] == pytest.approx(energy / planned)
    assert summary["period_ratio"]["max"] == max(row["periods"] / row["planned_periods"] for row in table)
    assert [group["settings"] for group in summary["groups"]] == [
        {"case": case, "plant": plant} for case in ("base", "bias") for plant in ("exact", "model")
    ]
    assert sum(group["insertions"] for group in summary["groups"]) == SIZE
    last = [row["true_error_mm"] for row in table if row["case"] == "bias" and row["plant"] == "model"]
    assert summary["groups"][-1]["true_error_mm"]["max"] == max(last)


def test_the_summary_is_over_finished_insertions_and_counts_the_others(quick, uninterrupted, tmp_path):
    table = pq.read_table(uninterrupted / "runs.parquet")
    changed = table.to_pylist()
    changed[0] |= {
        "outcome": "held",
        "true_error_mm": 50.0,
        "flips": 90,
        "periods": 1,
        "unconverged_periods": 3,
    }
    pq.write_table(pa.Table.from_pylist(changed, schema=table.schema), tmp_path / "runs.parquet")
    shutil.copy(uninterrupted / "timing.parquet", tmp_path)
    summary = summarize_study(tmp_path, load_study(quick))
    assert (summary["insertions"], summary["outcomes"]) == (SIZE, {"done": SIZE - 1, "held": 1})
    rest = changed[1:]
    assert summary["true_error_mm"]["mean"] == pytest.approx(
        sum(r["true_error_mm"] for r in rest) / (SIZE - 1)
    )
    assert summary["flips"] == pytest.approx(sum(row["flips"] for row in rest) / (SIZE - 1))
    assert summary["unconverged_periods"] == 3


def test_the_summary_has_the_coverage_of_tip_and_middle(quick, uninterrupted, tmp_path):
    """Over finished insertions with a prediction, at each fraction of the depth."""
    table = pq.read_table(uninterrupted / "runs.parquet")
    rows = table.to_pylist()
    for number, row in enumerate(rows):
        row["predicted_half_tip_y_sds"] = 2.5 if number % 4 == 0 else -1.5
        row["predicted_half_middle_y_sds"] = 9.0 if number == 0 else None
    rows[0]["outcome"] = "held"
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), tmp_path / "runs.parquet")
    shutil.copy(uninterrupted / "timing.parquet", tmp_path)
    coverage = summarize_study(tmp_path, load_study(quick))["coverage"]
    assert coverage["tip"]["half"] == pytest.approx(12 / 15)
    assert coverage["middle"]["half"] is None


def test_a_plan_counts_once_in_the_time(quick, uninterrupted):
    time = summarize_study(uninterrupted, load_study(quick))["time"]
    timing = pq.read_table(uninterrupted / "timing.parquet").to_pylist()
    assert time["plan_s"] == pytest.approx(timing[0]["plan_s"] + timing[-1]["plan_s"])
    total = sum(row["total_s"] for row in timing)
    assert time["control_s"] + time["plant_s"] + time["rest_s"] == pytest.approx(total)
