"""Recording on a grid: correct rows, at rest, in agreement with the motion of the stage."""

import numpy as np
import pytest

from flexneedle.errors import InputError, RunError
from flexneedle.lab.tables.columns import COLUMNS
from flexneedle.lab.tracker_evaluation.recording.grid import read_grid
from flexneedle.lab.tracker_evaluation.recording.grid_recording import (
    EXTRA,
    StageOperator,
    open_session,
    record_grid,
)
from flexneedle.types import Frame, SensorReading
from recordings import ALL, Stage, assert_complete, rows_of, run


def test_each_point_has_its_samples_with_the_position_of_the_stage(grid, out, tmp_path):
    with pytest.raises(InputError, match=r"table\.parquet: the output is CSV"):
        run(tmp_path / "table.parquet", grid, Stage())
    stage = Stage()
    stage._frame = lambda number: Frame(number / 40, number, {"tip": SensorReading((0.0, 0.0, 0.0))})
    with pytest.raises(InputError, match=r"sensors\.ref1: the tracker has no such sensor; it has tip$"):
        run(out, grid, stage)
    stage = Stage()
    stage.read, stage.status = (lambda: ()), "no reply"
    with pytest.raises(RunError, match="no frames within 2 s: no reply"):
        run(out, grid, stage)
    assert (stage.moves, stage.reports) == ([], ["no frames: no reply"]), "refused before the stage moves"
    stage = Stage()
    assert run(out, grid, stage) == 6
    assert stage.moves == ALL
    assert_complete(out)
    assert tuple(rows_of(out)[0]) == (*COLUMNS, *EXTRA)
    for row in rows_of(out):
        true = np.array([float(row[f"true_{axis}_mm"]) for axis in "xyz"])
        measured = np.array([float(row[f"{axis}_mm"]) for axis in "xyz"])
        np.testing.assert_array_equal(measured - true, (100.0, 0.0, 0.0))
        assert (row["environment"], row["indicator"], row["qw"]) == ("ideal, by the window", "0.02", "1.0")
    first = [float(row["time_s"]) for row in rows_of(out)][::12]
    assert (np.diff([0.0, *first]) >= 3.0).all(), "no sample precedes the arrival of the stage"


def test_sampling_waits_for_a_moving_stage(grid, out):
    """The stage moves at 5 mm/s for the first second; the samples are taken later."""
    stage = Stage()
    wait = stage.wait

    def wait_and_slow_down(seconds):
        wait(seconds)
        stage.speed = 5.0 if stage.time < 4.0 else 0.0

    stage.wait = wait_and_slow_down
    run(out, grid, stage)
    assert_complete(out)
    assert float(rows_of(out)[0]["time_s"]) > 3.9


def test_a_drifting_stage_is_reported_and_the_point_retried(grid, out):
    stage = Stage()
    stage.speed = 5.0

    def report_and_stop(line):
        stage.reports.append(line)
        stage.speed = 0.0

    with open_session(out, grid) as session:
        record_grid(session, stage, stage, grid, StageOperator(stage.move, report_and_stop))
    (report,) = stage.reports
    assert report == (
        "no 6 good samples within 2 s: tip drifts by 0.50 mm from the first to the last third of samples, "
        "limit 0.20 mm; retrying"
    )
    assert stage.moves == [(1, 1), *ALL]
    assert_complete(out)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"tip": SensorReading(None, status="out of volume")}, "tip: out of volume"),
        ({"ref1": SensorReading(None, status="missing")}, "ref1: missing"),
    ],
)
def test_a_failed_point_ends_a_recording_without_retries(grid, out, fault, message):
    stage = Stage()
    stage.fault = fault
    with pytest.raises(RunError, match=f"point 1, repeat 1: no 6 good samples within 2 s: {message}"):
        run(out, grid, stage, retries=False)
    assert not out.exists(), "no file without rows"


def test_a_pause_in_the_frames_and_its_end_are_reported_once(grid, out):
    stage = Stage()
    read = stage.read
    stage.read = lambda: () if 3.1 < stage.time < 4.6 else read()
    stage.status = "unplugged"
    run(out, grid, stage)
    assert stage.reports == ["no frames: unplugged", "frames resumed"]
    assert_complete(out)


