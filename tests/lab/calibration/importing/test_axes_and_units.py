"""Signs, axes, units and orientations: a recording in any of them gives the same session."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from recorded_insertions import assert_steps, columns, guided, load, write_csv

PATH = guided()
LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "inch": 25.4}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295, "mrad": 0.001}
SIGNED = ["x", "y", "z", "-x", "-y", "-z"]
FRAMES = [pair for pair in itertools.permutations(SIGNED, 2) if pair[0][-1] != pair[1][-1]]
AXES = dict(zip(SIGNED, np.vstack([np.eye(3), -np.eye(3)]), strict=True))


def to_tracker(x, y, vectors):
    """Return vectors of the needle's frame on the axes of a tracker in which it has the axes x and y."""
    rotation = np.stack([AXES[x], AXES[y], np.cross(AXES[x], AXES[y])])
    return vectors @ rotation


@given(
    st.sampled_from(FRAMES),
    st.sampled_from([*LENGTHS]),
    st.sampled_from([*LENGTHS]),
    st.tuples(*[st.sampled_from(["", "-", "+"])] * 3),
    st.tuples(*[st.floats(-300.0, 300.0)] * 3),
)
def test_axes_units_and_signs_of_columns(tmp_path_factory, frame, unit, guide_unit, signs, origin):
    points = (to_tracker(*frame, PATH.points) + origin) / LENGTHS[unit]
    axis = to_tracker(*frame, PATH.axis)
    factors = [-1.0 if sign == "-" else 1.0 for sign in signs]
    table = columns(PATH)
    for k, name in enumerate("xyz"):
        table |= {name: factors[k] * points[:, k], f"a{name}": factors[k] * axis[:, k]}
    table |= {"gy": -PATH.guide[:, 0] / LENGTHS[guide_unit], "gz": PATH.guide[:, 1] / LENGTHS[guide_unit]}
    (found,) = load(
        write_csv(tmp_path_factory.mktemp("axes") / "a.csv", table),
        tip={
            "position": [sign + name for sign, name in zip(signs, "xyz", strict=True)],
            "axis": [f"{sign}a{name}" for sign, name in zip(signs, "xyz", strict=True)],
            "unit": unit,
        },
        guide={"y": "-gy", "z": "gz", "unit": guide_unit},
        frame={"x": frame[0], "y": frame[1]},
        steps={"gap_mm": 1e3},
    ).session.recordings
    assert_steps(found, PATH)
    np.testing.assert_allclose(found.slope, PATH.slope, atol=1e-9)


@given(st.sampled_from(["wxyz", "xyzw"]), st.sampled_from(SIGNED), st.integers(0, 9))
def test_orientations(tmp_path_factory, order, sensor_axis, seed):
    table = columns(PATH)
    spin = Rotation.random(random_state=seed)
    along = spin.inv().apply(AXES[sensor_axis])
    turns = [Rotation.align_vectors([axis], [along])[0] * spin.inv() for axis in PATH.axis]
    for name, values in zip(
        order,
        np.array([turn.as_quat() for turn in turns])[:, ["xyzw".index(c) for c in order]].T,
        strict=True,
    ):
        table[f"q{name}"] = values
    (found,) = load(
        write_csv(tmp_path_factory.mktemp("turns") / "a.csv", table),
        tip={
            "position": ["x", "y", "z"],
            "quaternion": [f"q{name}" for name in order],
            "order": order,
            "sensor_axis": sensor_axis,
        },
    ).session.recordings
    np.testing.assert_allclose(found.slope, PATH.slope, atol=1e-9)


def test_data_in_a_plane(tmp_path):
    table = columns(PATH) | {"angle": np.degrees(np.arctan(PATH.slope[:, 0]))}
    for unit, factor in ANGLES.items():
        given_angle = table["angle"] * np.pi / 180.0 / factor
        file = write_csv(tmp_path / f"{unit}.csv", table | {"angle": given_angle})
        (found,) = load(
            file,
            tip={"position": ["x", "y"], "angle": ["angle"], "angle_unit": unit},
            guide={"y": "gy"},
        ).session.recordings
        assert found.axes == 1
        assert_steps(found, PATH)
        np.testing.assert_allclose(found.slope[:, 0], PATH.slope[:, 0], atol=1e-9)


