"""`flexneedle emulate`, `em record` and `em watch` at the shell."""

import io
import json
import signal

import pytest

from emulated import emulated
from flexneedle.cli import main as cli

GRID = """\
environment = "ideal"
samples = 4
repeats = 1
points_mm = [[0, 0, 0], [1, 0, 0]]
[rest]
drift_mm = 10.0
"""


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(argv)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_the_emulator_has_the_path_that_was_asked_for_until_it_ends(tmp_path, end):
    link = tmp_path / "tracker"
    with emulated("--link", str(link), end=end) as path:
        assert path == str(link)
        assert link.is_char_device()
    assert not link.is_symlink()


def test_the_emulator_replaces_no_file(capsys, tmp_path):
    (tmp_path / "mine").write_text("mine")
    status, _, err = run(capsys, "emulate", "aurora", "--link", str(tmp_path / "mine"))
    assert (status, (tmp_path / "mine").read_text()) == (2, "mine")
    assert "is there already and is no link" in err


def test_a_fault_that_makes_no_sense_is_bad_input(capsys):
    status, _, err = run(capsys, "emulate", "aurora", "--fault", "mising@1")
    assert status == 2
    assert err.startswith("flexneedle: --fault mising@1: unknown kind; kinds: missing, ")


def test_a_recording_asks_at_each_point_and_says_where_it_wrote(capsys, tmp_path, monkeypatch):
    (tmp_path / "grid.toml").write_text(GRID)
    out = str(tmp_path / "table.csv")
    with emulated("--sensors", "1") as path:
        arguments = ("--tracker", f"aurora:{path}", "--grid", str(tmp_path / "grid.toml"), "--out", out)
        monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
        status, _, err = run(capsys, "em", "record", *arguments)
        assert status == 1
        assert "point 1 of 2, repeat 1 of 1: stage at 0, 0, 0 mm? Enter: " in err
        assert "no more input on stdin" in err
        status, printed, err = run(capsys, "em", "record", *arguments, "--dwell", "0")
    assert (status, printed) == (0, f"{out}\n")
    assert "goes on after 1 recorded points" in err
    assert "point 2 of 2" in err


def test_a_tracker_that_is_not_there_is_bad_input(capsys, tmp_path):
    status, out, err = run(capsys, "em", "watch", "--tracker", f"aurora:{tmp_path}/nothing")
    assert (status, out) == (2, "")
    assert "no such port; serial ports found: " in err


def test_a_watch_prints_json_lines_and_keeps_what_it_saw(capsys, tmp_path):
    kept = tmp_path / "kept.csv"
    with emulated("--fault", "missing@0") as path:
        status, out, _ = run(
            capsys,
            "em",
            "watch",
            "--tracker",
            f"aurora:{path}",
            "--json",
            "--seconds",
            "1",
            "--record",
            str(kept),
        )
    lines = [json.loads(line) for line in out.splitlines()]
    assert status == 0
    assert lines[-1]["verdict"] == "tip: missing"
    assert lines[-1]["sensors"]["tip"] == {
        "position_mm": None,
        "quaternion": None,
        "indicator": None,
        "status": "missing",
    }
    assert len(lines[-1]["sensors"]["ref1"]["position_mm"]) == 3
    status, out, _ = run(capsys, "em", "watch", "--tracker", f"replay:{kept}@10")
    assert status == 0
    assert "tip missing  ref1 " in out
    assert "verdict: tip: missing" in out
