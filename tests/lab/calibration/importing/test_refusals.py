"""Malformed and contradictory recordings and maps: one line with subject, value and rule, status 2, nothing written."""

import gzip
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
from scipy.io import savemat

from import_command import run_import
from recorded_insertions import PLAIN, columns, guided, write_csv

TABLE = columns(guided())
TIP, GUIDE = PLAIN["tip"], PLAIN["guide"]
QUATERNION = {"position": ["x", "y", "z"], "quaternion": ["ax", "ay", "az", "gy"]}
FIDUCIALS = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def changed(**cells):
    """Return the table with other cells: values by row number."""
    table = {name: [*map(str, values)] for name, values in TABLE.items()}
    for name, values in cells.items():
        for row, value in values.items():
            table[name][row] = value
    return table


def text(content):
    return lambda folder: (folder / "a.csv").write_bytes(
        content if isinstance(content, bytes) else content.encode()
    )


def csv(table, name="a.csv"):
    return lambda folder: write_csv(folder / name, table)


def mat(**variables):
    return lambda folder: savemat(folder / "a.mat", variables)


def parquet(table):
    return lambda folder: pq.write_table(pa.table(table), folder / "a.parquet")


def two(folder):
    for name in ("a.csv", "a.tsv"):
        write_csv(folder / name, TABLE)


def rest(folder):
    (folder / "a").mkdir()
    (folder / "a" / "run.json").write_text(json.dumps({"format": 9}))


GOOD = csv(TABLE)
ONLY_TIP = {"tip": {"position": ["x", "y", "z"]}, "guide": None}
TWICE = {"registration_file": "r", "registration": {"fiducials_mm": FIDUCIALS}}
TWO_DEPTHS = {"skin_mm": 1.0, "first_depth_mm": 2.0}
FLAT = {"tip": {"position": ["x", "y"]}, "frame": {"x": "z"}}
NAMED = {"table": {"insertion": ["n"]}}
STREAM = {"steps": {"rows": "stream"}}

