"""Files of measurements: damaged, truncated, with other separators and line ends; CSV and Parquet."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from em_tables import one, plain, refusal, write_csv


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "is empty"),
        ("point_id,x_mm\n", "has no rows"),
        ("\n\n", "has no line with column names"),
        ("\0\1\2\n3", "neither"),
    ],
)
def test_a_file_without_a_table_is_refused(tmp_path, text, expected):
    path = tmp_path / "t.csv"
    path.write_text(text)
    assert expected in refusal(path)


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    assert "cannot be read: No such file" in refusal(tmp_path / "nowhere.csv")
    assert "cannot be read" in refusal(tmp_path)


def test_a_csv_file_truncated_before_the_last_field_is_refused(tmp_path, rows):
    path = write_csv(tmp_path / "t.csv", rows)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], lines[-1][:30]]))
    assert f"line {len(lines)}: has fewer fields than the header" in refusal(path)


def test_the_first_of_many_invalid_rows_is_named(tmp_path, rows):
    some = [dict(row) for row in rows]
    some[4]["z_mm"], some[8]["true_x_mm"] = "?", "!"
    assert "line 6: z_mm: '?' is not a finite number" in refusal(write_csv(tmp_path / "t.csv", some))
    many = [dict(row) for row in rows * 400]
    for row in many[20_000:]:
        row["y_mm"] = "?"
    assert "line 20002: y_mm: '?' is not a finite number" in refusal(write_csv(tmp_path / "t.csv", many))
    for row in many[20_000:]:
        row["y_mm"] = 1e9
    assert "line 20002: x_mm, y_mm, z_mm: must be at most" in refusal(write_csv(tmp_path / "t.csv", many))


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


def test_a_last_line_without_a_line_end_is_used(tmp_path, rows):
    path = write_csv(tmp_path / "t.csv", rows)
    path.write_bytes(path.read_bytes()[:-1])
    assert one(path)["n_samples"] == len(rows)


def test_a_truncated_line_followed_by_others_is_refused(tmp_path, rows):
    path = write_csv(tmp_path / "t.csv", rows)
    lines = path.read_text().splitlines()
    lines[40] = lines[40][:30]
    path.write_text("\n".join(lines) + "\n")
    assert f"line 41: has fewer fields than the header: '{lines[40]}'" in refusal(path)
    lines[40] = lines[39] + ",7"
    path.write_text("\n".join(lines) + "\n")
    assert "line 41: has more fields than the header" in refusal(path)


def test_a_truncated_parquet_file_is_refused(tmp_path, rows):
    path = tmp_path / "t.parquet"
    pq.write_table(pa.Table.from_pylist(rows), path)
    whole = path.read_bytes()
    for part in (10, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:part])
        assert "is a truncated or damaged Parquet file" in refusal(path)


def test_a_parquet_column_of_text_is_refused_for_numbers(tmp_path, rows):
    path = tmp_path / "t.parquet"
    pq.write_table(pa.Table.from_pylist([{**row, "x_mm": "left"} for row in rows]), path)
    assert "x_mm: must be a column of numbers, not of VARCHAR" in refusal(path)
    pq.write_table(pa.Table.from_pylist([{**row, "indicator": True} for row in rows]), path)
    assert "indicator: must be a column of numbers, not of BOOLEAN" in refusal(path)


def test_semicolons_tabs_a_byte_order_mark_and_crlf_are_read(tmp_path, rows):
    expected = plain(rows)["rmse_mm"]
    for delimiter in (";", "\t"):
        path = write_csv(tmp_path / "t.csv", rows, delimiter=delimiter)
        assert one(path)["rmse_mm"] == pytest.approx(expected)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert one(path)["rmse_mm"] == pytest.approx(expected)


def test_mixed_line_ends_are_refused_with_the_remedy(tmp_path, rows):
    path = write_csv(tmp_path / "t.csv", rows)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n", 40))
    assert "line 41: another line end (LF or CRLF) than before: save the file with one kind" in refusal(path)


def test_a_parquet_table_may_have_integers_categories_and_a_null_indicator(tmp_path, rows):
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
