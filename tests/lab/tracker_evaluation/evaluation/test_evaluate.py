"""`em evaluate` against values computed by hand, a second implementation, and invariances."""

import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from em_tables import GRID, plain, random_rows, rows_of, write_csv
from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table

LAWS = settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
# Two points, (0, 0, 0) and (10, 0, 0). Means off by (3, 4, 0) and (0, 0, 1): errors 5 and 1. Samples ±1 along x at the
# first, ±2 along y at the second.
BY_HAND = rows_of(
    [(0, 0, 0), (10, 0, 0)],
    [[(2, 4, 0), (4, 4, 0)], [(10, 2, 1), (10, -2, 1)]],
    indicator=[0.02, 0.04],
)


def results(path, **options):
    return {
        (r["sensor"], r["environment"]): r
        for r in evaluate_table(path, EvaluationOptions(**options)).values()["results"]
    }


def only(path, **options):
    (result,) = results(path, **options).values()
    return result


def test_the_papers_equations_on_a_table_worked_out_by_hand(tmp_path):
    found = only(write_csv(tmp_path / "t.csv", BY_HAND))
    assert found["rmse_mm"] == pytest.approx(math.sqrt((25 + 1) / 2), rel=1e-15)
    assert found["p95_mm"] == pytest.approx(1 + 0.95 * 4, rel=1e-15)  # between the ranks 0 and 1
    assert found["max_mm"] == 5.0
    assert found["max_at"] == "0"
    assert found["jitter_mm"] == pytest.approx(math.sqrt((1 + 1 + 4 + 4) / 4), rel=1e-15)
    assert (found["mean_mm"], found["sd_mm"]) == pytest.approx((3.0, math.sqrt(8.0)))
    assert found["bias_mm"] == pytest.approx([1.5, 2.0, 0.5])
    assert (found["n_points"], found["n_samples"], found["n_missing"]) == (2, 4, 0)
    assert found["indicator"]["mean"] == pytest.approx(0.03)
    assert found["official"] == {"rmse_mm": 0.70, "p95_mm": 1.40}


def test_points_weigh_equally_in_the_errors_and_samples_in_the_jitter(tmp_path):
    rows = rows_of([(0, 0, 0), (10, 0, 0)], [[(1, 0, 0)], [(12, 1, 0), (12, -1, 0), (12, 0, 0)]])
    evaluation = evaluate_table(write_csv(tmp_path / "t.csv", rows), EvaluationOptions())
    found = evaluation.values()["results"][0]
    assert found["rmse_mm"] == pytest.approx(math.sqrt((1 + 4) / 2))
    assert found["jitter_mm"] == pytest.approx(math.sqrt(2 / 4))
    assert (found["n_single"], found["samples_least"], found["samples_most"]) == (1, 1, 3)


@pytest.mark.parametrize("offset", [0.0, 1000.0, -2500.0])
def test_a_second_implementation_agrees_far_from_the_origin(tmp_path, offset):
    rows = random_rows(seed=3, samples=50, offset=offset)
    np.random.default_rng(1).shuffle(rows)
    found, other = only(write_csv(tmp_path / "t.csv", rows)), plain(rows)
    for name, value in other.items():
        assert found[name] == pytest.approx(value, abs=1e-11), name


def test_parquet_and_csv_give_the_same_result_for_any_type_of_point_id(tmp_path):
    rows = random_rows(seed=1)
    table = pa.Table.from_pylist(rows)
    as_csv = results(write_csv(tmp_path / "t.csv", rows))
    pq.write_table(table, tmp_path / "t.parquet")
    text = table.set_column(0, "point_id", table["point_id"].cast(pa.string()))
    pq.write_table(text, tmp_path / "text.parquet", row_group_size=7)
    for name in ("t.parquet", "text.parquet"):
        (found,) = results(tmp_path / name).values()
        assert_same(found, *as_csv.values())


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """Rows of a table, and their evaluation after registration."""
    rows = random_rows(seed=7, samples=4)
    return rows, only(write_csv(tmp_path_factory.mktemp("registered") / "t.csv", rows), register=True)