REFUSALS = {
    # Files that cannot be read
    "no file": (lambda _: None, {}, "a.csv: cannot be read: No such file or directory"),
    "empty": (text(""), {}, "a.csv: is empty"),
    "no rows": (text("x,y,z\n"), {}, "a.csv: has no rows, only the header 'x,y,z'"),
    "gzip": (text(gzip.compress(b"x,y,z\n1,2,3\n")), {}, "a.csv: is compressed with gzip: unpack it"),
    "excel": (text(b"PK\x03\x04" + bytes(99)), {}, "a.csv: is an Excel or ZIP file: save it as CSV"),
    "binary": (text(bytes(range(256)) * 9), {}, "a.csv: is neither CSV nor Parquet"),
    "hdf": (text(b"\x89HDF\r\n\x1a\n" + bytes(99)), {}, "version 7.3: save it with the option -v7"),
    "parquet cut": (text(b"PAR1" + bytes(99)), {}, "a.csv: is a truncated or damaged Parquet file"),
    "matlab cut": (text(b"MATLAB 5.0 MAT-file" + bytes(200)), {}, "a.csv: is a damaged MATLAB file"),
    "bag cut": (text(b"\x89MCAP0\r\n" + bytes(50)), {}, "a.csv: is a damaged or unfinished bag"),
    "folder": (lambda folder: (folder / "a").mkdir(), {}, "a: is a folder without metadata.yaml or run.json"),
    "other run": (rest, {}, "run.json: not a run of this version of flexneedle: format must be 1"),
    # Columns
    "missing column": (csv({"X" + k: v for k, v in TABLE.items()}), {}, "has no column 'x'"),
    "misspelt": (GOOD, {"tip": {"position": ["x", "y", "zz"]}}, "has no column 'zz'; did you mean 'z'?"),
    "two of a name": (text("x,x,y,z\n" + 9 * "1,2,3,4\n"), ONLY_TIP, "has 2 columns 'x'"),
    "text": (csv(changed(y={3: "abc"})), {}, "a.csv: line 5: y: 'abc' is not a number"),
    "infinity": (csv(changed(y={3: "inf"})), {}, "a.csv: column 'y', row 4: inf must be a finite number up to 1e+12"),
    "short line": (text("x,y,z\n" + "1,2,3\n" * 5 + "1,2\n"), ONLY_TIP, "line 7: has fewer fields than the header"),
    "decimal commas": (text("x,y,z\n" + "1,5,2,5,3,5\n" * 9), ONLY_TIP, "decimal commas need semicolons or tabs"),
    "time": (csv(TABLE | {"t": ["noon"] * 18}), {"time": {"columns": ["t"]}}, "'noon' is not a number"),
    "matlab rows": (mat(x=np.arange(9), y=np.arange(9), z=np.arange(8)), ONLY_TIP, "has 8 rows, and 'x' has 9"),
    "parquet lists": (parquet(TABLE | {"x": [[1.0]] * 18}), {}, "column 'x'"),
    "no such row": (GOOD, {"table": {"where": {"t": "tip"}}}, "a.csv: no row has t = 'tip'"),
    # Recordings that contradict themselves
    "all missing": (csv(changed(x=dict.fromkeys(range(18), ""))), {}, "no insertion has 4 steps: check the map"),
    "time back": (csv(changed(t={4: "5.0"})), {"time": {"columns": ["t"]}}, "time runs backwards at 30 s"),
    "jump": (csv(changed(y={4: "400"})), {}, "a.csv: the tip jumps by 399.9 mm to (20, 400,"),
    "no advance": (GOOD, {"frame": {"x": "y", "y": "x"}}, "mm along x = y, and more along another axis: check frame.x"),
    "backwards": (GOOD, {"frame": {"x": "-x", "y": "y"}}, "a.csv: the tip advances 0 mm along x = -x"),
    "axis across": (GOOD, {"tip": TIP | {"axis": ["ay", "ax", "az"]}}, "the sensor's axis is 88° off the path"),
    "axis length": (csv(changed(ax={2: "0.5"})), {}, "row 3: the needle's axis must have the length 1, not 0.5"),
    "quaternion length": (GOOD, {"tip": QUATERNION, "guide": None}, "the quaternion must have the length 1"),
    "no times": (GOOD, STREAM, "a.csv: a stream needs the time of each row: set time.columns"),
    "no rests": (GOOD, STREAM | {"time": {"columns": ["t"]}}, "no insertion has 4 steps: check the map"),
    "twice": (two, {}, "insertion a of session"),
    "apart": (csv(TABLE | {"n": [*"aabbaabb", *"c" * 10]}), NAMED, "insertion a: its rows are not together"),
    "no name": (csv(TABLE | {"n": ["", *"a" * 17]}), NAMED, "a.csv: row 1: names no insertion"),
    # Maps that contradict themselves
    "no map": (GOOD, None, "a.csv: is no run folder: give the map of its columns with --map"),
    "no tip": (GOOD, {"tip": None}, "lab.toml: tip: missing"),
    "unit": (GOOD, {"tip": TIP | {"unit": "miles"}}, 'tip.unit = "miles": must be one of mm, cm, m, um, inch'),
    "key": (GOOD, {"tip": TIP | {"units": "mm"}}, "lab.toml: tip.units = \"mm\": unknown key; did you mean unit?"),
    "one column": (GOOD, {"tip": {"position": ["x"]}}, "tip.position = [\"x\"]: must have at least 2 entries"),
    "axis and angle": (GOOD, {"tip": TIP | {"angle": ["gy"]}}, "tip.angle = [\"gy\"]: not beside axis: keep one"),
    "used twice": (GOOD, {"guide": {"y": "x"}}, 'guide.y = "x": is the column of tip.position[0], too'),
    "no side": (GOOD, {"guide": {"unit": "mm"}}, "lab.toml: guide: must have y, z or both; or position alone"),
    "axes": (GOOD, {"frame": {"x": "y", "y": "-y"}}, 'frame.y = "-y": must be another axis than x (y)'),
    "direction": (GOOD, {"frame": {"x": "up"}}, 'frame.x = "up": must be an axis with its sign, "x", "-y" …, or "fit"'),
    "two depths": (GOOD, {"frame": TWO_DEPTHS}, "frame.first_depth_mm = 2.0: not beside skin_mm"),
    "plane and z": (GOOD, FLAT, "frame: x and y must be the axes x and y"),
    "every": (GOOD, {"steps": {"every_mm": 5.0}}, 'steps.every_mm = 5.0: needs rows = "stream"'),
    "two registrations": (GOOD, {"frame": TWICE}, "not beside registration"),
    "no registration": (GOOD, {"frame": {"registration_file": "other.toml"}}, "other.toml: no such file"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSALS)
def test_a_contradiction_is_one_line_and_writes_nothing(tmp_path, capsys, name):
    write, sections, line = REFUSALS[name]
    recordings, out = tmp_path / "in", tmp_path / "session"
    recordings.mkdir()
    write(recordings)
    files = sorted(recordings.iterdir()) or [recordings / "a.csv"]
    more = []
    if sections is not None:
        given = {key: value for key, value in (PLAIN | sections).items() if value is not None}
        (tmp_path / "lab.toml").write_text(tomli_w.dumps(given))
        more = ["--map", str(tmp_path / "lab.toml")]
    status, shown, errors = run_import(capsys, *map(str, files), *more, "--out", str(out))
    assert (status, shown) == (2, "")
    assert line in errors
    assert errors.startswith("flexneedle: ")
    assert errors.count("\n") == 1
    assert not out.exists()
