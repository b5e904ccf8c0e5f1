"""Notes on a table: a different frame of the tracker, a poor fit; an unknown environment is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from em_tables import GRID, one, random_rows, rows_of, write_csv
from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


def notes(path, rows, **options):
    return evaluate_table(write_csv(path / "t.csv", rows), EvaluationOptions(**options)).notes


def rotated(rows):
    for row in rows:
        x = Rotation.from_euler("z", 20, degrees=True).apply([row[f"{axis}_mm"] for axis in "xyz"]) + 200.0
        row |= dict(zip(("x_mm", "y_mm", "z_mm"), map(float, x), strict=True))
    return rows


def test_a_note_suggests_register_for_a_tracker_with_another_frame(tmp_path):
    rows = rotated(random_rows(0)) + rotated(random_rows(1, sensor="reference"))
    (found,) = notes(tmp_path, rows)
    fit = evaluate_table(tmp_path / "t.csv", EvaluationOptions(register=True)).results
    assert "add --register" in found
    assert ", and 1 more)" in found
    assert any(f"to {result.accuracy.rmse_mm:.2g} mm (" in found for result in fit)


@pytest.mark.parametrize(
    "case", ["registered", "in the stage's frame", "few points", "points on a line", "wrong, but not rigidly"]
)
def test_no_note_if_a_rigid_fit_would_not_help_or_was_made(tmp_path, case):
    rows = rotated(random_rows(0)) if case != "in the stage's frame" else random_rows(0)
    if case == "few points":
        rows = [row for row in rows if row["point_id"] in (0, 1, 3, 9)]
    if case == "points on a line":
        line = np.outer(np.arange(8.0), (10.0, 0.0, 0.0))
        rows = rows_of(line, np.repeat(line[:, None], 2, axis=1) + 100.0)
    if case == "wrong, but not rigidly":
        rows = rows_of(GRID, np.repeat(2.0 * (GRID - 25.0)[:, None] + 25.0, 2, axis=1))
    assert notes(tmp_path, rows, register=case == "registered") == []


@pytest.mark.parametrize(("times", "expected"), [(4.5, False), (5.5, True)])
def test_the_note_on_the_frame_appears_from_five_times_the_residual(tmp_path, times, expected):
    """Positions 1 % too far from the centroid, shifted so that the RMSE is `times` the residual of a fit."""
    middle = GRID.mean(axis=0)
    residual = 0.01 * np.sqrt(((GRID - middle) ** 2).sum(axis=1).mean())
    shift = np.array([0.0, 0.0, residual * np.sqrt(times**2 - 1.0)])
    positions = np.repeat((middle + 1.01 * (GRID - middle) + shift)[:, None], 2, axis=1)
    found = notes(tmp_path, rows_of(GRID, positions))
    assert len(found) == expected
    assert all(
        f"reduce the RMSE from {times * residual:.3g} mm to {residual:.2g} mm" in note for note in found
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p * (1, 1, 2.0), "the fit has a residual of"),
        (lambda p: p[[1, 0, *range(2, 27)]] * (1, 1, 1.0), "the fit has a residual of"),
    ],
)
def test_a_note_reports_a_poor_rigid_fit(tmp_path, change, message):
    positions = change(GRID + np.random.default_rng(0).normal(0.0, 0.1, GRID.shape))
    rows = rows_of(GRID, np.repeat(positions[:, None], 2, axis=1))
    (found,) = notes(tmp_path, rows, register=True)
    assert found.startswith(f"tip, ideal: {message}")
    assert notes(tmp_path, rows) == notes(tmp_path, random_rows(0), register=True) == []


def test_a_poor_fit_of_points_in_another_order_says_nothing_of_their_plane(tmp_path):
    """The residual is large because of the order: it is no sign of a thin set of points."""
    points = [[0, 0, 0], [50, 0, 0], [50, 30, 0], [0, 30, 5], [20, 10, 20], [40, -20, -15], [10, -25, 12]]
    points = np.array([*points, [60, 15, -8.5]], float)
    rows = rows_of(points, np.repeat(np.roll(points, 1, axis=0)[:, None], 2, axis=1))
    (found,) = (note for note in notes(tmp_path, rows, register=True) if "exactly" not in note)
    assert "the list shifted by one" in found


def test_a_mirrored_frame_is_refused_with_register_and_noted_without(tmp_path):
    positions = (GRID + np.random.default_rng(0).normal(0.0, 0.1, GRID.shape)) * (1, 1, -1)
    rows = rows_of(GRID, np.repeat(positions[:, None], 2, axis=1))
    (found,) = notes(tmp_path, rows)
    assert found.startswith("tip, ideal: a mirrored frame fits far better")
    with pytest.raises(InputError, match="a mirrored frame fits far better"):
        notes(tmp_path, rows, register=True)


ZEROS = dict.fromkeys(("x_mm", "y_mm", "z_mm"), 0.0)
NEGATIVE_ZEROS = dict.fromkeys(("x_mm", "y_mm", "z_mm"), -0.0)
NINES = dict.fromkeys(("x_mm", "y_mm", "z_mm"), -9999.0)
NO_TURN = dict.fromkeys(("qw", "qx", "qy", "qz"), 0.0)
BAD_FLOAT = dict.fromkeys(("x_mm", "y_mm", "z_mm"), -3.697314e28)


@pytest.mark.parametrize(
    ("code", "note"),
    [
        (BAD_FLOAT, "27 of 540 samples have no position (left out)"),
        (BAD_FLOAT | NO_TURN, "27 of 540 samples have no position (left out)"),
        (ZEROS | NO_TURN, "27 of 540 samples have no position (left out)"),
        (ZEROS, "27 of 540 positions are exactly (0, 0, 0), a code for missing?"),
        (NEGATIVE_ZEROS, "27 of 540 positions are exactly (0, 0, 0), a code for missing?"),
        (NINES, "27 of 540 positions are exactly (-9999, -9999, -9999), a code for missing?"),
    ],
)
def test_codes_for_missing_samples_are_left_out_or_noted(tmp_path, code, note):
    rows = [
        row | dict(zip(NO_TURN, (1.0, 0.0, 0.0, 0.0), strict=True)) for row in random_rows(0, offset=100.0)
    ]
    expected = one(write_csv(tmp_path / "all.csv", [row for k, row in enumerate(rows) if k % 20]))
    rows = [row if k % 20 else row | code for k, row in enumerate(rows)]
    found = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions())
    assert found.notes[0].startswith(f"tip, ideal: {note}")
    if code not in (ZEROS, NINES):
        assert found.results[0].accuracy.rmse_mm == pytest.approx(expected["rmse_mm"], rel=1e-9)


@pytest.mark.parametrize("code", [1e30, -3.6e28, -99999.0, 10_001.0])
def test_other_positions_beyond_10_m_are_refused(tmp_path, code):
    rows = random_rows(0)
    rows[7] |= {"z_mm": code}
    with pytest.raises(InputError, match="line 9: x_mm, y_mm, z_mm: must be at most 10000 mm"):
        notes(tmp_path, rows)


@pytest.mark.parametrize(
    ("scale", "unit", "rule"),
    [(1e-3, "mm", "the grid points of tip, ideal are within 0"), (1.0, "m", "must be at most 10000 mm"),
     (0.1, "m", "mm (RMS) of their center, must be from 0.5 to 3000 mm")],
)  # fmt: skip
def test_another_unit_is_suspected(tmp_path, scale, unit, rule):
    scaled = [
        {key: scale * value if key.endswith("_mm") else value for key, value in row.items()}
        for row in random_rows(0)
    ]
    with pytest.raises(InputError) as caught:
        notes(tmp_path, scaled, unit=unit)
    assert rule in str(caught.value)
    assert "is the unit right" in str(caught.value)


@pytest.mark.parametrize("option", ["ideal", "noisy"])
def test_an_unknown_environment_in_an_option_is_refused(tmp_path, option):
    with pytest.raises(InputError, match=f"--{option}: no environment 'lab emty': choose from lab empty"):
        notes(tmp_path, random_rows(0, environment="lab empty"), **{option: "lab emty"})
