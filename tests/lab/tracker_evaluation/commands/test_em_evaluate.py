"""`flexneedle em evaluate`: output, files and exit status."""

import json
import sys

import numpy as np
import pytest

from em_tables import GRID, plain, random_rows, rows_of, write_csv
from flexneedle.cli import main as cli
from report_page import save_nothing


@pytest.fixture(scope="module")
def rows():
    """A sensor in a clean field, and another over metal as well."""
    rng = np.random.default_rng(0)
    rows = random_rows(1, samples=5)
    for name, error, level in (("ideal", 0.5, 0.02), ("noisy", 2.0, 0.2)):
        samples = GRID[:, None] + rng.normal(0.0, error, (27, 1, 3)) + rng.normal(0.0, 0.04, (27, 5, 3))
        rows += rows_of(GRID, samples, "reference", name, (level * rng.uniform(0.5, 1.5, 27)).tolist())
    return rows


@pytest.fixture
def table(tmp_path, rows):
    return write_csv(tmp_path / "mine.csv", rows)


@pytest.fixture
def no_figures(monkeypatch):
    """Draw nothing: figures take most of a command's time."""
    monkeypatch.setattr("flexneedle.lab.tracker_evaluation.figures.evaluation.draw_evaluation", lambda *_: [])


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(list(map(str, argv)))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.mark.usefixtures("no_figures")
def test_tables_show_the_papers_and_the_manufacturers_values(capsys, table, tmp_path):
    status, out, err = run(capsys, "em", "evaluate", table, "--out", tmp_path / "out")
    assert (status, err) == (0, "")
    for text in (
        "tip, ideal",
        " paper",
        "0.65",
        " manufacturer",
        "0.48",
        "threshold",
        "reference, noisy: slope (mm)",
    ):
        assert text in out
    assert str(tmp_path / "out") in out


def test_json_is_one_object_in_full_precision_and_is_also_written(capsys, table, tmp_path, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.tracker_evaluation.figures.evaluation.save", save_nothing)
    folder = tmp_path / "out"
    status, out, _ = run(capsys, "em", "evaluate", table, "--out", folder, "--json")
    values = json.loads(out)
    assert status == 0
    assert json.loads((folder / "evaluation.json").read_text()) == values
    tip = values["results"][0]
    assert (tip["sensor"], tip["environment"]) == ("tip", "ideal")
    for name, value in plain(random_rows(1, samples=5)).items():
        assert tip[name] == pytest.approx(value, abs=1e-12)
    assert values["indicator"][0]["sensor"] == "tip"
    names = [path.rsplit("/", 1)[-1] for path in values["figures"]]
    assert names == [f"{name}.{kind}" for name in ("field", "indicator") for kind in ("png", "svg")]


@pytest.mark.usefixtures("no_figures")
def test_the_default_folder_is_new_and_results_are_not_overwritten(capsys, table, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(capsys, "em", "evaluate", table)
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("-em-mine")
    status, _, err = run(capsys, "em", "evaluate", table, "--out", folder)
    assert (status, err.count("\n")) == (2, 1)
    assert "already contains evaluation.json" in err
    status, _, err = run(capsys, "em", "evaluate", table, "--ideal", "idael", "--out", tmp_path / "out")
    assert (status, err.count("\n")) == (2, 1)
    assert "--ideal: no environment 'idael'" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["evaluate", "register"])
def test_without_duckdb_the_extra_is_named_in_one_line(capsys, table, command, monkeypatch):
    monkeypatch.setitem(sys.modules, "duckdb", None)
    status, out, err = run(capsys, "em", command, table)
    assert (status, out) == (2, "")
    assert err == "flexneedle: duckdb: not installed: pip install 'flexneedle[em]'\n"


@pytest.mark.usefixtures("no_figures")
def test_names_of_environments_and_labels_of_all_rows_are_shown(capsys, table, tmp_path, rows):
    table.write_text(table.read_text().replace(",ideal", ",lab empty").replace(",noisy", ",with table"))
    names = ("--ideal", "lab empty", "--noisy", "with table", "--out", tmp_path / "out")
    _, out, _ = run(capsys, "em", "evaluate", table, *names)
    assert "reference, lab empty: error" in out
    assert "reference, with table: slope" in out
    assert " ideal" not in out
    assert " noisy" not in out
    bare = [{k: v for k, v in row.items() if k not in ("sensor", "environment")} for row in rows[:135]]
    path = write_csv(tmp_path / "bare.csv", bare)
    status, out, err = run(capsys, "em", "evaluate", path, "--out", tmp_path / "two")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"flexneedle: {path}: no column sensor, environment")
    assert not (tmp_path / "two").exists()
    labels = ("--environment", "lab", "--out", tmp_path / "two")
    status, out, err = run(capsys, "em", "evaluate", path, "--sensor", "coil", *labels)
    assert (status, err) == (0, "")
    assert " coil, lab" in out
    with pytest.raises(SystemExit):
        run(capsys, "em", "evaluate", path, "--sensor", " ", *labels)
