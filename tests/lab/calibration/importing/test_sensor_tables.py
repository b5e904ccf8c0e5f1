"""Tables of sensors along the needle: beside the tip's, in its file, in bags and in runs; and what is refused."""

import dataclasses

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
from pyarrow.parquet import read_table, write_table
from rosbags.rosbag2 import StoragePlugin

import flexneedle
from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.importer import import_recordings
from flexneedle.lab.calibration.readings import StepReading
from flexneedle.lab.calibration.session import load_session
from import_command import run_import
from recorded_bags import header, message, point, write_bag
from recorded_insertions import PLAIN, columns, guided, load, write_csv
from synthetic import make_insertion
from synthetic_sensors import EXCLUDED_FROM, with_sensors

PATH = guided(seed=4)
TABLE = columns(PATH)
STEPS = np.arange(len(PATH.depth))
TIME = {"columns": ["t"]}
CURVED = np.stack([0.5 + 0.01 * STEPS, -0.2 + 0 * STEPS, 1.5 + 0 * STEPS, 0.02 * STEPS], axis=1)  # 1/m
FBG = {"name": "fbg", "file": "{name}_fbg.csv", "curvature": ["k1y", "k1z", "k2y", "k2z"]}


def fbg_table(times, unit=1.0):
    """Return curvatures at times after each step, by column."""
    values = {name: np.repeat(unit * CURVED[:, k], len(times)) for k, name in enumerate(FBG["curvature"])}
    return {"t": (10.0 * STEPS[:, None] + times).ravel(), **values}


def rows_of(recording, step):
    return [np.array(each.rows) for each in recording.readings if each.step == step]


def test_a_table_beside_the_tips_has_the_readings_at_rest(tmp_path):
    tip = write_csv(tmp_path / "a.csv", TABLE)
    write_csv(tmp_path / "a_fbg.csv", fbg_table([-0.4, 0.0, 0.3, 4.0]))  # the last one is in motion
    imported = load(*tmp_path.glob("*.csv"), time=TIME, sensor=[FBG])
    (found,) = imported.session.recordings
    assert found.name == tip.stem
    assert len(found.readings) == 3 * len(STEPS)
    for step in (0, 7):
        for rows in rows_of(found, step):
            np.testing.assert_allclose(rows, 1e-3 * CURVED[step].reshape(2, 2))
    assert f"readings of fbg at {len(STEPS)} steps in 1 of 1 insertions" in imported.understood


def test_parquet_in_1_per_mm_with_milliseconds(tmp_path):
    write_csv(tmp_path / "a.csv", TABLE)
    table = fbg_table([0.1], unit=1e-3)
    pq.write_table(pa.table(table | {"t": 1e3 * table["t"]}), tmp_path / "a_fbg.parquet")
    given = FBG | {"file": "{name}_fbg.parquet", "curvature_unit": "1/mm", "time": TIME | {"unit": "ms"}}
    (found,) = load(tmp_path / "a.csv", time=TIME, sensor=[given]).session.recordings
    np.testing.assert_allclose(rows_of(found, 5), [1e-3 * CURVED[5].reshape(2, 2)])


def test_curvatures_may_be_in_the_tips_file_and_a_minus_inverts_them(tmp_path):
    file = write_csv(tmp_path / "a.csv", TABLE | fbg_table([0.0]))
    given = {"name": "fbg", "curvature": ["k1y", "-k1z", "k2y", "k2z"]}
    (found,) = load(file, time=TIME, sensor=[given]).session.recordings
    np.testing.assert_allclose(rows_of(found, 3), [1e-3 * (CURVED[3] * [1, -1, 1, 1]).reshape(2, 2)])


def test_points_are_in_the_frame_of_the_needle_and_those_of_one_time_are_a_reading(tmp_path):
    """The tracker's z is the insertion, its x is y; skin and first tip are the origin."""
    first = np.array([20.0, -30.0, 100.0])  # of the tip, in the tracker's axes
    x, y, z = TABLE["y"] + first[0], TABLE["z"] + first[1], TABLE["x"] + first[2]
    file = write_csv(tmp_path / "a.csv", {"t": TABLE["t"], "x": x, "y": y, "z": z})
    dots = first + np.array([[0.5, 0.1, 8.0], [0.7, 0.2, 30.0]])
    rows = np.vstack([np.column_stack([[10.0 * k] * 2, dots]) for k in (4, 5)])
    write_csv(tmp_path / "ct" / "a.csv", dict(zip("tabc", rows.T, strict=True)))
    given = {"name": "ct", "file": "ct/{name}{suffix}", "position": ["a", "b", "c"]}
    frame = {"x": "z", "y": "x", "skin_mm": 95.0}
    tip = {"position": ["x", "y", "z"]}
    (found,) = load(file, tip=tip, guide=None, frame=frame, time=TIME, sensor=[given]).session.recordings
    assert [each.step for each in found.readings] == [4, 5]
    np.testing.assert_allclose(found.readings[0].rows, [[13.0, 0.5, 0.1], [35.0, 0.7, 0.2]], atol=1e-9)


