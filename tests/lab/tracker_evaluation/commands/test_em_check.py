"""`flexneedle em check`: the indicator with the rig's power off and on."""

import json
import re

import numpy as np
import pytest

from em_tables import GRID, rows_of, write_csv
from flexneedle.cli import main as cli


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(list(map(str, argv)))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def powered(mean, environment="on", points=27, sensor="reference"):
    values = mean * np.linspace(0.5, 1.5, points)
    return rows_of(GRID[:points], GRID[:points, None], sensor, environment, values.tolist())


def test_check_compares_two_environments_with_status_1_above_the_threshold(capsys, tmp_path):
    table = write_csv(tmp_path / "t.csv", powered(0.02, "off") + powered(0.04))
    status, out, _ = run(capsys, "em", "check", table)
    assert status == 0
    assert "power adds 0.0200 (95 % interval" in out
    assert "mean 0.0400 with power on, not above the threshold of 0.0547 (" in out
    table = write_csv(tmp_path / "t.csv", powered(0.02, "off") + powered(0.06))
    status, out, _ = run(capsys, "em", "check", table, "--json")
    values = json.loads(out)
    assert (status, values["above"], values["paper_powered"]) == (1, True, 0.04)
    assert values["results"][0]["difference"] == pytest.approx(0.04)
    assert values["results"][0]["paired"] is True
    low, high = values["results"][0]["difference_interval"]
    assert 0.03 < low <= 0.04 + 1e-12 <= high + 2e-12 < 0.05  # higher with power on
    assert values["results"][0]["points_above"] == 16


def test_check_finds_both_environments_by_name(capsys, tmp_path):
    both = write_csv(tmp_path / "both.csv", powered(0.02, "quiet") + powered(0.03))
    status, out, _ = run(capsys, "em", "check", both, "--off", "quiet", "--threshold", "0.025")
    assert status == 1
    assert "above the threshold of 0.025" in out
    assert re.search(r"paper, power on +0\.0400", out)
    status, _, err = run(capsys, "em", "check", both)
    assert status == 2
    assert "no environment 'off': choose with --off and --on from on, quiet" in err


def test_check_names_a_sensor_missing_in_one_environment(capsys, tmp_path):
    rows = powered(0.02, "off") + powered(0.02) + powered(0.02, sensor="ref2")
    table = write_csv(tmp_path / "t.csv", rows)
    status, _, err = run(capsys, "em", "check", table)
    assert (status, err) == (0, "note: ref2: no indicator with power off\n")
    assert json.loads(run(capsys, "em", "check", table, "--json")[1])["notes"] == [err[6:-1]]
    status, _, err = run(capsys, "em", "check", write_csv(tmp_path / "t.csv", rows[:27] + rows[54:]))
    assert status == 2
    assert "no sensor has an indicator both with power off (reference) and on (ref2)" in err
