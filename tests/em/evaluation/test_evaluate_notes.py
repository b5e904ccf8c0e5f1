"""What is said about a table unasked: a frame of its own, environments that were not measured alike."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from em_tables import GRID, random_rows, rows_of, write_csv
from flexneedle.em.evaluation.evaluate import Options, evaluate
from flexneedle.errors import InputError


def notes(path, rows, **options):
    return evaluate(write_csv(path / "t.csv", rows), Options(**options)).notes


def turned(rows):
    for row in rows:
        x = Rotation.from_euler("z", 20, degrees=True).apply([row[f"{axis}_mm"] for axis in "xyz"]) + 200.0
        row |= dict(zip(("x_mm", "y_mm", "z_mm"), map(float, x), strict=True))
    return rows


def test_a_tracker_with_a_frame_of_its_own_is_told_to_be_registered(tmp_path):
    rows = turned(random_rows(0)) + turned(random_rows(1, sensor="reference"))
    (told,) = notes(tmp_path, rows)
    fit = evaluate(tmp_path / "t.csv", Options(register=True)).results
    assert "add --register" in told
    assert ", and 1 more)" in told
    assert any(f"to {result.accuracy.rmse_mm:.2g} mm (" in told for result in fit)


@pytest.mark.parametrize(
    "case", ["registered", "in the stage's frame", "few points", "points on a line", "wrong, but not rigidly"]
)
def test_nothing_is_said_about_the_frame_where_a_fit_would_not_help_or_was_made(tmp_path, case):
    rows = turned(random_rows(0)) if case != "in the stage's frame" else random_rows(0)
    if case == "few points":
        rows = [row for row in rows if row["point_id"] in (0, 1, 3, 9)]
    if case == "points on a line":
        line = np.outer(np.arange(8.0), (10.0, 0.0, 0.0))
        rows = rows_of(line, np.repeat(line[:, None], 2, axis=1) + 100.0)
    if case == "wrong, but not rigidly":
        rows = rows_of(GRID, np.repeat(2.0 * (GRID - 25.0)[:, None] + 25.0, 2, axis=1))
    assert notes(tmp_path, rows, register=case == "registered") == []


def test_a_place_with_a_second_id_is_told(tmp_path):
    rows = random_rows(0)
    assert notes(tmp_path, rows) == []
    for row in rows[3:6]:
        row["point_id"] = "first again"
    assert notes(tmp_path, rows)[0].startswith(
        "tip, ideal: 1 of 28 grid points repeat a position under another point_id (counted as"
    )


@pytest.mark.parametrize(("times", "said"), [(4.5, False), (5.5, True)])
def test_the_frame_is_told_from_five_times_the_residual_on(tmp_path, times, said):
    """Positions 1 % too far from the centroid; a fit removes an offset and leaves a residual of 1 / `times` of the RMSE."""
    middle = GRID.mean(axis=0)
    left = 0.01 * np.sqrt(((GRID - middle) ** 2).sum(axis=1).mean())
    shift = np.array([0.0, 0.0, left * np.sqrt(times**2 - 1.0)])
    places = np.repeat((middle + 1.01 * (GRID - middle) + shift)[:, None], 2, axis=1)
    told = notes(tmp_path, rows_of(GRID, places))
    assert len(told) == said
    assert all(f"reduce the RMSE from {times * left:.3g} mm to {left:.2g} mm" in note for note in told)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p * (1, 1, -1), "a mirrored frame fits far better"),
        (lambda p: p[:, [0, 2, 1]] * (1, 1, 2.0), "the fit has a residual of"),
    ],
)
def test_a_rigid_fit_that_does_not_fit_is_told(tmp_path, change, says):
    places = np.repeat(
        change(GRID + np.random.default_rng(0).normal(0.0, 0.1, GRID.shape))[:, None], 2, axis=1
    )
    (told,) = notes(tmp_path, rows_of(GRID, places), register=True)
    assert told.startswith(f"tip, ideal: {says}")
    assert notes(tmp_path, turned(random_rows(0)), register=True) == []


def test_grid_points_that_only_one_environment_has_are_counted(tmp_path):
    some = [row for row in random_rows(1, environment="noisy") if row["point_id"] < 21]
    assert notes(tmp_path, random_rows(0) + some) == [
        "tip: grid points: 27 in ideal, 21 in noisy, 21 in common: the compared positions differ"
    ]
    assert notes(tmp_path, random_rows(0) + random_rows(1, environment="noisy")) == []


def test_as_many_points_with_other_names_are_other_points(tmp_path):
    other = [{**row, "point_id": row["point_id"] + 5} for row in random_rows(1, environment="noisy")]
    (told,) = notes(tmp_path, random_rows(0) + other)
    assert "27 in ideal, 27 in noisy, 22 in common" in told


def test_a_sensor_that_an_environment_lacks_is_named(tmp_path):
    rows = [
        *random_rows(0),
        *random_rows(1, sensor="reference"),
        *random_rows(2, sensor="reference", environment="noisy"),
    ]
    assert notes(tmp_path, rows) == ["tip: not in noisy, only in ideal"]


def test_a_single_environment_of_any_name_is_nothing_to_talk_about(tmp_path):
    assert notes(tmp_path, random_rows(0, environment="lab")) == []


@pytest.mark.parametrize("option", ["ideal", "noisy"])
def test_an_environment_that_was_asked_for_and_is_not_there_is_refused(tmp_path, option):
    with pytest.raises(InputError, match=f"--{option}: no environment 'lab emty': choose from lab empty"):
        notes(tmp_path, random_rows(0, environment="lab empty"), **{option: "lab emty"})
