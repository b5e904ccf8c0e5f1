"""Damaged, incomplete and unusual tables, CSV and Parquet: refused in one line, or treated as documented."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from em_tables import one, plain, random_rows, refusal, write_csv
from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, evaluate_table


@pytest.fixture
def rows():
    return random_rows(seed=2, samples=3)


def test_missing_columns_are_named_with_the_option_that_maps_them(tmp_path, rows):
    without = [{k: v for k, v in row.items() if k not in ("x_mm", "sensor")} for row in rows]
    message = refusal(write_csv(tmp_path / "t.csv", without))
    assert "no column x_mm, sensor" in message
    assert "--columns NAME=COLUMN" in message


def test_columns_with_other_names_are_mapped_and_all_others_ignored(tmp_path, rows):
    theirs = {"point_id": "Point", "x_mm": "X [mm]", "indicator": "a=b"}
    named = [{theirs.get(key, key): value for key, value in row.items()} | {"note": "é, 'x'"} for row in rows]
    path = write_csv(tmp_path / "t.csv", named)
    pairs = tuple(f"{their}={our}" for our, their in theirs.items())
    assert one(path, columns=pairs)["rmse_mm"] == pytest.approx(plain(rows)["rmse_mm"])
    assert "'X' (for x_mm)" in refusal(path, columns=("X=x_mm",))
    swapped = [{**row, "x_mm": row["y_mm"], "y_mm": row["x_mm"]} for row in rows]
    path = write_csv(tmp_path / "t.csv", swapped)
    assert one(path, columns=("x_mm=y_mm", "y_mm=x_mm"))["rmse_mm"] == pytest.approx(plain(rows)["rmse_mm"])


def test_invalid_mappings_and_labels_are_refused(tmp_path, rows):
    path = write_csv(tmp_path / "t.csv", rows)
    assert "has a column sensor: --sensor is only for a table without it" in refusal(path, sensor="coil")
    for columns, expected in (
        (("X=x",), "'X=x': COLUMN must be one of point_id, true_x_mm"),
        (("X=x_mm", "Y=x_mm"), "x_mm is given twice, as 'X' and 'Y'"),
        (("x_mm",), "'x_mm': COLUMN must be"),
        (("x_mm=y_mm",), "'x_mm' would be both x_mm and y_mm"),
    ):
        with pytest.raises(InputError, match=expected):
            evaluate_table(path, EvaluationOptions(columns=columns))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_of_one_sensor_needs_no_names_and_no_indicator(tmp_path, rows, suffix):
    bare = [{k: v for k, v in row.items() if k not in ("sensor", "environment", "indicator")} for row in rows]
    path = tmp_path / f"t.{suffix}"
    write_csv(path, bare) if suffix == "csv" else pq.write_table(pa.Table.from_pylist(bare), path)
    message = refusal(path)
    assert "no column sensor, environment (found: " in message
    assert "for a table of one sensor and environment, use --sensor NAME --environment NAME" in message
    found = one(path, sensor="tip", environment="ideal")
    assert (found["sensor"], found["environment"], found["indicator"]) == ("tip", "ideal", None)
    assert found["rmse_mm"] == pytest.approx(plain(rows)["rmse_mm"])


def test_all_lengths_can_be_in_metres(tmp_path, rows):
    lengths = ("x_mm", "y_mm", "z_mm", "true_x_mm", "true_y_mm", "true_z_mm")
    metres = [
        {key: value / 1000.0 if key in lengths else value for key, value in row.items()} for row in rows
    ]
    found = one(write_csv(tmp_path / "t.csv", metres), unit="m")
    for name, value in plain(rows).items():
        assert found[name] == pytest.approx(value)


def test_samples_without_a_position_are_ignored_and_counted(tmp_path, rows):
    lost = [dict(row) for row in rows]
    for row in lost[:5]:  # all three of the first point, two of the second
        row |= {"x_mm": None, "y_mm": float("nan"), "z_mm": None}
    path = write_csv(tmp_path / "t.csv", lost)
    evaluation = evaluate_table(path, EvaluationOptions())
    found = evaluation.values()["results"][0]
    assert (found["n_missing"], found["n_samples"], found["n_points"], found["n_unseen"]) == (5, 76, 26, 1)
    assert found["rmse_mm"] == pytest.approx(plain(rows[5:])["rmse_mm"])
    assert found["jitter_mm"] == pytest.approx(plain(rows[5:])["jitter_mm"])
    (note,) = evaluation.notes
    assert "5 of 81 samples" in note
    assert note.endswith("; grid points without any position: 1 of 27")
    none = write_csv(path, [row | UNSEEN for row in rows])
    assert "sensor 'tip', environment 'ideal': all samples are missing" in refusal(none)


UNSEEN = {"x_mm": None, "y_mm": None, "z_mm": None}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"x_mm": None}, "line 9: x_mm, y_mm, z_mm: must all have values, or all be empty"),
        ({"z_mm": float("inf")}, "line 9: x_mm, y_mm, z_mm: must be at most 10000 mm"),
        ({"y_mm": -3.697314e28}, "line 9: x_mm, y_mm, z_mm: must all have values"),
        ({"true_y_mm": None}, "line 9: true_x_mm, true_y_mm, true_z_mm: must have values"),
        ({"true_y_mm": 7.5}, "line 9: the true position of a point_id changes by more than 0.001 mm"),
        (UNSEEN | {"true_x_mm": 99.0}, "line 9: the true position of a point_id changes"),
        ({"indicator": -1.0}, "line 9: indicator: must be from 0 to 1e+06, or empty"),
        ({"indicator": 1.1e6}, "line 9: indicator: must be from 0 to 1e+06"),
        ({"environment": "None"}, "line 9: environment is empty"),
        ({"point_id": ""}, "line 9: point_id is empty"),
        ({"qw": 1.0}, "qw, qx, qy, qz: the table must have all four columns"),
        ({"qw": 1.0, "qx": None, "qy": 0.0, "qz": 0.0}, "line 9: qw, qx, qy, qz: must all have values"),
        ({"qw": 0.9, "qx": 0.0, "qy": 0.0, "qz": 0.0}, "line 9: qw, qx, qy, qz: must be a unit quaternion"),
    ],
)
def test_a_row_that_violates_a_rule_is_named(tmp_path, rows, change, expected):
    rows = [row | dict.fromkeys(change.keys() - row.keys()) for row in rows]
    rows[7] |= change
    assert expected in refusal(write_csv(tmp_path / "t.csv", rows))


def test_equal_rows_are_separate_samples_and_point_ids_may_be_any_text(tmp_path, rows):
    for name in ("--1", "²", "- 1"):
        renamed = [row | {"point_id": name if row["point_id"] == 0 else row["point_id"]} for row in rows]
        found = one(write_csv(tmp_path / "t.csv", [*renamed, *renamed]))
        assert found["n_samples"] == 2 * len(rows)
        for key, value in plain(rows).items():
            assert found[key] == pytest.approx(value)


def test_one_sample_at_each_point_gives_no_jitter(tmp_path, rows):
    single = list({row["point_id"]: row for row in rows}.values())
    oriented = [{**row, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0} for row in single]
    found = one(write_csv(tmp_path / "t.csv", oriented))
    assert found["rmse_mm"] == pytest.approx(plain(single)["rmse_mm"])
    unknown = [found["jitter_mm"], *(found["orientation"][name] for name in ("jitter_deg", "worst_deg"))]
    assert np.isnan(unknown).all()
    assert found["intervals"]["jitter_mm"] is None
    found = one(write_csv(tmp_path / "t.csv", single + rows[:1]))
    assert found["jitter_mm"] == pytest.approx(plain(single + rows[:1])["jitter_mm"])


def test_the_first_of_many_invalid_rows_is_named(tmp_path, rows):
    for value, expected in (("?", "y_mm: '?' is not a number"), (1e9, "x_mm, y_mm, z_mm: must be at most")):
        many = [dict(row) for row in rows * 400]
        for row in many[20_000:]:
            row["y_mm"] = value
        assert f"line 20002: {expected}" in refusal(write_csv(tmp_path / "t.csv", many))


@pytest.mark.parametrize("name", ["a*b.csv", "a[1].csv", "it's.csv", "a?.parquet"])
def test_a_file_may_have_any_name(tmp_path, rows, name):
    for other in ("aXb.csv", "a1.csv", "aX.parquet"):
        (tmp_path / other).write_text("no table")
    path = tmp_path / name
    if path.suffix == ".csv":
        write_csv(path, rows)
    else:
        pq.write_table(pa.Table.from_pylist(rows), path)
    assert one(path)["n_samples"] == len(rows)


def test_a_missing_or_truncated_file_is_refused(tmp_path, rows):
    assert "cannot be read: No such file" in refusal(tmp_path / "nowhere.csv")
    assert "cannot be read" in refusal(tmp_path)
    path = write_csv(tmp_path / "t.csv", rows)
    path.write_text(path.read_text()[:-20])
    assert "line 82: has fewer fields than the header" in refusal(path)
    pq.write_table(pa.Table.from_pylist(rows), path)
    whole = path.read_bytes()
    for part in (10, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:part])
        assert "is a truncated or damaged Parquet file" in refusal(path)


def test_a_parquet_table_may_have_integers_categories_and_a_null_indicator_but_no_text_for_numbers(
    tmp_path, rows
):
    for change, kind in (({"x_mm": "left"}, "VARCHAR"), ({"indicator": True}, "BOOLEAN")):
        pq.write_table(pa.Table.from_pylist([row | change for row in rows]), tmp_path / "t.parquet")
        message = refusal(tmp_path / "t.parquet")
        assert f"{next(iter(change))}: must be a column of numbers, not of {kind}" in message
    table = pa.Table.from_pylist(rows)
    for name, column in (
        ("true_x_mm", table["true_x_mm"].cast(pa.int16())),
        ("sensor", table["sensor"].dictionary_encode()),
        ("environment", table["environment"].cast(pa.binary())),
        ("indicator", pa.nulls(len(rows))),
    ):
        table = table.set_column(table.schema.get_field_index(name), name, column)
    pq.write_table(table, tmp_path / "t.parquet")
    found = one(tmp_path / "t.parquet")
    assert found["rmse_mm"] == pytest.approx(plain(rows)["rmse_mm"])
    assert (found["sensor"], found["environment"], found["indicator"]) == ("tip", "ideal", None)
