"""Conversion of frames to rows and back."""

import csv

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.tracker_recording import COLUMNS, read_frames, rows_of
from flexneedle.types import Frame, SensorReading

MEASURED = SensorReading((0.1 + 0.2, -20.0, -200.0), (0.5, -0.5, 0.5, -0.5), 0.0239)
FRAMES = (
    Frame(0.1, 4, {"tip": MEASURED, "ref1": SensorReading(None, status="out of volume")}),
    Frame(0.125, 5, {"tip": SensorReading((1.0, 2.0, 3.0)), "ref1": MEASURED}),
)


@pytest.fixture
def table(tmp_path):
    """Return a function that writes rows as CSV or Parquet."""

    def write(rows, suffix=".csv", columns=COLUMNS):
        path = tmp_path / f"recorded{suffix}"
        if suffix == ".parquet":
            import pyarrow as pa
            from pyarrow import parquet

            parquet.write_table(pa.Table.from_pylist(rows), path)
            return path
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        return path

    return write


ROWS = [row for frame in FRAMES for row in rows_of(frame)]
ZEROS = dict.fromkeys(("qw", "qx", "qy", "qz"), 0.0)
FAR = dict.fromkeys(("x_mm", "y_mm", "z_mm"), 1e30)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("code", [dict.fromkeys(ZEROS, 0.0), {"x_mm": -3.697314e28}])
def test_codes_for_missing_samples_are_missing(table, suffix, code):
    rows = [row | dict.fromkeys(("x_mm", "y_mm", "z_mm"), code.get("x_mm", 0.0)) | code for row in ROWS[:1]]
    (frame,) = read_frames(table(rows, suffix))
    assert frame.readings["tip"].position is None
    assert frame.readings["tip"].status == "missing"


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_frames_are_restored_to_the_last_digit(table, suffix):
    assert read_frames(table(ROWS, suffix)) == FRAMES


def test_a_table_of_measurements_without_status_can_be_read(table):
    columns = ("sensor", "x_mm", "y_mm", "z_mm", "time_s", "frame_number", "point_id")
    frames = read_frames(table([{"point_id": 1, **row} for row in ROWS], columns=columns))
    assert frames[0].readings["tip"].position == MEASURED.position
    assert frames[0].readings["ref1"].status == "missing"


@pytest.mark.parametrize("status", ["out of volume", "MISSING", "missing", "BAD_FIT"])
def test_a_position_with_a_bad_status_is_not_used(table, status):
    (frame,) = read_frames(table([{**ROWS[0], "status": status}]))
    assert (frame.readings["tip"].position, frame.readings["tip"].status) == (None, status)


@pytest.mark.parametrize("status", ["OK", "", "none"])
def test_a_position_counts_with_the_status_ok_or_none(table, status):
    (frame,) = read_frames(table([{**ROWS[0], "status": status}]))
    assert frame.readings["tip"] == MEASURED


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x_mm": 1.0, "status": "ok"}, "line 3: x_mm, y_mm, z_mm: must all have values"),
        (FAR | {"status": "ok"}, "line 3: x_mm, y_mm, z_mm: must be at most 10000 mm"),
        (
            dict.fromkeys(("x_mm", "y_mm", "z_mm"), 1.0) | ZEROS | {"status": "ok"},
            "line 3: qw, qx, qy, qz: must be a unit",
        ),
        ({"indicator": "inf"}, "line 3: indicator: must be from 0"),
        ({"qx": 1.0}, "line 3: qw, qx, qy, qz: must all have values"),
        ({"sensor": "tip"}, "line 3: duplicate sensor tip in frame 4"),
        ({"time_s": 0.01}, "frame 4: time_s must not decrease"),
    ],
)
def test_a_damaged_recording_is_rejected_in_one_line(table, change, message):
    rows = [ROWS[0], {**ROWS[1], **change}, *ROWS[2:]]
    with pytest.raises(InputError, match=message) as refusal:
        read_frames(table(rows))
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_a_recording_is_rejected(table, tmp_path):
    for path, message in (
        (table(ROWS, columns=("time_s", "sensor", "x_mm", "y_mm", "z_mm")), "no column frame_number"),
        (tmp_path / "nothing.csv", "cannot be read: No such file"),
    ):
        with pytest.raises(InputError, match=message):
            read_frames(path)
