"""`flexneedle view --row`: a row of a study as a run, its figures and its replay."""

import json
import math
import shutil
from pathlib import Path

import pytest

import small_study
from commands import names, run
from flexneedle.lab.commands import view
from flexneedle.record.loading import load_insertion
from replays import File


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return small_study.run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def study(made, in_tmp, drawing, monkeypatch):  # noqa: ARG001
    """A small study in the folder `mine`; all rows are too quick for a progress display."""
    monkeypatch.setattr(view, "_SHORT_S", math.inf)
    return shutil.copytree(made, in_tmp / "mine")


def errors(study):
    lines = (study / "journal.jsonl").read_text().splitlines()
    return {row["index"]: row["true_error_mm"] for row in map(json.loads, lines)}


def test_a_row_becomes_a_run_in_the_folder_of_the_study(capsys, study):
    figures = "mine/rows/row-000001/insertion.png\nmine/rows/row-000001/insertion.svg\n"
    assert run(capsys, "view", "mine", "--row", "1") == (0, figures, "")
    assert names(study / "rows/row-000001") == ["insertion.png", "insertion.svg", "run.json", "trace.mcap"]
    insertion, lacking = load_insertion(Path("mine/rows/row-000001"))
    assert (lacking, insertion.seed) == ("", 1)
    assert insertion.true_error_mm == pytest.approx(errors(study)[1], abs=1e-9)
    assert run(capsys, "view", "mine/rows/row-000001") == (0, figures, "")
    assert run(capsys, "export", "mine/rows/row-000001", "--csv")[0] == 0


@pytest.mark.usefixtures("study")
def test_a_row_that_was_computed_before_is_drawn_again(capsys, monkeypatch):
    _, figures, _ = run(capsys, "view", "mine", "--row", "1")
    monkeypatch.setattr(view, "_recompute_row", None)
    note = "flexneedle: mine/rows/row-000001: computed before: remove it to compute the row again\n"
    assert run(capsys, "view", "mine", "--row", "1") == (0, figures, note)


@pytest.mark.usefixtures("study")
def test_a_row_is_kept_where_it_is_asked_for(capsys, in_tmp):
    status, out, err = run(capsys, "view", "mine", "--row", "0", "--out", "one/row")
    assert (status, out, err) == (0, "one/row/insertion.png\none/row/insertion.svg\n", "")
    assert not (in_tmp / "mine/rows").exists()
    message = "flexneedle: one/row: already contains a run (run.json): choose another folder\n"
    assert run(capsys, "view", "mine", "--row", "0", "--out", "one/row") == (2, "", message)


@pytest.mark.usefixtures("study")
def test_two_rows_are_replayed_beside_each_other(capsys):
    assert run(capsys, "view", "mine", "--row", "0", "--html") == (
        0,
        "mine/rows/row-000000/replay.html\n",
        "",
    )
    beside = ("--html", "-", "--compare", "mine/rows/row-000000")
    status, out, err = run(capsys, "view", "mine", "--row", "1", *beside)
    assert (status, err) == (0, "")
    news = [each for each in File.of(out).record if isinstance(each, dict) and each["type"] == "insertion"]
    shown = [(each["of"], each["name"], each["seed"]) for each in news]
    assert shown == [("first", "row-000001", 1), ("second", "row-000000", 0)]


def test_progress_of_a_longer_insertion_and_a_difference_from_the_record_are_shown(
    capsys, study, monkeypatch
):
    monkeypatch.setattr(view, "_SHORT_S", -1.0)
    stored = json.loads((study / "study.json").read_text())
    stored["versions"]["source"] = "0"
    (study / "study.json").write_text(json.dumps(stored))
    _, _, err = run(capsys, "view", "mine", "--row", "0")
    assert "Inserting …\n" in err
    assert ": row 0\n" in err
    assert err.endswith("flexneedle: recomputed with other code than the study's: the same result\n")


@pytest.mark.usefixtures("study")
@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["mine"], "mine: is a study: choose a row with --row INDEX"),
        (["mine", "--row", "8"], "mine: row = 8: must be from 0 to 7"),
        (["none", "--row", "0"], "none: contains no study: study.json is missing"),
        (["mine", "--out", "x"], "--out: needs --row"),
        (["mine", "--row", "0", "--compare", "x"], "--compare: needs --html"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(capsys, in_tmp, argv, line):
    before = names(in_tmp / "mine")
    assert run(capsys, "view", *argv) == (2, "", f"flexneedle: {line}\n")
    assert names(in_tmp / "mine") == before
    assert names(in_tmp) == ["mine"]
