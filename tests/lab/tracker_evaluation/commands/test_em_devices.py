"""`flexneedle emulate`, `em record` and `em watch` at the shell."""

import io
import json
import signal

import pytest

from emulated import emulated
from flexneedle.cli import main as cli
from flexneedle.errors import InputError
from flexneedle.lab.emulators.aurora_server import SerialPort

GRID = """\
environment = "ideal"
samples = 4
repeats = 1
points_mm = [[0, 0, 0], [1, 0, 0]]
[rest]
drift_mm = 10.0
"""
LIMIT = "the stage 50.0 mm: the difference must be at most 10.0 mm"


@pytest.fixture(scope="module")
def still():
    """The path of an emulated tracker with a sensor at rest."""
    with emulated("--sensors", "1", "--still") as path:
        yield path


@pytest.fixture
def grid(tmp_path):
    """The file of a grid of two points, 1 mm apart."""
    (tmp_path / "grid.toml").write_text(GRID)
    return tmp_path / "grid.toml"


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(list(map(str, argv)))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_the_emulator_provides_the_requested_path_until_it_ends(tmp_path):
    link = tmp_path / "tracker"
    with emulated("--link", str(link), end=signal.SIGTERM) as path:
        assert path == str(link)
        assert link.is_char_device()
    assert not link.is_symlink()


def test_the_emulator_replaces_only_the_link_of_a_killed_emulator(capsys, tmp_path):
    target, link = tmp_path / "kept.txt", tmp_path / "dev"
    target.write_text("mine")
    assert run(capsys, "emulate", "aurora", "--link", target)[0] == 2
    link.symlink_to(target)
    with pytest.raises(InputError, match="already exists"):
        SerialPort(link)
    assert (link.readlink(), target.read_text()) == (target, "mine")
    link.unlink()
    link.symlink_to("/dev/pts/999999")
    with SerialPort(link) as serial:
        with pytest.raises(InputError, match="already exists"):
            SerialPort(link)
        assert serial.link.exists()
    assert not link.is_symlink()
    with SerialPort(link):
        link.unlink()
        link.symlink_to("/dev/null")
    assert link.readlink().name == "null", "the link of another emulator"


def test_a_recording_prompts_at_each_point_and_prints_its_file(capsys, tmp_path, monkeypatch, grid, still):
    out = tmp_path / "table.csv"
    nowhere = ("em", "record", "--grid", grid, "--out", out, "--tracker", f"aurora:{tmp_path}/nothing")
    status, printed, err = run(capsys, *nowhere, "--dwell", "0")
    assert (status, printed) == (2, "")
    assert "no such port; serial ports found: " in err
    assert not out.exists()
    record = (*nowhere[:-1], f"aurora:{still}")
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    status, _, err = run(capsys, *record)
    assert status == 1
    assert "point 1 of 2, repeat 1 of 1: press Enter with the stage at 0, 0, 0 mm:\n" in err
    assert "\nflexneedle: end of input on stdin" in err, "on a separate line"
    before = out.read_bytes()
    assert run(capsys, *nowhere)[0] == 2
    assert out.read_bytes() == before
    status, printed, err = run(capsys, *record, "--dwell", "0")
    assert (status, printed) == (0, f"{out}\n")
    assert "resuming after 1 recorded points" in err
    assert "point 2 of 2" in err
    assert run(capsys, *record) == (0, f"{out}\n", f"{out}: complete, 2 points\n")


def test_a_watch_prints_json_lines_and_saves_the_frames(capsys, tmp_path):
    kept = tmp_path / "kept.csv"
    with emulated("--fault", "missing@0") as path:
        watch = ("em", "watch", "--tracker", f"aurora:{path}", "--json", "--seconds", "1", "--record", kept)
        status, out, _ = run(capsys, *watch)
    lines = [json.loads(line) for line in out.splitlines()]
    assert status == 0
    last = [line for line in lines if line["verdict"] == "tip: missing"][-1]  # replies may be late
    nothing = dict.fromkeys(("position_mm", "quaternion", "indicator"))
    assert last["sensors"]["tip"] == nothing | {"status": "missing"}
    assert len(last["sensors"]["ref1"]["position_mm"]) == 3
    status, out, _ = run(capsys, "em", "watch", "--tracker", f"replay:{kept}")
    assert status == 0
    assert "tip missing  ref1 I 0.0" in out
    assert max(map(len, out.splitlines())) < 120
    assert "verdict: tip: missing" in out


class Terminal(io.StringIO):
    """Standard input of a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stdin", "options", "status", "rows", "words"),
    [
        (Terminal("\n\n\nk\n"), (), 0, 8, [LIMIT, "press Enter to measure this point again, k to keep it: "]),
        (Terminal(), (), 1, 0, [" mm: \nflexneedle: end of input on stdin"]),
        (io.StringIO("\n" * 9), (), 1, 4, [f"{LIMIT} (use --force to record the point anyway)"]),
        (io.StringIO(), ("--dwell", "0", "--force"), 0, 8, ["recorded (--force)"]),
    ],
    ids=["kept", "end of input", "no terminal", "forced"],
)
def test_a_tip_that_rests_while_the_stage_moves_must_be_confirmed(
    capsys, tmp_path, monkeypatch, grid, still, stdin, options, status, rows, words
):
    """At a terminal a mismatch must be confirmed; without one it is refused unless forced."""
    grid.write_text(GRID.replace("[1, 0, 0]", "[50, 0, 0]"))
    monkeypatch.setattr("sys.stdin", stdin)
    out = tmp_path / "table.csv"
    found, _, err = run(
        capsys, "em", "record", "--tracker", f"aurora:{still}", "--grid", grid, "--out", out, *options
    )
    assert found == status
    assert (out.read_text().count("\n") - 1 if out.exists() else 0) == rows
    assert all(word in err for word in words)


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
    status, out, _ = run(capsys, "em", "watch", "--tracker", f"replay:{path}", "--references", "3")
    assert "field not known: 1 of 3" in out
