"""Notes on a table: a poor fit; an unknown environment is refused."""

import numpy as np
import pytest

from em_tables import GRID, random_rows, rows_of, write_csv
from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


def notes(path, rows, **options):
    return evaluate_table(write_csv(path / "t.csv", rows), EvaluationOptions(**options)).notes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p * (1, 1, -1), "a mirrored frame fits far better"),
        (lambda p: p[:, [0, 2, 1]] * (1, 1, 2.0), "the fit has a residual of"),
    ],
)
def test_a_note_reports_a_poor_rigid_fit(tmp_path, change, message):
    positions = change(GRID + np.random.default_rng(0).normal(0.0, 0.1, GRID.shape))
    rows = rows_of(GRID, np.repeat(positions[:, None], 2, axis=1))
    (found,) = notes(tmp_path, rows, register=True)
    assert found.startswith(f"tip, ideal: {message}")
    assert notes(tmp_path, rows) == notes(tmp_path, random_rows(0), register=True) == []


@pytest.mark.parametrize("option", ["ideal", "noisy"])
def test_an_unknown_environment_in_an_option_is_refused(tmp_path, option):
    with pytest.raises(InputError, match=f"--{option}: no environment 'lab emty': choose from lab empty"):
        notes(tmp_path, random_rows(0, environment="lab empty"), **{option: "lab emty"})
