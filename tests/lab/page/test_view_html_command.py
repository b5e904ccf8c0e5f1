"""`flexneedle view --html`: the file, its place, and refusals."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from commands import names, run
from fake_engine import draw_nothing
from flexneedle.record.loading import load_insertion
from flexneedle.record.saving import save
from replays import File, insertion


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Two insertions and a plan."""
    root = tmp_path_factory.mktemp("saved")
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch.setattr)
        for name, record in {"one": insertion(), "two": insertion(seed=1), "plan": insertion().plan}.items():
            save(record, root / name)
    return root


@pytest.fixture(autouse=True)
def recorded(saved, in_tmp):
    """Copies of them in the present folder."""
    shutil.copytree(saved, in_tmp, dirs_exist_ok=True)


def replay(capsys, *argv):
    """Return the elements of a replay, and the messages of its record."""
    status, out, err = run(capsys, "view", *argv, "--html", "-")
    assert (status, err) == (0, "")
    file = File.of(out)
    return file, [each for each in file.record if isinstance(each, dict)]


def change(name, **values):
    """Change the record of a run."""
    path = Path(name) / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_the_file_is_written_beside_the_record_or_to_a_given_path(capsys, in_tmp):
    assert run(capsys, "view", "one", "--html") == (0, "one/replay.html\n", "")
    text = (in_tmp / "one/replay.html").read_text(encoding="utf-8")
    assert run(capsys, "view", "one", "--html", "other.html") == (0, "other.html\n", "")
    assert (in_tmp / "other.html").read_text(encoding="utf-8") == text
    assert run(capsys, "view", "one", "--html", "-") == (0, text, "")


def test_a_run_is_named_by_its_folder_and_two_are_compared(capsys, in_tmp, monkeypatch):
    _, messages = replay(capsys, "one")
    kinds = ("insertion", "zones", "rows")
    assert [(each["type"], each["of"]) for each in messages] == [(kind, "first") for kind in kinds]
    assert (messages[0]["name"], messages[0]["state"], len(messages[-1]["rows"])) == ("one", "done", 69)
    file, messages = replay(capsys, "one", "--compare", "two")
    shown = [(each["of"], each["name"], each["seed"]) for each in messages if each["type"] == "insertion"]
    assert shown == [("first", "one", 0), ("second", "two", 1)]
    assert file.all("title") == ["one and two – flexneedle"]
    monkeypatch.chdir(in_tmp / "one")
    assert replay(capsys, ".")[1][0]["name"] == "one"


def test_a_held_insertion_and_an_incomplete_trace_are_replayed(capsys, in_tmp):
    change("one", status="held", reason="no sample for 1.00 s")
    shown = replay(capsys, "one")[1][0]
    assert (shown["state"], shown["summary"]) == (
        "held",
        "held 40.0 mm deep after 69 periods: no sample for 1.00 s",
    )
    trace = in_tmp / "two/trace.mcap"
    trace.write_bytes(trace.read_bytes()[:-2000])
    status, out, err = run(capsys, "view", "two", "--html", "-")
    assert status == 0
    assert err.startswith("flexneedle: two/trace.mcap: ")
    shown, *_, rows = File.of(out).record
    assert shown["summary"].endswith("; the trace is not complete")
    assert shown["periods"] == len(rows["rows"]) > 0
    assert "trace.mcap" not in out


def refusal(capsys, *argv):
    """Return exit status and message of a command that writes nothing."""
    status, out, err = run(capsys, "view", *argv)
    assert (out, err.count("\n")) == ("", 1)
    return status, err.removeprefix("flexneedle: ")


def test_folders_without_a_finished_insertion_and_invalid_places_are_refused(capsys, in_tmp):
    change("two", status="running")
    (in_tmp / "none").mkdir()
    before = names(in_tmp / "two")
    for argv, expected, reason in (
        (("none", "--html"), 2, "none: contains no run"),
        (("plan", "--html"), 2, "plan: contains a plan"),
        (("two", "--html"), 1, "two: no end is recorded"),
        (("one", "--html", "x.html", "--compare", "two"), 1, "two: no end is recorded"),
        (("one", "--html", "missing/x.html"), 1, "x.html cannot be written"),
        (("one", "--compare", "two"), 2, "--compare: needs --html"),
    ):
        status, message = refusal(capsys, *argv)
        assert (status, message[: len(reason)]) == (expected, reason)
    assert names(in_tmp / "two") == before
    assert not (in_tmp / "x.html").exists()


def test_an_insertion_without_a_period_is_refused(capsys, monkeypatch):
    def without_periods(folder):
        insertion, lacking = load_insertion(folder)
        return replace(insertion, periods=()), lacking

    monkeypatch.setattr("flexneedle.lab.page.replay.load_insertion", without_periods)
    assert refusal(capsys, "one", "--html")[1].startswith("one: nothing to replay")
