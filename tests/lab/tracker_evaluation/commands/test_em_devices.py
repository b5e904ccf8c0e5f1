"""`flexneedle emulate`, `em record` and `em watch` at the shell."""

import io
import json
import signal

import pytest

from emulated import emulated
from flexneedle.cli import main as cli
from flexneedle.errors import InputError
from flexneedle.lab.emulators.server import SerialPort

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
def test_the_emulator_provides_the_requested_path_until_it_ends(tmp_path, end):
    link = tmp_path / "tracker"
    with emulated("--link", str(link), end=end) as path:
        assert path == str(link)
        assert link.is_char_device()
    assert not link.is_symlink()


def test_the_emulator_replaces_no_file(capsys, tmp_path):
    (tmp_path / "mine").write_text("mine")
    status, _, err = run(capsys, "emulate", "aurora", "--link", str(tmp_path / "mine"))
    assert (status, (tmp_path / "mine").read_text()) == (2, "mine")
    assert "already exists: choose another path, or remove it" in err


def test_the_emulator_replaces_only_the_link_of_a_killed_emulator(tmp_path):
    target, link = tmp_path / "kept.txt", tmp_path / "dev"
    target.write_text("mine")
    link.symlink_to(target)
    with pytest.raises(InputError, match="already exists"):
        SerialPort(link)
    assert link.readlink() == target
    link.unlink()
    link.symlink_to("/dev/pts/999999")
    with SerialPort(link) as serial:
        with pytest.raises(InputError, match="already exists"):
            SerialPort(link)
        assert serial.link.exists()
    assert not link.is_symlink()


def test_an_emulator_that_ends_leaves_the_link_of_another(tmp_path):
    link = tmp_path / "dev"
    with SerialPort(link):
        link.unlink()
        link.symlink_to("/dev/null")
    assert link.readlink().name == "null"


def test_an_unknown_fault_is_bad_input(capsys):
    status, _, err = run(capsys, "emulate", "aurora", "--fault", "mising@1")
    assert status == 2
    assert err.startswith("flexneedle: --fault mising@1: unknown kind; kinds: missing, ")


def test_a_recording_prompts_at_each_point_and_prints_its_file(capsys, tmp_path, monkeypatch):
    (tmp_path / "grid.toml").write_text(GRID)
    out = str(tmp_path / "table.csv")
    with emulated("--sensors", "1", "--still") as path:
        arguments = ("--tracker", f"aurora:{path}", "--grid", str(tmp_path / "grid.toml"), "--out", out)
        monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
        status, _, err = run(capsys, "em", "record", *arguments)
        assert status == 1
        assert "point 1 of 2, repeat 1 of 1: press Enter with the stage at 0, 0, 0 mm:\n" in err
        assert "\nflexneedle: end of input on stdin" in err, "on a separate line"
        status, printed, err = run(capsys, "em", "record", *arguments, "--dwell", "0")
    assert (status, printed) == (0, f"{out}\n")
    assert "resuming after 1 recorded points" in err
    assert "point 2 of 2" in err
    status, printed, err = run(capsys, "em", "record", *arguments)
    assert (status, printed, err) == (0, f"{out}\n", f"{out}: complete, 2 points\n")


def test_a_missing_tracker_is_bad_input(capsys, tmp_path):
    status, out, err = run(capsys, "em", "watch", "--tracker", f"aurora:{tmp_path}/nothing")
    assert (status, out) == (2, "")
    assert "no such port; serial ports found: " in err


