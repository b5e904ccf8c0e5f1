"""`flexneedle report`: path of the page, statistics as JSON, errors in one line."""

import json
from pathlib import Path

import pytest

from flexneedle.cli import main as cli
from report_page import save_nothing
from study_rows import OURS, make_rows, unfinished, write_study


@pytest.fixture
def study(tmp_path):
    rows = make_rows((OURS, "open-loop"), targets=((25.0, 0.0), (40.0, 5.0)), repeats=6)
    rows[2] = unfinished(rows[2], "refused", "plan misses the target")
    return write_study(tmp_path / "study", rows)


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(argv)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_the_path_of_the_page_or_all_statistics_are_printed(capsys, study, tmp_path, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.study.report.figures.save", save_nothing)
    status, out, err = run(capsys, "report", str(study))
    assert (status, out.strip(), err) == (0, str(study / "report" / "report.html"), "")
    assert Path(out.strip()).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    status, out, _ = run(capsys, "report", str(study), "--out", str(tmp_path / "here"), "--json")
    values = json.loads(out)
    assert status == 0
    counts = {"study": "Mine", "insertions": 24, "planned": 24, "finished": 23, "missing": 0}
    assert {name: values[name] for name in counts} == counts
    assert values["outcomes"] == {"done": 23, "refused": 1}
    assert values["report"] == str(tmp_path / "here" / "report.html")
    assert all(Path(path).is_file() for path in values["figures"])
    mean = values["groups"][0]["estimates"]["mean_mm"]
    assert mean["low"] < mean["value"] < mean["high"]
    assert len(repr(mean["value"])) > 12  # all digits
    assert values["controllers"][0]["verdict"] == "better"
    assert values["endings"][0]["reason"] == "plan misses the target"
