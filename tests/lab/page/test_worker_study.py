"""Rows of a study in the page's worker: listed, and computed again as a recording."""

import json
import shutil

import pytest

import small_study
from flexneedle.errors import InputError
from flexneedle.lab.page.job_orders import JobChange
from flexneedle.lab.page.protocol import StudyRow
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource
from flexneedle.lab.page.worker import study_jobs
from flexneedle.lab.page.worker.__main__ import carry_out
from flexneedle.lab.page.worker.recordings import describe_recording
from flexneedle.lab.page.worker.study_jobs import ShownRows, list_rows
from flexneedle.lab.study.recompute import recompute
from page_tasks import Reported, task

SIZE = 8


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a study of 8 rows."""
    return small_study.run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def changed(made, tmp_path):
    """A function that changes rows by index, and returns the folder of the changed study."""

    def change(**values):
        folder = shutil.copytree(made, tmp_path / "changed")
        found = {row["index"]: row for row in recorded_rows(made)}
        for name, new in values.items():
            found[int(name.removeprefix("row_"))] |= new
        (folder / "journal.jsonl").write_text("".join(json.dumps(row) + "\n" for row in found.values()))
        return folder

    return change


def recorded_rows(folder):
    return [json.loads(line) for line in (folder / "journal.jsonl").read_text().splitlines()]


def listed(folder, index=None):
    """What is reported of the rows of a study."""
    one = task("study", folder=str(folder), row=index)
    list_rows(one)
    (news,) = one.report.of("study")
    return news


def test_rows_are_listed_the_worst_first(made):
    news = listed(made)
    errors = {row["index"]: row["true_error_mm"] for row in recorded_rows(made)}
    assert (news.name, news.title, news.insertions, news.finished, news.index) == (
        "small",
        "Mine",
        8,
        8,
        None,
    )
    assert [row.index for row in news.rows] == sorted(errors, key=errors.get, reverse=True)
    assert [row.error_mm for row in news.rows] == sorted(errors.values(), reverse=True)


def test_a_row_has_its_settings(made):
    found = {row.index: row for row in listed(made).rows}
    assert found[6] == StudyRow(
        index=6,
        settings="base, phantom.tracker_bias_mm 0.3",
        controller="adaptive-mpc",
        target=(7.0, 0.0, 0.0),
        error_mm=found[6].error_mm,
        outcome="done",
        reason="",
        opens=True,
    )


def test_rows_without_an_error_come_last_and_are_not_opened(changed):
    """An insertion that was held has one."""
    refused = {"outcome": "refused", "true_error_mm": None, "reason": "misses " * 100}
    held = {"outcome": "held", "true_error_mm": 99.0, "reason": "no reading"}
    news = listed(changed(row_2=refused, row_5=held))
    first, last = news.rows[0], news.rows[-1]
    assert (first.index, first.outcome, first.reason, first.opens) == (5, "held", "no reading", True)
    assert (last.index, last.outcome, last.error_mm, last.opens) == (2, "refused", None, False)
    assert len(last.reason) == 300


def test_rows_are_listed_from_an_index_on(made):
    assert [row.index for row in listed(made, 5).rows] == [5, 6, 7]
    assert listed(made, SIZE).rows == []
    assert listed(made, 0).finished == SIZE


def test_no_more_rows_than_the_limit_are_sent(made, monkeypatch):
    monkeypatch.setattr(study_jobs, "MOST_ROWS", 3)
    assert [row.index for row in listed(made, 2).rows] == [2, 3, 4]
    assert len(listed(made).rows) == 3
    assert listed(made).finished == SIZE


def test_a_row_is_reported_as_a_recording(made):
    one = task("row", folder=str(made), row=6, of="second")
    ShownRows().recompute(one)
    insertion = recompute(made, 6).insertion
    (news,) = one.report.of("insertion")
    assert (news.of, news.name, news.state) == ("second", "small, row 6", "done")
    assert (news.seed, news.periods, news.summary) == (
        insertion.seed,
        len(insertion.periods),
        insertion.summary,
    )
    *_, expected = describe_recording(insertion, "", "second", "")
    untimed = {"decide_ms"}
    assert [each.model_dump(exclude=untimed) for each in one.report.rows] == [
        each.model_dump(exclude=untimed) for each in expected.rows
    ]
    (needles,) = one.report.shapes(FrameKind.NEEDLE, FrameSource.SECOND)
    assert needles.values.shape[0] == news.periods
    shares = [job.share for job in one.report.of("job")]
    assert len(shares) == news.periods
    assert shares[0] < 0.3 < 0.9 < shares[-1] <= 1.0
    assert one.report.of("job")[0].text == "small, row 6"
    assert news.row == 6


def test_a_row_that_is_shown_is_saved_as_a_run(made, tmp_path):
    again, folder, untimed = ShownRows(), tmp_path / "saved", {"decide_ms"}
    one = task("row", folder=str(made), row=6, of="second")
    again.recompute(one)
    again.save(task("save_row", "save", folder=str(folder), of="second"))
    with pytest.raises(InputError, match="no row to save"):
        again.save(task("save_row", "save", folder=str(tmp_path / "other"), of="first"))
    other = task("read", "recording", folder=str(folder), of="second")
    again.read(other)
    texts = ([row.model_dump_json(exclude=untimed) for row in each.report.rows] for each in (one, other))
    assert next(texts) == next(texts)
    assert other.report.of("insertion")[0].row is None
    with pytest.raises(InputError, match="no row to save"):
        again.save(task("save_row", "save", folder=str(tmp_path / "other"), of="second"))
    assert not (tmp_path / "other").exists()


def test_what_differs_from_the_recorded_row_is_in_the_summary(changed):
    one = task("row", folder=str(changed(row_6={"flips": 99})), row=6)
    ShownRows().recompute(one)
    (news,) = one.report.of("insertion")
    assert "; recomputed with the study's code, and not the same: flips " in news.summary


def test_a_row_is_cancelled_between_two_periods(made):
    def then(news):
        if news.type == "job" and news.state == "running":
            one.control.take(JobChange(job=1, cancel=True))

    one = task("row", folder=str(made), row=0, reported=Reported(then))
    carry_out(one, {"row": ShownRows().recompute})
    assert one.report.of("insertion") == []
    assert [job.state for job in one.report.of("job")] == ["running", "cancelled"]


def test_errors_name_the_study_and_no_path(made, tmp_path):
    with pytest.raises(InputError, match=r"^small: row = 8: must be from 0 to 7$"):
        ShownRows().recompute(task("row", folder=str(made), row=SIZE))
    with pytest.raises(InputError, match=r"^small: contains no study: study\.json is missing$"):
        list_rows(task("study", folder=str(tmp_path)))