def test_without_a_tracker_no_file_is_created_or_changed(capsys, tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    out = tmp_path / "table.csv"
    arguments = ("em", "record", "--grid", str(tmp_path / "grid.toml"), "--out", str(out), "--dwell", "0")
    nowhere = ("--tracker", f"aurora:{tmp_path}/nothing")
    status, printed, err = run(capsys, *arguments, *nowhere)
    assert (status, printed) == (2, "")
    assert "no such port" in err
    assert not out.exists()
    with emulated("--sensors", "1", "--still") as path:
        assert run(capsys, *arguments, "--tracker", f"aurora:{path}")[0] == 0
    lines = out.read_text().splitlines(keepends=True)
    begun = "".join(lines[:7]) + lines[7][:9]  # one stop and a truncated part of the next
    out.write_text(begun)
    assert run(capsys, *arguments, *nowhere)[0] == 2
    assert out.read_text() == begun


def test_a_watch_prints_json_lines_and_saves_the_frames(capsys, tmp_path):
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
    assert "tip missing  ref1 I 0.0" in out
    assert max(map(len, out.splitlines())) < 120
    assert "verdict: tip: missing" in out


class Terminal(io.StringIO):
    """Standard input of a terminal."""

    def isatty(self):
        return True


MOVING = GRID.replace("[1, 0, 0]", "[50, 0, 0]")


def record_moving(capsys, tmp_path, monkeypatch, typed, *more):
    """Record a tip that rests while the stage moves by 50 mm."""
    (tmp_path / "grid.toml").write_text(MOVING)
    monkeypatch.setattr("sys.stdin", typed)
    with emulated("--sensors", "1", "--still") as path:
        out = tmp_path / "table.csv"
        arguments = ("--tracker", f"aurora:{path}", "--grid", str(tmp_path / "grid.toml"), "--out", str(out))
        status, _, err = run(capsys, "em", "record", *arguments, *more)
    return status, err, out.read_text().count("\n") - 1 if out.exists() else 0


def test_at_a_terminal_a_mismatch_must_be_confirmed(capsys, tmp_path, monkeypatch):
    status, err, rows = record_moving(capsys, tmp_path, monkeypatch, Terminal("\n\n\nk\n"))
    assert (status, rows) == (0, 8)
    assert err.count("the stage 50.0 mm: the difference must be at most 10.0 mm\n") == 2
    assert err.count("press Enter to measure this point again, k to keep it: ") == 2


def test_without_a_terminal_a_mismatch_is_refused_unless_forced(capsys, tmp_path, monkeypatch):
    status, err, rows = record_moving(capsys, tmp_path, monkeypatch, io.StringIO("\n" * 9))
    assert (status, rows) == (1, 4)
    assert (
        "the stage 50.0 mm: the difference must be at most 10.0 mm (use --force to record the point anyway)\n"
        in err
    )
    status, err, rows = record_moving(capsys, tmp_path, monkeypatch, io.StringIO(), "--dwell", "0", "--force")
    assert (status, rows) == (0, 8)
    assert "recorded (--force)" in err


def test_an_end_of_input_at_a_terminal_ends_the_line_of_the_prompt(capsys, tmp_path, monkeypatch):
    status, err, _ = record_moving(capsys, tmp_path, monkeypatch, Terminal())
    assert status == 1
    assert " mm: \nflexneedle: end of input on stdin" in err


@pytest.mark.parametrize(
    ("option", "value"), [("--dwell", "-1"), ("--dwell", "inf"), ("--seconds", "-1"), ("--seconds", "nan")]
)
def test_invalid_times_are_refused(capsys, option, value):
    command = ("record", "--grid", "cube", "--out", "x.csv") if option == "--dwell" else ("watch",)
    with pytest.raises(SystemExit) as refusal:
        run(capsys, "em", *command, "--tracker", "aurora:x", option, value)
    assert refusal.value.code == 2
    assert f"argument {option}: {value}: must be " in capsys.readouterr().err


def test_a_missing_recording_is_named_once(capsys):
    status, out, err = run(capsys, "em", "watch", "--tracker", "replay:nothere.csv")
    assert (status, out) == (2, "")
    assert err == "flexneedle: nothere.csv: cannot be read: No such file or directory\n"


def test_a_short_replay_shows_the_first_frame_each_change_of_the_verdict_and_the_last(capsys, tmp_path):
    rows = [
        f"{n / 40},{n},{name},{status},{position},0.02"
        for n in range(60)
        for name, status, position in (
            ("tip", *(("missing", ",,") if 25 <= n < 30 else ("ok", "1,2,3"))),
            ("ref1", "ok", "4,5,6"),
        )
    ]
    path = tmp_path / "short.csv"
    path.write_text("\n".join(["time_s,frame_number,sensor,status,x_mm,y_mm,z_mm,indicator", *rows, ""]))
    status, out, _ = run(capsys, "em", "watch", "--tracker", f"replay:{path}")
    lines = out.splitlines()
    assert status == 0
    assert [line.split("frame ")[1].split()[0] for line in lines] == ["0", "20", "25", "30", "59"]
    assert lines[0].endswith("verdict: field not known: observed for 0.00 s, 0.5 s needed")
    assert lines[1].endswith("frame 20  tip 1.00 2.00 3.00 mm I 0.0200  ref1 I 0.0200  verdict: ok")
    assert "tip missing" in lines[2]
    status, out, _ = run(capsys, "em", "watch", "--tracker", f"replay:{path}@9", "--references", "3")
    assert "field not known: 1 of 3" in out
