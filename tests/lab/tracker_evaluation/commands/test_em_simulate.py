"""`flexneedle em simulate` from the command line."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from flexneedle.cli.main import main
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table
from flexneedle.lab.tracker_evaluation.evaluation.indicator import average_indicator
from flexneedle.scenario.files import load_scenario

DOCS = Path(__file__).resolve().parents[4] / "docs" / "tracking" / "simulate.md"

FEW = ("--points", "2", "--samples", "2", "--repeats", "1")


def simulate(*arguments):
    return main(["em", "simulate", *map(str, arguments)])


def test_by_default_both_environments_are_written_to_a_csv(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert simulate(*FEW) == 0
    assert capsys.readouterr().out == "measurements.csv\n"
    table = pyarrow.csv.read_csv(tmp_path / "measurements.csv")
    assert table.num_rows == 2 * 2 * 8 * 2
    assert set(table["environment"].to_pylist()) == {"ideal", "noisy"}


def test_a_custom_environment_appears_by_its_name(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "operating room"\nlength_mm = 80\n[plate]\nreference_mm = 2\n')
    out = tmp_path / "out.parquet"
    assert simulate(*FEW, "--environment", mine, "ideal", "--seed", 3, "--field-seed", 4, "--out", out) == 0
    assert set(pq.read_table(out)["environment"].to_pylist()) == {"operating room", "ideal"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--environment", "mine.toml"), "unknown key; did you mean length_mm?"),
        (("--environment", "nosy"), "no such environment (choices: ideal, noisy)"),
        (("--environment", "."), "is a directory, not an environment file"),
        (("--out", "out.txt"), "must end in .csv or .parquet"),
        (("--out", "mine.csv"), "mine.csv: already exists"),
        (("--out", "nodir/foo.csv"), "the folder nodir does not exist"),
    ],
)
def test_bad_input_gives_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text('name = "a"\nlenght_mm = 80\n')
    (tmp_path / "mine.csv").write_text("mine")
    assert simulate(*FEW, *arguments) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.csv", "mine.toml"]
    assert (tmp_path / "mine.csv").read_text() == "mine"


def test_counts_out_of_bounds_are_refused(capsys):
    for option, value in (("--points", "1"), ("--samples", "0"), ("--repeats", "1001")):
        with pytest.raises(SystemExit):
            simulate(option, value)
        assert f"argument {option}: {value}: must be a whole number from" in capsys.readouterr().err


# ---- the documentation page


def examples():
    return re.findall(r"```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)


def test_the_indicator_detects_the_documented_plate(tmp_path):
    """The coils of the indicator are sensitive only along their axis; the plate is not beside them."""
    (tmp_path / "room.toml").write_text(examples()[1])
    arguments = ("--points", 4, "--samples", 10, "--repeats", 1, "--out", tmp_path / "out.csv")
    assert simulate(*arguments, "--environment", tmp_path / "room.toml", "ideal") == 0
    results = evaluate_table(tmp_path / "out.csv", EvaluationOptions()).results
    means = {
        grid.environment: average_indicator(grid)[0] for grid in (r.grid for r in results) if grid.samples
    }
    assert np.mean(means["operating room"][:, None] > means["ideal"]) > 0.9  # the area under the ROC curve


def test_the_documented_scenario_is_valid():
    values = tomllib.loads(examples()[0])["tracker"]
    scenario = load_scenario("phantom").with_values({f"tracker.{key}": values[key] for key in values})
    assert scenario.tracker.tip_offset_mm == 6.0
    assert scenario.tracker.environment.name == "noisy"
