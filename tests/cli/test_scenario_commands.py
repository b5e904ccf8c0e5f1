"""`flexneedle scenario …`: output and exit status."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import commands
import flexneedle
from flexneedle.cli import main as cli
from flexneedle.control.controllers import CONTROLLERS, check_tables
from flexneedle.errors import RunError
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario


def run(capsys, *argv):
    """Return exit status, stdout and the lines on stderr."""
    status, out, err = commands.run(capsys, *argv)
    return status, out, err.splitlines()


def test_list_names_the_presets(capsys):
    listed = "gel          Stiff gel\n"
    listed += "phantom      Two-layer tissue phantom\nphantom3d    Two-layer tissue phantom in space\n"
    assert run(capsys, "scenario", "list") == (0, listed, [])


def test_show_prints_the_scenario_with_its_defaults(capsys, minimal_text, scenario_file):
    path = str(scenario_file(minimal_text))
    status, out, err = run(capsys, "scenario", "show", path)
    assert (status, err) == (0, [])
    assert tomllib.loads(out)["plan"]["samples"] == 128
    assert Scenario.from_values(tomllib.loads(out)) == check_tables(load_scenario(path))


def test_show_prints_the_settings_of_every_controller_and_round_trips(capsys, tmp_path):
    out = run(capsys, "scenario", "show", "phantom")[1]
    assert set(tomllib.loads(out)["control"]) >= {
        method.table for method in CONTROLLERS.values() if method.settings is not None
    }
    path = tmp_path / "shown.toml"
    path.write_text(out)
    assert load_scenario(path) == check_tables(load_scenario("phantom"))
    assert run(capsys, "scenario", "show", str(path)) == (0, out, [])


@pytest.mark.parametrize(
    ("old", "new", "keys"),
    [
        ("", "", []),
        (
            "alpha = 8.0",
            "alpha = 0\nengaged_mm = 1",
            ["tissue[0].alpha = 0: must not be 0", "tissue[0].engaged_mm = 1: unknown key"],
        ),
        (
            "[setup]",
            "[control.bevel_olny]\n[setup]",
            ["control.bevel_olny: unknown table; did you mean bevel_only? tables: "],
        ),
    ],
)
def test_check_and_show_print_one_line_per_problem(capsys, minimal_text, scenario_file, old, new, keys):
    path = scenario_file(minimal_text.replace(old, new, 1) if old else minimal_text)
    status, out, err = run(capsys, "scenario", "check", str(path))
    assert (status, out) == ((2, "") if keys else (0, f"{path}: ok, Minimal\n"))
    assert len(err) == len(keys)
    assert all(line.startswith(f"flexneedle: {path}: {key}") for line, key in zip(err, keys, strict=True))
    if keys:
        assert run(capsys, "scenario", "show", str(path))[:2] == (2, "")


def test_schema_describes_every_key_with_a_unit_or_a_meaning(capsys):
    status, out, _ = run(capsys, "scenario", "schema")
    schema = json.loads(out)
    assert status == 0
    assert set(schema["required"]) == {"name", "needle", "setup", "tissue"}
    sections = schema["$defs"].values()
    described = [
        ("description" in field or "$ref" in field) for s in sections for field in s["properties"].values()
    ]
    assert all(described)
    tables = schema["$defs"]["ControlSettings"]["properties"]
    assert {"ce_mpc", "bevel_only", "load_gain"} <= set(tables)


@pytest.mark.parametrize("argv", [["scenario"], ["scenario", "show"], ["nonsense"], []])
def test_wrong_arguments_exit_with_status_2(argv, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(argv)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "status", "lines"),
    [
        (RunError("no such luck"), 1, ["flexneedle: no such luck"]),
        (flexneedle.CommandError("db_x", 2, 1, "too far"), 2, ["flexneedle: db_x = 2: too far"]),
        (KeyboardInterrupt(), 130, ["flexneedle: interrupted"]),
        (OSError(28, "No space left on device"), 1, ["flexneedle: [Errno 28] No space left on device"]),
    ],
    ids=["run", "command", "interrupt", "disk"],
)
def test_errors_are_one_line_and_an_exit_status(raised, status, lines, capsys, monkeypatch):
    def fail(_source):
        raise raised

    monkeypatch.setattr("flexneedle.scenario.files.load_scenario", fail)
    assert run(capsys, "scenario", "show", "phantom") == (status, "", lines)


def test_a_closed_pipe_prints_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    line = [sys.executable, "-m", "flexneedle", "scenario", "schema"]
    done = subprocess.run(line, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.stderr == ""


def test_a_path_that_is_not_valid_unicode_is_accepted(capsys, minimal_text, tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.toml")
    Path(path).write_text(minimal_text)
    status, out, err = run(capsys, "scenario", "check", path)
    assert (status, err) == (0, [])
    assert out.endswith("\\udcff.toml: ok, Minimal\n")


def test_check_warns_of_implausible_values(capsys, minimal_text, scenario_file):
    text = minimal_text.replace("shear_modulus_kpa = 2.0", "shear_modulus_kpa = 6000.0\nthickness_mm = 9.0")
    path = scenario_file(text)
    status, out, err = run(capsys, "scenario", "check", str(path))
    assert (status, out) == (0, f"{path}: ok, Minimal\n")
    assert [line.partition(": 28.6")[0].partition(": the")[0] for line in err] == [
        f"flexneedle: {path}: tissue[0].shear_modulus_kpa = 6000 (youngs_modulus_kpa = 18000, E = 3μ)",
        f"flexneedle: {path}: tissue[0].thickness_mm = 9: has no effect",
    ]
    assert run(capsys, "scenario", "check", "--strict", str(path)) == (2, "", err)
