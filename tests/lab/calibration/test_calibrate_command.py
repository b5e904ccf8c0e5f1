"""`flexneedle calibrate`: output, files, exit status, refusals."""

import argparse
import json

import pytest

from flexneedle.cli.main import _report_errors
from flexneedle.lab.commands.calibrate import add_parser
from flexneedle.scenario.files import load_scenario
from simulated_session import simulate, without_slopes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("session")
    simulate(4, resting=1, seed=3, **{"tissue.0.shear_modulus_kpa": 660.0}).save(path)
    return path


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["calibrate", *map(str, argv)])
    status = _report_errors(lambda: args.handler(args))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_a_table_and_a_scenario(folder, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    status, printed, _ = run(capsys, folder, "gel", "--out", out, "--profile", "guide")
    assert status == 0
    assert "stiffness of gel" in printed
    assert str(out) in printed
    assert (tmp_path / "mine.guide.png").stat().st_size > 1000
    assert load_scenario(out).tissue[0].shear_modulus_kpa == pytest.approx(660.0, rel=0.2)


def test_json(folder, tmp_path, capsys):
    out = tmp_path / "a.toml"
    status, printed, _ = run(
        capsys, folder, "gel", "--fit", "stiffness", "--profile", "stiffness", "--out", out, "--json"
    )
    assert status == 0
    found = json.loads(printed)
    assert found["parameters"]["stiffness of gel"]["identified"]
    assert found["profile"] == str(tmp_path / "a.stiffness.png")


def test_an_unidentified_parameter_gets_no_number(tmp_path, capsys):
    session = without_slopes(simulate(4, resting=4, noise=0.1, seed=5))
    session.save(tmp_path / "session")
    status, printed, _ = run(
        capsys, tmp_path / "session", "gel", "--fit", "stiffness", "bevel", "--out", tmp_path / "a.toml"
    )
    assert "not identified" in printed
    assert "move the guide by ±3 mm" in printed
    assert status == 0


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("nowhere", "gel"), "nowhere: not a session"),
        (("FOLDER", "gel", "--fit", "colour"), "fit = colour: must be one of stiffness, bevel"),
        (("FOLDER", "gel", "--session", "b"), "session = b: must be one of a"),
        (("FOLDER", "nothing.toml"), "nothing.toml"),
        (
            ("FOLDER", "gel", "--fit", "bevel", "--profile", "stiffness"),
            "must be one of bevel along y, bevel along z",
        ),
        (
            ("FOLDER", "gel", "--profile", "bevel"),
            "profile = bevel: must be one of stiffness of gel, bevel along y",
        ),
        (("FOLDER", "gel", "--design", "1"), "--design needs no session: give only the scenario"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, line, folder, tmp_path, capsys):
    given = [folder if each == "FOLDER" else each for each in arguments]
    status, _, err = run(capsys, *given, "--out", tmp_path / "out.toml")
    assert status != 0
    assert line in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out.toml").exists()


def test_an_out_that_cannot_be_written_is_refused_before_the_fit(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.calibration.calibration.calibrate", None)
    (tmp_path / "file").touch()
    for out, reason in ((tmp_path / "file" / "a.toml", "cannot be written"), (tmp_path, "is a folder")):
        status, shown, err = run(capsys, folder, "gel", "--out", out)
        assert (status, shown) == (2, "")
        assert err.startswith(f"flexneedle: {out}: {reason}")
        assert err.count("\n") == 1


def test_a_design_needs_no_session(tmp_path, capsys):
    status, printed, _ = run(capsys, "gel", "--design", "2", "--out", tmp_path / "out.toml")
    assert status == 0
    lines = printed.splitlines()
    assert lines[2:5] == ["Insertion 1", "  at 8 mm guide to -6.0 mm", "  at 16 mm guide to +6.0 mm"]
    assert lines[5].startswith("  stiffness of gel ×÷ ")
    assert not (tmp_path / "out.toml").exists()


def test_a_design_as_json(capsys):
    status, printed, _ = run(capsys, "gel", "--design", "1", "--json")
    assert status == 0
    (found,) = json.loads(printed)["insertions"]
    assert found["depth_mm"] == 80.0
    assert found["guide"][0] == {"depth_mm": 8.0, "position_mm": [-6.0]}
    assert found["intervals"]["stiffness of gel"]["factor"] > 1.0
    assert found["intervals"]["bevel"]["unit"] == "mm"


def test_a_fit_needs_a_session(capsys):
    status, _, err = run(capsys, "gel")
    assert status != 0
    assert "SESSION: missing" in err