@LAWS
@given(
    rotation=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    shift=st.tuples(*[st.floats(-800, 800)] * 3),
)
def test_after_registration_a_rigid_motion_of_the_tracker_does_not_matter(
    tmp_path, registered, rotation, shift
):
    rows, before = registered
    moved = [{**row, **rigid(row, rotation, shift)} for row in rows]
    after = only(write_csv(tmp_path / "t.csv", moved), register=True)
    for name in ("rmse_mm", "p95_mm", "max_mm", "jitter_mm"):
        assert after[name] == pytest.approx(before[name], abs=1e-9)
    assert after["registration"]["residual_mm"] == pytest.approx(after["rmse_mm"], rel=1e-12)


@pytest.mark.long
@LAWS
@given(shift=st.tuples(*[st.floats(-2000, 2000)] * 3))
def test_a_translation_of_the_tracker_does_not_change_jitter_or_relative_distances(tmp_path, shift):
    rows = random_rows(seed=8, samples=4)
    before = only(write_csv(tmp_path / "t.csv", rows))
    after = only(write_csv(tmp_path / "t.csv", [{**row, **rigid(row, (0, 0, 0), shift)} for row in rows]))
    assert after["jitter_mm"] == pytest.approx(before["jitter_mm"], abs=1e-9)
    assert after["relative_distance"]["rms_mm"] == pytest.approx(
        before["relative_distance"]["rms_mm"], abs=1e-9
    )


def assert_same(one, other):
    for name in ("rmse_mm", "p95_mm", "max_mm", "jitter_mm", "mean_mm", "sd_mm"):
        assert one[name] == pytest.approx(other[name], abs=1e-12)
    assert_allclose(one["intervals"]["rmse_mm"], other["intervals"]["rmse_mm"], atol=1e-12)
    assert one["indicator"]["samples"] == pytest.approx(other["indicator"]["samples"])
    assert one["max_at"] == other["max_at"]


def rigid(row, rotation, shift):
    x = Rotation.from_rotvec(rotation).apply([row[f"{axis}_mm"] for axis in "xyz"]) + shift
    return dict(zip(("x_mm", "y_mm", "z_mm"), map(float, x), strict=True))


def test_a_registration_removes_a_rigid_transform_and_reports_it(tmp_path):
    rotated = Rotation.from_euler("z", 3, degrees=True).apply(GRID) + np.array([1.0, 2.0, 3.0])
    samples = rotated[:, None]
    found = only(write_csv(tmp_path / "t.csv", rows_of(GRID, samples)), register=True)
    assert found["rmse_mm"] < 1e-12
    assert found["registration"]["angle_deg"] == pytest.approx(3.0, rel=1e-10)
    rotation, translation = (np.array(found["registration"][key]) for key in ("rotation", "translation_mm"))
    assert_allclose(rotated @ rotation.T + translation, GRID, atol=1e-10)
    line = write_csv(tmp_path / "t.csv", BY_HAND)
    with pytest.raises(InputError, match=r"--register: sensor 'tip', environment 'ideal'.*at least 3"):
        evaluate_table(line, EvaluationOptions(register=True))


def test_sensors_and_environments_are_evaluated_separately_in_the_papers_order(tmp_path):
    rows = [
        *random_rows(1, sensor="reference", environment="noisy", bias=2.0),
        *random_rows(2, sensor="coil 7", environment="ideal"),
        *random_rows(3, sensor="tip", environment="noisy"),
        *random_rows(4, sensor="reference", environment="ideal"),
    ]
    found = results(write_csv(tmp_path / "t.csv", rows))
    assert list(found) == [
        ("tip", "noisy"),
        ("reference", "ideal"),
        ("reference", "noisy"),
        ("coil 7", "ideal"),
    ]
    assert found["reference", "noisy"]["paper"]["max_mm"] == 8.16
    assert found["coil 7", "ideal"]["official"] is None
    for seed, key in ((1, ("reference", "noisy")), (4, ("reference", "ideal"))):
        bias = 2.0 if seed == 1 else 0.5
        assert found[key]["rmse_mm"] == pytest.approx(plain(random_rows(seed, bias=bias))["rmse_mm"])