def test_a_sensor_missing_for_a_while_is_reported_once(grid, out):
    """For 1.5 s at the first point; half a second at the second point is not reported."""
    stage = Stage()
    frame, lost = stage._frame, {"tip": SensorReading(None, status="missing")}

    def blink(number):
        measured = frame(number)
        is_lost = 3.1 < measured.time < 4.6 or 7.5 < measured.time < 8.3
        return Frame(measured.time, number, measured.readings | lost) if is_lost else measured

    stage._frame = blink
    run(out, grid, stage)
    assert stage.reports == ["waiting: tip: missing"]
    assert_complete(out)


class PartlyStuck(Stage):
    """The tip moves by a share of the stage's motion, the reference by all of it."""

    def __init__(self, share=0.0):
        super().__init__()
        self.share = share

    def _frame(self, number):
        frame = super()._frame(number)
        x, y, z = frame.readings["ref1"].position
        return Frame(
            frame.time, number, {**frame.readings, "tip": SensorReading((self.share * x, self.share * y, z))}
        )


@pytest.mark.parametrize("retries", [True, False])
def test_a_sensor_that_stays_while_the_stage_moves_ends_the_recording_unless_accepted(grid, out, retries):
    stage, mismatches = PartlyStuck(), []
    run(out.with_name("kept.csv"), grid, stage, accepts=lambda mismatch: not mismatches.append(mismatch))
    assert_complete(out.with_name("kept.csv"))
    assert (len(mismatches), stage.moves) == (5, ALL)
    with pytest.raises(RunError) as refusal:
        run(out, grid, PartlyStuck(), retries=retries)
    assert str(refusal.value) == (
        "tip moved 0.0 mm from point 1 to point 2, the stage 10.0 mm: the difference must be at most 5.0 mm "
        "(use --force to record the point anyway)"
    )
    assert_complete(out, stops=ALL[:1])


@pytest.mark.parametrize(
    ("share", "spacing", "agrees"),
    [
        *((0.52, 10, True), (0.48, 10, False), (1.48, 10, True)),
        *((0.81, 100, True), (0.79, 100, False), (1.19, 100, True), (1.21, 100, False)),
    ],
)
def test_motions_may_differ_by_5_mm_or_20_percent(tmp_path, out, share, spacing, agrees):
    text = f'environment = "x"\nsamples = 4\nrepeats = 1\npoints_mm = [[0, 0, 0], [{spacing}, 0, 0]]\n'
    (tmp_path / "two.toml").write_text(text)
    grid = read_grid(str(tmp_path / "two.toml"))
    if agrees:
        assert run(out, grid, PartlyStuck(share)) == 2
    else:
        with pytest.raises(RunError, match="the difference must be at most"):
            run(out, grid, PartlyStuck(share))


def test_a_rejected_mismatch_measures_the_point_again(grid, out):
    """The stage is moved to the second point only after the second report of a mismatch."""
    stage, mismatches = Stage(), []

    def forget_the_second(stop):
        position = stage.position
        stage.move(stop)
        stage.position = position if len(stage.moves) == 2 else stage.position

    def correct(mismatch):
        mismatches.append(mismatch)
        if len(mismatches) > 1:
            raise KeyboardInterrupt
        stage.position = np.array([10.0, 0.0, 0.0])
        return False

    with open_session(out, grid) as session:
        record_grid(session, stage, stage, grid, StageOperator(forget_the_second, print, accepts=correct))
    assert stage.moves == ALL
    assert_complete(out)
    assert {row["x_mm"] for row in rows_of(out) if row["point_id"] == "2"} == {"110.0"}


def test_motion_is_checked_across_an_interruption(grid, out):
    stage = Stage()

    def move_once(stop):
        if stage.moves:
            raise KeyboardInterrupt
        stage.move(stop)

    with open_session(out, grid) as session, pytest.raises(KeyboardInterrupt):
        record_grid(session, stage, stage, grid, StageOperator(move_once, print))
    again = Stage()
    again.move = lambda _: None  # the stage does not move
    with pytest.raises(RunError, match=r"tip moved 0\.0 mm from point 1 to point 2, the stage 10\.0 mm"):
        run(out, grid, again)
