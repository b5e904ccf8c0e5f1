"""Sessions that are damaged: one line with folder, key or column, and row."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow.parquet import read_table, write_table

from flexneedle.errors import InputError
from flexneedle.lab.calibration.session import Session, load_session
from simulated_session import blank

DEPTH = 5.0 * np.arange(4)


@pytest.fixture
def folder(tmp_path):
    """A sound session in the plane with two insertions of four steps."""
    blanks = (blank("a", name, np.zeros((4, 1)), DEPTH) for name in "01")
    Session(tuple(blanks), "with").save(tmp_path)
    return tmp_path


def change_key(folder, old, new):
    path = folder / "session.toml"
    path.write_bytes(path.read_bytes().replace(old, new))


def change_column(folder, name, values):
    """Replace a column; without values, remove it."""
    path = folder / "steps.parquet"
    rows = read_table(path).drop_columns(name)
    write_table(rows if values is None else rows.append_column(name, pa.array(values)), path)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (b"with", b"with\xff", "not a session: 'utf-8' codec"),
        (b"axes = 1", b"axes = ", "not a session: Invalid value"),
        (b"axes = 1", b'axes = "x"', "session.toml: axes = x: must be 1 or 2"),
        (b"axes = 1", b"axes = 0", "session.toml: axes = 0: must be 1 or 2"),
        (b"axes = 1", b"", "session.toml: axes = None: must be 1 or 2"),
        (b"axes = 1", b"axes = 2", "steps.parquet: has no column 'z_mm'"),
        (b"with", b"during", "session.toml: guide_order = during: must be before or with or after"),
    ],
)
def test_a_damaged_head_is_one_line(folder, old, new, line):
    change_key(folder, old, new)
    with pytest.raises(InputError) as error:
        load_session(folder)
    assert str(error.value).startswith(f"{folder}: {line}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "values", "line"),
    [
        ("x_mm", [0.0, 5.0, np.nan, *5 * [0.0]], "column x_mm, row 3 of 8: nan: must be finite"),
        ("guide_y_mm", [*7 * [0.0], None], "column guide_y_mm, row 8 of 8: nan: must be finite"),
        ("slope_y_rad", [np.inf, *7 * [0.0]], "column slope_y_rad, row 1 of 8: inf: must be finite"),
        ("base_y_mm", 8 * ["1.0"], "column base_y_mm: must have numbers, not object"),
        ("roll_rad", None, "has no column 'roll_rad'"),
        ("insertion", None, "has no column 'insertion'"),
    ],
)
def test_damaged_columns_are_one_line(folder, name, values, line):
    change_column(folder, name, values)
    with pytest.raises(InputError) as error:
        load_session(folder)
    assert str(error.value) == f"{folder}: steps.parquet: {line}"


def test_times_and_slopes_may_be_unknown_and_numbers_may_be_whole(folder):
    for name in ("time_s", "slope_y_rad"):
        change_column(folder, name, 8 * [np.nan])
    change_column(folder, "x_mm", [0, 5, 10, 15] * 2)
    first, second = load_session(folder).recordings
    assert np.isnan(first.time).all()
    assert np.isnan(second.slope).all()
    np.testing.assert_array_equal(second.depth, DEPTH)


def test_a_table_without_rows_is_refused(folder):
    path = folder / "steps.parquet"
    write_table(read_table(path)[:0], path)
    with pytest.raises(InputError, match="has no rows"):
        load_session(folder)
