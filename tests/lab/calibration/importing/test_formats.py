"""Recordings in every format give the same session."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rosbags.rosbag2 import StoragePlugin
from scipy.io import savemat

from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.columns import to_seconds
from recorded_bags import header, message, point, turn, write_bag
from recorded_insertions import PLAIN, assert_steps, columns, guided, load, write_csv

PATH = guided()
TABLE = columns(PATH)
POSE = {
    "tip": {"position": [f"/tip.pose.position.{axis}" for axis in "xyz"], "unit": "m",
            "quaternion": [f"/tip.pose.orientation.{axis}" for axis in "xyzw"], "sensor_axis": "x"},
    "guide": {"y": "/joints.position[guide_y]", "z": "/joints.position[2]", "unit": "m"},
}  # fmt: skip


@pytest.mark.parametrize(
    "how",
    [
        {"separator": "\t"},
        {"separator": ";", "decimal": ","},
        {"separator": " "},
        {"separator": " ", "before": "# "},
        {"separator": " ; "},
        {"before": "\ufeff"},
        {"before": "sep=,\n"},
        {"before": "# gel 3\n% needle, 18G\n\n"},
        {"before": "Gel 3, recorded on Monday\nOperator: A, B\n\n"},
        {"before": "%"},
        {"after": "\n\n"},
        {"after": "# the end\n"},
    ],
    ids=repr,
)
def test_text_tables(tmp_path, how):
    imported = load(write_csv(tmp_path / "gel.csv", TABLE, **how))
    assert_steps(imported.session.recordings[0], PATH)
    np.testing.assert_allclose(imported.session.recordings[0].slope, PATH.slope, atol=1e-9)


def test_units_after_the_header_and_names_with_units(tmp_path):
    table = {f"{name} [mm]": ["(mm)", *values] for name, values in TABLE.items()}
    tip = {"position": ["x [mm]", "y [mm]", "z [mm]"]}
    guide = {"y": "gy [mm]", "z": "gz [mm]"}
    file = write_csv(tmp_path / "gel.csv", table)
    assert_steps(
        load(file, tip=tip, guide=guide, table={"lines_after_header": 1}).session.recordings[0], PATH
    )


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16"])
def test_other_encodings(tmp_path, encoding):
    table = {f"{name} [µm]": 1e3 * values for name, values in TABLE.items()}
    file = write_csv(tmp_path / "gel.csv", table, separator=";", decimal=",")
    file.write_bytes(file.read_text(encoding="utf-8").encode(encoding))
    tip = {"position": ["x [µm]", "y [µm]", "z [µm]"], "unit": "um"}
    imported = load(file, tip=tip, guide={"y": "gy [µm]", "z": "gz [µm]", "unit": "um"})
    assert_steps(imported.session.recordings[0], PATH)
    assert imported.suspected == ()


def test_the_export_of_a_bag_begins_with_a_percent_sign(tmp_path):
    table = {"%time": 10**9 * np.arange(18)} | {f"field.pose.position.{a}": TABLE[a] for a in "xyz"}
    tip = {"position": [f"field.pose.position.{a}" for a in "xyz"]}
    echo = load(
        write_csv(tmp_path / "a.csv", table), tip=tip, guide=None, time={"columns": ["%time"], "unit": "ns"}
    )
    np.testing.assert_allclose(echo.session.recordings[0].time, np.arange(18.0))
    np.testing.assert_allclose(echo.session.recordings[0].position, PATH.position)


@pytest.mark.parametrize("code", ["0", "-999"])
def test_a_code_for_a_missing_position(tmp_path, code):
    table = {name: [*map(str, values + (100.0 if name == "x" else 0.0))] for name, values in TABLE.items()}
    for name in "xyz":
        table[name][5] = code
    found = load(write_csv(tmp_path / "a.csv", table), table={"missing": [0, -999]}).session.recordings[0]
    assert len(found.depth) == 17
    np.testing.assert_allclose(found.guide, np.delete(PATH.guide, 5, axis=0))


def test_a_table_without_a_header(tmp_path):
    file = tmp_path / "gel.txt"
    np.savetxt(file, np.column_stack([*TABLE.values()]))
    assert_steps(load(file, table={"columns": [*TABLE]}).session.recordings[0], PATH)
    with pytest.raises(InputError, match=r"has 9 columns, and .* names 8"):
        load(file, table={"columns": [*TABLE][1:]})


def test_sensors_side_by_side_with_the_same_names(tmp_path):
    other = [f"{value}" for value in np.random.default_rng(0).normal(size=len(PATH.depth))]
    header, *rows = write_csv(tmp_path / "gel.csv", TABLE).read_text().splitlines()
    lines = [
        f"x,y,z,{header}",
        *(f"{value},{value},{value},{row}" for value, row in zip(other, rows, strict=True)),
    ]
    file = tmp_path / "two.csv"
    file.write_text("\n".join(lines))
    assert_steps(load(file, tip={"position": ["x[2]", "y[2]", "z[2]"]}).session.recordings[0], PATH)
    with pytest.raises(InputError, match=r"two\.csv: has 2 columns 'x': choose one as 'x\[1\]' to 'x\[2\]'"):
        load(file)


def test_sensors_one_below_the_other_and_a_status(tmp_path):
    table = {name: np.repeat(values, 2) for name, values in TABLE.items()}
    size = len(table["x"])
    table["sensor"] = np.resize(["tip", "base"], size)
    table["x"] = np.where(table["sensor"] == "base", 999.0, table["x"])
    table["State"] = ["OK"] * (size - 2) + ["Missing"] * 2
    tip = PLAIN["tip"] | {"status": "State"}
    imported = load(write_csv(tmp_path / "a.csv", table), tip=tip, table={"where": {"sensor": "tip"}})
    assert len(imported.session.recordings[0].depth) == len(PATH.depth) - 1
    assert "5.56 % of the rows without a position" in imported.understood[0]


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "NA", "MISSING", "-3.697314e28", "-999", "null"])
def test_missing_positions_are_left_out(tmp_path, missing):
    table = {name: [*map(str, values)] for name, values in TABLE.items()}
    for name in "xyz":
        table[name][5] = missing
    found = load(write_csv(tmp_path / "a.csv", table), table={"missing": [-999]}).session.recordings[0]
    np.testing.assert_allclose(found.depth, np.delete(PATH.depth, 5), atol=1e-9)


def test_parquet(tmp_path):
    pq.write_table(pa.table(TABLE | {"gy": pa.array([*map(str, TABLE["gy"])])}), tmp_path / "gel.parquet")
    assert_steps(load(tmp_path / "gel.parquet").session.recordings[0], PATH)


def test_matlab_vectors_matrices_and_structs(tmp_path):
    variables = {"tip": {"p": PATH.points, "axis": PATH.axis}, "guide": PATH.guide, "gauge": 18.0}
    savemat(tmp_path / "gel.mat", variables)
    tip = {"position": [f"tip.p[{k}]" for k in (1, 2, 3)], "axis": [f"tip.axis[{k}]" for k in (1, 2, 3)]}
    guide = {"y": "guide[1]", "z": "guide[2]"}
    assert_steps(load(tmp_path / "gel.mat", tip=tip, guide=guide).session.recordings[0], PATH)


def test_matlab_struct_arrays_are_insertions(tmp_path):
    paths = [guided(seed=1), guided(steps=12, seed=2)]
    trials = np.array([columns(path) for path in paths])
    savemat(tmp_path / "gel.mat", {"trials": trials})
    named = {
        "tip": {"position": ["trials.x", "trials.y", "trials.z"]},
        "guide": {"y": "trials.gy", "z": "trials.gz"},
    }
    found = load(tmp_path / "gel.mat", **named, table={"insertion": ["trials"]}).session.recordings
    assert [one.name for one in found] == ["1", "2"]
    for one, path in zip(found, paths, strict=True):
        assert_steps(one, path)


def poses():
    names, empty = ["guide_y", "guide_z"], np.zeros(0)
    for k, at in enumerate(PATH.points):
        moved = 1e-3 * PATH.guide[k]
        joints = message(
            "sensor_msgs/msg/JointState",
            header=header(k),
            name=names,
            position=moved,
            velocity=empty,
            effort=empty,
        )
        yield 10.0 * k, "/joints", joints
        pose = message("geometry_msgs/msg/Pose", position=point(1e-3 * at), orientation=turn(PATH.axis[k]))
        yield 10.0 * k + 5.0, "/tip", message("geometry_msgs/msg/PoseStamped", header=header(k), pose=pose)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_bags_of_poses(tmp_path, storage):
    folder = write_bag(tmp_path / "gel", storage, poses())
    (inner,) = [path for path in folder.iterdir() if path.suffix != ".yaml"]
    for path in (folder, inner):
        (found,) = load(path, **POSE).session.recordings
        assert_steps(found, PATH)
        np.testing.assert_allclose(found.slope, PATH.slope, atol=1e-9)
        np.testing.assert_allclose(found.time, 10.0 * np.arange(len(PATH.depth)) + 5.0)


def test_bags_of_points_and_of_transforms(tmp_path):
    def messages():
        for k, at in enumerate(PATH.points):
            yield k, "/tip", message("geometry_msgs/msg/PointStamped", header=header(k), point=point(at))
            for child, values in (("needle", at), ("skin", np.zeros(3))):
                shift = message("geometry_msgs/msg/Vector3", **dict(zip("xyz", values, strict=True)))
                still = message("geometry_msgs/msg/Transform", translation=shift, rotation=turn(PATH.axis[k]))
                transform = message(
                    "geometry_msgs/msg/TransformStamped",
                    header=header(k),
                    child_frame_id=child,
                    transform=still,
                )
                yield k + 0.1, "/tf", message("tf2_msgs/msg/TFMessage", transforms=[transform])

    folder = write_bag(tmp_path / "gel", StoragePlugin.SQLITE3, messages())
    for opening in ("/tip.point", "/tf.transforms[needle].transform.translation"):
        (found,) = load(
            folder, tip={"position": [f"{opening}.{axis}" for axis in "xyz"]}, guide=None
        ).session.recordings
        np.testing.assert_allclose(found.depth, PATH.depth, atol=1e-9)
        np.testing.assert_allclose(found.position, PATH.position, atol=1e-9)


@pytest.mark.parametrize(
    ("times", "section"),
    [
        ({"t": 10.0 + np.arange(18)}, {"columns": ["t"]}),
        ({"t": 1000 * np.arange(18)}, {"columns": ["t"], "unit": "ms"}),
        ({"s": [1664971234] * 18, "n": [*range(10**6, 19 * 10**6, 10**6)]}, {"columns": ["s", "n"]}),
        ({"t": [f"2022-10-05T12:00:{k:02}.5" for k in range(18)]}, {"columns": ["t"]}),
        ({"t": [f"2022-10-05 12:00:{k:02}Z" for k in range(18)]}, {"columns": ["t"]}),
        ({"t": [f"2022-10-05T12:00:{k:02}.123456789+02:00" for k in range(18)]}, {"columns": ["t"]}),
        ({"t": [f"12:00:{k:02}.250" for k in range(18)]}, {"columns": ["t"]}),
        ({"d": ["2022-10-05"] * 18, "t": [f"12:00:{k:02}" for k in range(18)]}, {"columns": ["d", "t"]}),
    ],
    ids=lambda value: "-".join(map(str, value.get("columns", value))),
)
def test_times(tmp_path, times, section):
    table = {name: values for name, values in TABLE.items() if name != "t"} | times
    (found,) = load(write_csv(tmp_path / "a.csv", table), time=section).session.recordings
    step = 1e-3 if "s" in times else 1.0
    np.testing.assert_allclose(np.diff(found.time), step, atol=1e-6)


def test_a_time_of_day_in_seconds():
    times = to_seconds("t", np.array(["01:02:03.5", "", "01:02:03,5"], dtype=object), 1.0)
    np.testing.assert_allclose(times, [3723.5, np.nan, 3723.5])