def test_a_bag_has_curvatures_as_a_list(tmp_path):
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    topics = []
    for k, at in enumerate(PATH.points):
        tip = message("geometry_msgs/msg/PointStamped", header=header(k), point=point(at))
        bent = message("std_msgs/msg/Float64MultiArray", layout=layout, data=1e-3 * CURVED[k])
        topics += [(10.0 * k, "/tip", tip), (10.0 * k + 0.2, "/curvatures", bent)]
    bag = write_bag(tmp_path / "gel", StoragePlugin.MCAP, topics)
    names = [f"/curvatures.data[{k}]" for k in range(1, 5)]
    given = {"name": "fbg", "curvature": names, "curvature_unit": "1/mm"}
    tip = {"position": [f"/tip.point.{axis}" for axis in "xyz"]}
    (found,) = load(bag, tip=tip, guide=None, sensor=[given]).session.recordings
    np.testing.assert_allclose(rows_of(found, 6), [1e-3 * CURVED[6].reshape(2, 2)])


def test_runs_have_the_readings_that_corrected_the_model(tmp_path):
    done = dataclasses.replace(with_sensors(make_insertion()), scenario=flexneedle.load_scenario("phantom"))
    flexneedle.save(done, tmp_path / "run")
    (found,) = import_recordings([tmp_path / "run"]).session.recordings
    fibre = [each.rows for each in found.readings if each.sensor == "fbg"]
    expected = [state.readings[0].reading.rows for state in (one.sensors[0] for one in done.periods)]
    assert len(fibre) == EXCLUDED_FROM
    for rows, each in zip(fibre, expected, strict=False):
        np.testing.assert_array_equal(rows, each)
    assert "slice" in {each.sensor for each in found.readings}


@pytest.mark.parametrize(
    ("changes", "table", "line"),
    [
        ({}, None, "a_fbg.csv: "),
        ({}, {"t": [0.0], "k1y": [1.0]}, "a_fbg.csv: has no column 'k1z'"),
        ({}, {name: ["x"] for name in ("t", *FBG["curvature"])}, "a_fbg.csv: line 2: k1y: "),
        ({"curvature": ["k1y", "k1z", "k2y"]}, {}, "curvature"),
        ({"position": ["x", "y", "z"]}, {}, "pixels"),
        ({"curvature": (), "position": ["x", "y"]}, {}, "position"),
        ({"within_s": -1.0}, {}, "within_s = -1.0"),
        ({"tip": "x"}, {}, "tip"),
    ],
)
def test_a_malformed_sensor_is_one_line(tmp_path, capsys, changes, table, line):
    write_csv(tmp_path / "a.csv", TABLE)
    if table is not None:
        write_csv(tmp_path / "a_fbg.csv", table or fbg_table([0.0]))
    given = PLAIN | {"time": TIME, "sensor": [FBG | changes]}
    (tmp_path / "map.toml").write_text(tomli_w.dumps(given))
    out = tmp_path / "session"
    status, _, err = run_import(
        capsys, str(tmp_path / "a.csv"), "--map", str(tmp_path / "map.toml"), "--out", str(out)
    )
    assert status == 2
    assert line in err
    assert err.count("\n") == 1
    assert not out.exists()


def test_a_sensor_needs_times_and_a_clock_apart_is_suspicious(tmp_path):
    file = write_csv(tmp_path / "a.csv", TABLE)
    write_csv(tmp_path / "a_fbg.csv", fbg_table([5.0]))
    imported = load(file, time=TIME, sensor=[FBG])
    assert any("no reading of fbg within 0.5 s of a step" in line for line in imported.suspected)
    with pytest.raises(InputError, match="needs the time of each row"):
        load(file, sensor=[FBG])


@pytest.fixture
def saved(tmp_path):
    write_csv(tmp_path / "a.csv", TABLE)
    write_csv(tmp_path / "a_fbg.csv", fbg_table([0.0, 0.1]))
    imported = load(tmp_path / "a.csv", time=TIME, sensor=[FBG])
    imported.session.save(tmp_path)
    return tmp_path, imported.session


def test_a_session_keeps_the_readings(saved):
    folder, session = saved
    (before,), (after,) = session.recordings, load_session(folder).recordings
    assert after.readings == before.readings
    assert {each.step for each in after.first(4).readings} == {0, 1, 2, 3}
    bare = dataclasses.replace(session, recordings=(dataclasses.replace(before, readings=()),))
    bare.save(folder)
    assert load_session(folder).recordings[0].readings == ()


def test_rows_of_other_lengths_and_lost_sites_are_kept(saved):
    folder, session = saved
    rows = ((8.0, 0.5, 0.1), (30.0, 0.7, 0.2)), ((0.1, 0.2), (np.nan, np.nan))
    readings = tuple(StepReading(name, 2, each) for name, each in zip(("ct", "fbg"), rows, strict=True))
    one = dataclasses.replace(session.recordings[0], readings=readings)
    dataclasses.replace(session, recordings=(one,)).save(folder)
    found = load_session(folder).recordings[0].readings
    for each, expected in zip(found, rows, strict=True):
        np.testing.assert_array_equal(each.rows, expected)


@pytest.mark.parametrize(
    ("column", "values", "line"),
    [
        ("sensor", None, "has no column 'sensor'"),
        ("step", 99, "fbg: session .*, insertion a, step 99: is not in the steps"),
        ("insertion", "b", "insertion b, step 0: is not in the steps"),
        ("value_1", np.inf, "step 0: must be finite"),
        ("value_1", "x", "could not convert string to float"),
    ],
)
def test_a_damaged_table_of_readings_is_one_line(saved, column, values, line):
    folder, _ = saved
    file = folder / "readings.parquet"
    rows = read_table(file).drop_columns(column)
    if values is not None:
        rows = rows.append_column(column, pa.array([values] * len(rows)))
    write_table(rows, file)
    with pytest.raises(InputError, match=line):
        load_session(folder)
