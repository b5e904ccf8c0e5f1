"""`flexneedle view --html`: the file, where it is written, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from commands import names, run
from flexneedle.record.loading import load_insertion
from replays import File

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")


@pytest.fixture
def recorded(in_tmp, drawing, engine, capsys):  # noqa: ARG001 - in this order
    """Two insertions and a plan."""
    engine()
    run(capsys, "insert", "--out", "one")
    run(capsys, "insert", "--out", "two", "--seed", "1")
    run(capsys, "plan", "--out", "plan")


def change(name, **values):
    """Change what is recorded of a run."""
    path = Path(name) / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.mark.usefixtures("recorded")
def test_the_file_is_written_beside_the_record_or_where_it_is_asked_for(capsys, in_tmp):
    assert run(capsys, "view", "one", "--html") == (0, "one/replay.html\n", "")
    text = (in_tmp / "one/replay.html").read_text(encoding="utf-8")
    assert run(capsys, "view", "one", "--html", "other.html") == (0, "other.html\n", "")
    assert (in_tmp / "other.html").read_text(encoding="utf-8") == text
    assert run(capsys, "view", "one", "--html", "-") == (0, text, "")
    news = [each for each in File.of(text).record if isinstance(each, dict)]
    assert [(each["type"], each["of"]) for each in news] == [("insertion", "first"), ("rows", "first")]
    assert (news[0]["name"], news[0]["state"], len(news[1]["rows"])) == ("one", "done", 69)


@pytest.mark.usefixtures("recorded")
def test_two_runs_are_compared(capsys):
    status, out, err = run(capsys, "view", "one", "--html", "-", "--compare", "two")
    assert (status, err) == (0, "")
    file = File.of(out)
    news = [each for each in file.record if isinstance(each, dict) and each["type"] == "insertion"]
    shown = [(each["of"], each["name"], each["seed"]) for each in news]
    assert shown == [("first", "one", 0), ("second", "two", 1)]
    assert file.all("title") == ["one and two – flexneedle"]


@pytest.mark.usefixtures("recorded")
def test_the_name_is_that_of_the_folder(capsys, in_tmp, monkeypatch):
    monkeypatch.chdir(in_tmp / "one")
    assert File.of(run(capsys, "view", ".", "--html", "-")[1]).record[0]["name"] == "one"


@pytest.mark.usefixtures("recorded")
def test_a_held_insertion_is_replayed(capsys):
    change("one", status="held", reason="no sample for 1.00 s")
    news = File.of(run(capsys, "view", "one", "--html", "-")[1]).record[0]
    assert (news["state"], news["summary"]) == ("held", "held after 69 periods: no sample for 1.00 s")


@pytest.mark.usefixtures("recorded")
def test_an_incomplete_trace_is_replayed_as_far_as_it_goes(capsys, in_tmp):
    trace = in_tmp / "one/trace.mcap"
    trace.write_bytes(trace.read_bytes()[:-2000])
    status, out, err = run(capsys, "view", "one", "--html", "-")
    assert status == 0
    assert err.startswith("flexneedle: one/trace.mcap: ")
    news, *_, rows = File.of(out).record
    assert news["summary"].endswith("; the trace is not complete")
    assert news["periods"] == len(rows["rows"]) > 0
    assert "trace.mcap" not in out


def refused(capsys, *argv):
    """Exit status and message of a command that writes nothing."""
    status, out, err = run(capsys, "view", *argv)
    assert out == ""
    return status, err


@pytest.mark.usefixtures("recorded")
def test_what_has_no_finished_insertion_is_refused(capsys, in_tmp):
    change("two", status="running")
    (in_tmp / "none").mkdir()
    before = names(in_tmp / "two")
    missing = "flexneedle: none: contains no run: run.json is missing\n"
    assert refused(capsys, "none", "--html") == (2, missing)
    assert refused(capsys, "plan", "--html") == (2, "flexneedle: plan: contains a plan, not an insertion\n")
    unfinished = (
        "flexneedle: two: no end is recorded: the run was killed, its disk was full, or it is still running; "
        "a replay needs a finished run\n"
    )
    assert refused(capsys, "two", "--html") == (1, unfinished)
    assert refused(capsys, "one", "--html", "x.html", "--compare", "two") == (1, unfinished)
    assert names(in_tmp / "two") == before
    assert not (in_tmp / "x.html").exists()


@pytest.mark.usefixtures("recorded")
def test_an_insertion_without_a_period_is_refused(capsys, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.page.replay.load_insertion", without_periods)
    assert refused(capsys, "one", "--html") == (
        1,
        "flexneedle: one: nothing to replay: no control period is recorded\n",
    )


def without_periods(folder):
    insertion, lacking = load_insertion(folder)
    return replace(insertion, periods=()), lacking


@pytest.mark.usefixtures("recorded")
def test_a_place_that_cannot_be_written_is_one_line(capsys):
    assert refused(capsys, "one", "--html", "none/x.html") == (
        1,
        "flexneedle: x.html cannot be written: No such file or directory\n",
    )


def test_a_second_run_needs_html(capsys):
    assert refused(capsys, "one", "--compare", "two") == (2, "flexneedle: --compare: needs --html\n")
