"""Studies on real worker processes: identical tables for any number of workers and interruptions."""

import json
import signal
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import flexneedle
from flexneedle.errors import InputError, RunError
from flexneedle.lab.study import jobs, pools, provenance, runner
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.runner import run_study
from flexneedle.lab.study.tables import sum_times
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


def test_wall_clock_times_are_in_a_separate_table(uninterrupted):
    timing = pq.read_table(uninterrupted / "timing.parquet").to_pylist()
    assert [row["index"] for row in timing] == list(range(SIZE))
    assert all(row["total_s"] > row["control_s"] + row["plant_s"] > 0.0 < row["plan_s"] for row in timing)
    names = set(pq.read_schema(uninterrupted / "runs.parquet").names)
    assert names & set(timing[0]) == {"index", "plan"}
    time = sum_times(uninterrupted)  # a plan counts once
    assert time["plan_s"] == pytest.approx(timing[0]["plan_s"] + timing[-1]["plan_s"])
    total = sum(row["total_s"] for row in timing)
    assert time["control_s"] + time["plant_s"] + time["rest_s"] == pytest.approx(total)


def test_one_plan_is_made_for_each_target_and_used_by_all_cases_and_plants(uninterrupted):
    table = runs(uninterrupted)
    assert {(row["target_depth_mm"], row["plan"]) for row in table} == {
        (depth, next(row["plan"] for row in table if row["target_depth_mm"] == depth))
        for depth in (8.0, 10.0)
    }
    made = sorted(path.stem for path in (uninterrupted / "plans").iterdir())
    assert made == sorted({row["plan"] for row in table})
    assert len(made) == 2


@pytest.mark.long
def test_two_processes_write_the_same_bytes_as_threads(quick, uninterrupted, tmp_path):
    assert tables(run_study(quick, tmp_path / "two", workers=2)) == tables(uninterrupted)


@pytest.mark.long
@pytest.mark.usefixtures("in_threads")
def test_a_killed_study_resumes_and_ends_with_the_same_bytes(quick, uninterrupted, tmp_path):
    """The workers exit with the parent, else `stop` would not return."""
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
    assert [(a.plans, a.insertions, a.unfinished) for a in (reports[0], reports[-1])] == [
        (0, 0, 0),
        (2, SIZE, 12),
    ]
    assert [a.insertions for a in reports] == sorted(a.insertions for a in reports)
    assert {(a.all_plans, a.all_insertions) for a in reports} == {(2, SIZE)}


@pytest.mark.parametrize(("name", "there"), [("numpy", "1.0"), ("source", "0"), ("scipy", None)])
@pytest.mark.usefixtures("in_threads")
def test_a_worker_with_other_package_versions_makes_neither_plan_nor_row(
    quick, tmp_path, monkeypatch, name, there
):
    others = {key: value for key, value in {**versions(), name: there}.items() if value}
    compared = provenance.find_difference

    def compare_in_worker(code):
        monkeypatch.setattr(provenance, "versions", lambda: others)
        return compared(code)

    monkeypatch.setattr(provenance, "find_difference", compare_in_worker)
    message = (
        f"^worker process [0-9]+: version of {name} is {there or 'missing'} there, {versions()[name]} here: "
    )
    with pytest.raises(RunError, match=message):
        run_study(quick, tmp_path / "a")
    assert runs(tmp_path / "a") == []
    assert not (tmp_path / "a" / "plans").exists()


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
            RunError, match=r"workers were lost \(BrokenExecutor: .*\); finished rows are kept"
        ):
            run_study(quick, tmp_path / "a")
    assert len(runs(tmp_path / "a")) == 4
    run_study(quick, tmp_path / "a", workers=2, resume=True)
    assert tables(tmp_path / "a") == tables(uninterrupted)


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_study_killed_before_its_start_is_started_by_resume(quick, uninterrupted, tmp_path):
    (tmp_path / "journal.jsonl").touch()
    assert tables(run_study(quick, tmp_path, resume=True)) == tables(uninterrupted)


@pytest.mark.parametrize(
    ("old", "new", "resume", "message"),
    [
        ("", "", False, "already contains a study"),
        ("repeats = 2", "repeats = 3", True, "cannot resume: repeats is 2 in the folder, 3 now"),
        (
            "-0.5]",
            "-0.6]",
            True,
            r"cannot resume: axes.target is \[.*-0.5\]\] in the folder, \[.*-0.6\]\] now",
        ),
    ],
)
def test_only_the_same_study_is_resumed_in_its_folder(
    quick, uninterrupted, tmp_path, old, new, resume, message
):
    changed = tmp_path / "changed.toml"
    changed.write_text(quick.read_text().replace(old, new))
    before = tables(uninterrupted)
    with pytest.raises(InputError, match=message):
        run_study(changed, uninterrupted, resume=resume)
    assert tables(uninterrupted) == before


def test_other_versions_other_files_and_other_workers_are_refused(
    quick, uninterrupted, tmp_path, monkeypatch
):
    with monkeypatch.context() as patch:
        patch.setattr("flexneedle.lab.study.folder.versions", lambda: {**versions(), "source": "0.1"})
        with pytest.raises(
            InputError, match=rf"versions.source is {versions()['source']} in the folder, 0.1 now"
        ):
            run_study(quick, uninterrupted, resume=True)
    (tmp_path / "thesis.tex").touch()
    for resume in (False, True):
        with pytest.raises(InputError, match="exists and is not an empty folder"):
            run_study(quick, tmp_path, resume=resume)
    for options in ({"workers": 0}, {"workers": 1.5}, {"workers": 1, "scheduler": "tcp://host:1"}):
        with pytest.raises(InputError, match=f"^workers = {options['workers']}: "):
            run_study(quick, tmp_path / "a", **options)


@pytest.mark.slow
def test_a_script_without_the_guard_ends_with_the_remedy(quick, tmp_path):
    """Its workers, which import it, create no folder."""
    script = tmp_path / "script.py"
    script.write_text(f"from flexneedle import run_study\nrun_study({str(quick)!r}, workers=1)\n")
    command = [sys.executable, str(script)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1
    assert "a script needs the guard `if __name__ == '__main__':`" in done.stderr.splitlines()[-1]
    assert len(list((tmp_path / "runs").iterdir())) == 1
