"""The table of a recording in spite of interruptions: each point once, other files unchanged."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from emulated import DEADLINE_S, emulated, until
from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.recording import grid_recording as recording
from flexneedle.lab.tracker_evaluation.recording.grid import read_grid
from flexneedle.lab.tracker_evaluation.recording.grid_recording import open_session
from recordings import ALL, GRID, Stage, assert_complete, rows_of, run


@pytest.mark.parametrize("stopped_after", [0, 1, 5, 6])
def test_an_interrupted_recording_resumes_at_the_next_point(grid, out, stopped_after):
    stage = Stage()
    move = stage.move

    def move_until(stop):
        if len(stage.moves) == stopped_after:
            raise KeyboardInterrupt
        move(stop)

    stage.move = move_until
    if stopped_after < 6:
        with pytest.raises(KeyboardInterrupt):
            run(out, grid, stage)
    else:
        run(out, grid, stage)
    again = Stage()
    run(out, grid, again)
    assert stage.moves + again.moves == ALL
    assert_complete(out)
    assert (np.diff([float(row["time_s"]) for row in rows_of(out)]) >= 0).all(), "times continue"


@pytest.mark.parametrize("cut", [1, 20, 400, 4000])
def test_a_table_truncated_anywhere_is_completed(grid, out, cut):
    run(out, grid, Stage())
    whole = out.stat().st_size
    os.truncate(out, max(0, whole - cut) if cut > 1 else 1)
    run(out, grid, Stage())
    assert_complete(out)


def test_a_table_is_unchanged_until_rows_are_added(grid, out):
    """Opening a table with a truncated stop, or an empty file, without measuring changes nothing."""
    run(out, grid, Stage())
    os.truncate(out, out.stat().st_size - 1000)
    torn = out.read_bytes()
    with open_session(out, grid) as session:
        assert session.done == 5
        with pytest.raises(InputError, match="another process is writing this file"):
            run(out, grid, Stage())
    assert out.read_bytes() == torn
    run(out, grid, Stage())
    assert_complete(out)
    whole = out.read_bytes()
    out.write_bytes(whole + b"1,2,")  # cut short by a crash
    assert run(out, grid, Stage()) == 0
    assert out.read_bytes() == whole
    out.write_bytes(b"")
    with open_session(out, grid):
        pass
    assert out.read_bytes() == b"", "the file existed before"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("environment = ", "# environment = \nenvironment = 'noisy' #"),
        ("[10, 0, 0]", "[11, 0, 0]"),
        ("samples = 6", "samples = 5"),
        ("samples = 6", "samples = 60"),  # one stop has more rows than the table
        ("repeats = 2", "repeats = 1"),
        ('ref1 = "reference"', 'ref1 = "other"'),
    ],
)
def test_a_table_of_another_grid_is_refused_and_unchanged(grid, out, tmp_path, old, new):
    run(out, grid, Stage())
    before = out.read_bytes()
    (tmp_path / "other.toml").write_text(GRID.replace(old, new))
    with pytest.raises(InputError, match=r"line \d+: does not match the grid"):
        run(out, read_grid(str(tmp_path / "other.toml")), Stage())
    assert out.read_bytes() == before


def test_a_damaged_line_and_another_file_are_refused(grid, out):
    run(out, grid, Stage())
    lines = out.read_text().splitlines(keepends=True)
    lines[3] = lines[3].replace("1", "x", 1)
    for text, message in (
        ("".join(lines), "line 4: does not match"),
        ("my notes\n", "is not a table of `em record`"),
    ):
        out.write_text(text)
        with pytest.raises(InputError, match=message):
            run(out, grid, Stage())
        assert out.read_text() == text


def test_each_point_is_synced_to_disk_before_the_next_move(grid, out, monkeypatch):
    synced = []
    monkeypatch.setattr(recording.os, "fsync", lambda _: synced.append(len(rows_of(out))))
    run(out, grid, Stage())
    assert synced == [12, 24, 36, 48, 60, 72]


@pytest.mark.long
def test_a_killed_recording_loses_and_repeats_no_point(tmp_path, out):
    """With real processes, a serial line and SIGKILL."""
    count = 16
    points = [[n, 0, 0] for n in range(count)]
    text = f'environment = "ideal"\nsamples = 4\nrepeats = 1\npoints_mm = {points}\n'
    (tmp_path / "line.toml").write_text(text)
    with emulated("--still") as path:
        command = [sys.executable, "-m", "flexneedle", "em", "record", "--tracker", f"aurora:{path}"]
        command += ["--grid", str(tmp_path / "line.toml"), "--out", str(out), "--dwell", "0"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        until(lambda: out.exists() and out.read_bytes().count(b"\n") > 20)
        process.send_signal(signal.SIGKILL)
        process.wait(DEADLINE_S)
        subprocess.run(command, check=True, capture_output=True)
    assert_complete(out, 4, [(1, n + 1) for n in range(count)], ("tip",))
