"""Rows of a study in the page's worker: listed, and computed again as recorded insertions."""

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
from flexneedle.lab.page.worker.study_jobs import ShownRows, list_rows
from flexneedle.lab.study.recompute import recompute
from flexneedle.record.fields import page_values
from page_tasks import Reported, plain, task

pytestmark = pytest.mark.usefixtures("empty_figures")

SIZE = 8


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a study of 8 rows."""
    return small_study.run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def changed(made, tmp_path):
    """A function that changes rows by index, and returns the folder of the changed study."""

    def change(rows):
        folder = shutil.copytree(made, tmp_path / "changed")
        found = {row["index"]: row for row in recorded_rows(made)}
        for index, new in rows.items():
            found[index] |= new
        (folder / "journal.jsonl").write_text("".join(json.dumps(row) + "\n" for row in found.values()))
        return folder

    return change


def recorded_rows(folder):
    return [json.loads(line) for line in (folder / "journal.jsonl").read_text().splitlines()]


def listed(folder, index=None):
    """Return the reported rows of a study."""
    one = task("study", folder=str(folder), row=index)
    list_rows(one)
    (message,) = one.report.of("study")
    return message


def test_rows_are_listed_with_their_settings_the_worst_first(made):
    message = listed(made)
    errors = {row["index"]: row["true_error_mm"] for row in recorded_rows(made)}
    about = (message.name, message.title, message.insertions, message.finished, message.index)
    assert about == ("small", "Mine", SIZE, SIZE, None)
    assert [row.index for row in message.rows] == sorted(errors, key=errors.get, reverse=True)
    assert next(row for row in message.rows if row.index == 6) == StudyRow(
        index=6,
        settings="base, phantom.tracker_bias_mm 0.3",
        controller="open-loop",
        target=(7.0, 0.0, 0.0),
        error_mm=errors[6],
        outcome="done",
        reason="",
        opens=True,
    )


def test_rows_without_an_error_are_last_and_not_opened(changed):
    """A held insertion has an error."""
    refused = {"outcome": "refused", "true_error_mm": None, "reason": "misses " * 100}
    held = {"outcome": "held", "true_error_mm": 99.0, "reason": "no reading"}
    message = listed(changed({2: refused, 5: held}))
    first, last = message.rows[0], message.rows[-1]
    assert (first.index, first.outcome, first.reason, first.opens) == (5, "held", "no reading", True)
    assert (last.index, last.outcome, last.error_mm, last.opens) == (2, "refused", None, False)
    assert len(last.reason) == 300


def test_rows_are_listed_from_an_index_on_up_to_a_limit(made, monkeypatch):
    assert [row.index for row in listed(made, 5).rows] == [5, 6, 7]
    assert listed(made, SIZE).rows == []
    monkeypatch.setattr(study_jobs, "MOST_ROWS", 3)
    assert [row.index for row in listed(made, 2).rows] == [2, 3, 4]
    assert (len(listed(made).rows), listed(made).finished) == (3, SIZE)


def test_a_row_is_reported_as_a_recording_and_saved_as_a_run(made, tmp_path):
    again, one = ShownRows(), task("row", folder=str(made), row=6, of="second")
    again.recompute(one)
    insertion = recompute(made, 6).insertion
    (message,) = one.report.of("insertion")
    assert (message.of, message.name, message.state, message.row) == ("second", "small, row 6", "done", 6)
    assert (message.seed, message.summary) == (insertion.seed, insertion.summary)
    assert plain(one.report.rows) == plain(
        page_values(period, insertion.plan) for period in insertion.periods
    )
    (needles,) = one.report.shapes(FrameKind.NEEDLE, FrameSource.SECOND)
    assert needles.values.shape[0] == message.periods == len(insertion.periods)
    shares = [job.share for job in one.report.of("job")]
    assert len(shares) == message.periods
    assert shares[0] < 0.3 < 0.9 < shares[-1] <= 1.0

    def save(of, folder):
        again.save(task("save_row", "save", folder=str(folder), of=of))

    folder, other = tmp_path / "saved", tmp_path / "other"
    save("second", folder)
    with pytest.raises(InputError, match="no row to save"):
        save("first", other)
    read = task("read", "recording", folder=str(folder), of="second")
    again.read(read)
    assert plain(read.report.rows) == plain(one.report.rows)
    assert read.report.of("insertion")[0].row is None
    with pytest.raises(InputError, match="no row to save"):
        save("second", other)  # a run is shown in its place
    assert not other.exists()


def test_differences_from_the_recorded_row_are_in_the_summary(changed):
    one = task("row", folder=str(changed({6: {"flips": 99}})), row=6)
    ShownRows().recompute(one)
    assert "not the same: flips " in one.report.of("insertion")[0].summary


def test_a_row_is_cancelled_between_two_periods(made):
    def then(message):
        if message.type == "job" and message.state == "running":
            one.control.take(JobChange(job=1, cancel=True))

    one = task("row", folder=str(made), row=0, reported=Reported(then))
    carry_out(one, {"row": ShownRows().recompute})
    assert one.report.of("insertion") == []
    assert [job.state for job in one.report.of("job")] == ["running", "cancelled"]


def test_errors_name_the_study_and_no_path(made, tmp_path):
    with pytest.raises(InputError, match=r"^small: row = 8: "):
        ShownRows().recompute(task("row", folder=str(made), row=SIZE))
    with pytest.raises(InputError, match=r"^small: contains no study"):
        list_rows(task("study", folder=str(tmp_path)))