def test_a_plane_of_a_tracker_in_space(tmp_path):
    (found,) = load(write_csv(tmp_path / "a.csv", columns(PATH)), frame={"plane": True}).session.recordings
    assert found.axes == 1
    assert_steps(found, PATH)


def test_registration_and_a_guide_in_the_axes_of_the_tracker(tmp_path):
    turn = Rotation.from_euler("zyx", [0.4, -1.1, 2.0])
    shift = np.array([120.0, -40.0, 15.0])
    stage = np.array(
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    )  # rows: x, y, z of the needle's frame
    points = turn.inv().apply((PATH.points + np.array([7.0, 1.0, 2.0])) @ stage - shift)
    guide = turn.inv().apply(np.column_stack([np.full(18, -20.0), PATH.guide]) @ stage - shift)
    axis = turn.inv().apply(PATH.axis @ stage)
    table = dict(zip("xyzabcuvw", np.hstack([points, guide, axis]).T, strict=True))
    registration = {
        "rotation": turn.as_quat(scalar_first=True).tolist(),
        "translation_mm": shift.tolist(),
        "fiducials_mm": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
    }
    (found,) = load(
        write_csv(tmp_path / "a.csv", table),
        tip={"position": ["x", "y", "z"], "axis": ["u", "v", "w"]},
        guide={"position": ["a", "b", "c"]},
        frame={"x": "-y", "y": "x", "registration": registration, "skin_mm": 5.0},
    ).session.recordings
    np.testing.assert_allclose(found.depth, PATH.depth + 2.0, atol=1e-9)
    np.testing.assert_allclose(found.position, PATH.position, atol=1e-9)
    np.testing.assert_allclose(found.guide, PATH.guide, atol=1e-9)
    np.testing.assert_allclose(found.slope, PATH.slope, atol=1e-9)


def test_base_roll_and_the_depth_of_the_first_step(tmp_path):
    table = columns(PATH) | {"roll": np.linspace(0.0, 180.0, 18), "base": 0.1 * np.arange(18)}
    (found,) = load(
        write_csv(tmp_path / "a.csv", table),
        roll={"column": "-roll", "unit": "deg"},
        base={"z": "base", "unit": "cm"},
        frame={"first_depth_mm": -4.0},
    ).session.recordings
    np.testing.assert_allclose(found.roll, -np.linspace(0.0, np.pi, 18))
    np.testing.assert_allclose(found.base, np.column_stack([np.zeros(18), np.arange(18)]))
    np.testing.assert_allclose(found.depth, PATH.depth - 4.0)


def test_an_empty_cell_of_the_guide_repeats_the_value_before(tmp_path):
    table = columns(PATH)
    table["gy"] = ["" if k % 3 else str(value) for k, value in enumerate(table["gy"])]
    (found,) = load(write_csv(tmp_path / "a.csv", table)).session.recordings
    np.testing.assert_allclose(found.guide[:, 0], np.repeat(PATH.guide[::3, 0], 3))


@pytest.mark.parametrize("end", [[10.0, 60.0], [84.0, 85.0, 3.0, 90.0]])
def test_a_recording_ends_at_its_deepest_step(tmp_path, end):
    table = columns(PATH)
    longer = {name: [*values, *[values[-1]] * len(end)] for name, values in table.items()}
    longer["x"] = [*table["x"], *end]
    longer["t"] = np.arange(len(longer["x"]))
    imported = load(write_csv(tmp_path / "a.csv", longer))
    (found,) = imported.session.recordings
    assert found.depth[-1] == 85.0
    assert ("advances again: name each insertion" in imported.suspected[0]) == (end[-1] > 10.0)
    assert "after 85 mm left out: the tip retreats" in imported.suspected[0]
