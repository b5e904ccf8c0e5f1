"""Messages and progress of `flexneedle study`."""

from dataclasses import replace

import pytest

from flexneedle.cli import main as cli
from flexneedle.cli.progress import Progress
from flexneedle.lab.commands import study as study_command
from flexneedle.lab.study import jobs, pools
from flexneedle.lab.study.runner import StudyProgress


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(tuple(map(str, argv)))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.mark.parametrize("text", ["two", "0", "-1", "1.5", "", "٢"])
def test_an_invalid_number_of_workers_is_rejected_with_the_rule(capsys, text):
    with pytest.raises(SystemExit) as caught:
        cli.main(("study", "phantom", f"--workers={text}"))
    assert caught.value.code == 2
    assert f"argument --workers: {text}: must be a whole number, at least 1\n" in capsys.readouterr().err


def test_an_invalid_address_is_rejected_before_the_study_is_read(capsys):
    status, out, err = run(capsys, "study", "nope", "--scheduler", "foo")
    assert (status, out) == (2, "")
    assert err.startswith('flexneedle: --scheduler = "foo": must be protocol://host:port')
    assert err.count("\n") == 1


@pytest.mark.usefixtures("in_threads")
def test_a_folder_with_too_long_a_name_is_bad_input(capsys, quick):
    status, out, err = run(capsys, "study", quick, "--out", "a" * 300)
    assert (status, out) == (2, "")
    assert err.splitlines()[-1] == f"flexneedle: {'a' * 300}: cannot be written: File name too long"


@pytest.mark.parametrize("command", ["insert", "plan"])
def test_no_run_is_written_to_the_folder_of_a_study(capsys, tmp_path, command):
    (tmp_path / "study.json").write_text("{}")
    status, out, err = run(capsys, command, "phantom", "--out", tmp_path)
    assert (status, out) == (2, "")
    assert err.splitlines()[-1].endswith("already contains a study (study.json): choose another folder")
    assert [path.name for path in tmp_path.iterdir()] == ["study.json"]


@pytest.mark.usefixtures("in_threads")
def test_a_study_without_a_finished_insertion_prints_the_first_failure(capsys, quick, tmp_path, monkeypatch):
    def broken(_scenario, _plan, seed, **_options):
        raise ZeroDivisionError(f"seed\n{seed}")

    monkeypatch.setattr(jobs, "insert", broken)
    line = "flexneedle: no insertion finished; the first failure: error: ZeroDivisionError: seed 7"
    status, _, err = run(capsys, "study", quick, "--out", tmp_path / "a")
    assert (status, err.splitlines()[-1]) == (1, line)


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_study_with_a_finished_insertion_prints_no_failure(capsys, quick, tmp_path, monkeypatch):
    insert = jobs.insert

    def some(scenario, made, seed, **options):
        done = insert(scenario, made, seed, **options)
        return replace(done, outcome="held", reason="no sample") if seed == 7 else done

    monkeypatch.setattr(jobs, "insert", some)
    status, _, err = run(capsys, "study", quick, "--out", tmp_path / "a")
    assert status == 0
    assert "no insertion" not in err


def progress_of(monkeypatch, advances):
    """Return (stage, done, total, note) shown for reports (plans, all plans, insertions, seconds until the next)."""
    now, shown = 100.0, []
    monkeypatch.setattr(study_command.time, "monotonic", lambda: now)

    class Listener:
        def show(self, *args):
            shown.append(args)

    show = study_command._StudyProgress(Listener())
    for plans, all_plans, done, later in advances:
        show.advance(StudyProgress(plans, all_plans, done, 1050, 0))
        now += later
    return [args for args in shown if args[0] == "Planning"], [
        args for args in shown if args[0] == "Inserting"
    ]


def test_planning_rate_and_remaining_time_are_from_the_plans_of_this_run(monkeypatch):
    advances = [
        (40, 105, 0, 30.0),
        (41, 105, 0, 20.0),
        (42, 105, 0, 20.0),
        (45, 105, 0, 20.0),
        (105, 105, 0, 1.0),
    ]
    planning, inserting = progress_of(monkeypatch, advances)
    assert [note for *_, note in planning] == [
        *("40 of 105 plans", "41 of 105 plans"),
        "42 of 105 plans, 0.05/s, 21 min 0 s left",
        "45 of 105 plans, 0.1/s, 10 min 0 s left",
        "105 of 105 plans, 1.1/s, 0 s left",
    ]
    assert {note for *_, note in inserting} == {"0 of 1050"}


def test_completed_planning_is_shown_once(monkeypatch):
    planning, inserting = progress_of(
        monkeypatch, [(1, 2, 0, 9.0), (2, 2, 0, 9.0), (2, 2, 1, 9.0), (2, 2, 2, 9.0)]
    )
    assert [done for _, done, *_ in planning] == [1, 2]
    assert [done for _, done, *_ in inserting] == [0, 0, 1, 2]


def test_a_study_with_all_plans_shows_planning_as_complete(monkeypatch):
    assert progress_of(monkeypatch, [(0, 0, 1050, 0.0)])[0] == [("Planning", 1, 1, "0 of 0 plans")]


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_a_cluster_without_workers_is_reported(capsys, quick, tmp_path, monkeypatch):
    def cluster(_address, on_no_workers):
        on_no_workers()
        return pools.open_processes(1)

    monkeypatch.setattr(pools, "open_cluster", cluster)
    monkeypatch.setattr("flexneedle.lab.study.runner._CLUSTER_JOBS", 4)
    status, _, err = run(capsys, "study", quick, "--scheduler", "tcp://host:1", "--out", tmp_path / "a")
    assert status == 0
    assert "tcp://host:1: no workers yet, waiting\n" in err


def test_a_separate_line_is_printed_unchanged_also_in_a_terminal(monkeypatch, capsys):
    Progress().print_line("[red]x")
    assert capsys.readouterr().err == "[red]x\n"
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Progress() as progress:
        progress.print_line("[red]x")
    assert "[red]x\n" in capsys.readouterr().err
