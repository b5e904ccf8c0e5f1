"""Frames that are estimated from recordings, and the order and names of sessions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.frames import guide_response
from recorded_insertions import RESPONSE, columns, guided, load, write_csv

FITTED = {"frame": {"x": "fit", "y": "fit"}}
X_DEG, Y_DEG = 1.0, 5.0
ORIGIN = np.array([100.0, -20.0, 5.0])


def write_turned(folder, turn, paths, slopes=True):
    files = []
    for k, path in enumerate(paths):
        noise = 0.05 * np.random.default_rng(k).standard_normal((len(path.depth), 3))
        points, axis = (
            turn.inv().apply(path.points + noise) + ORIGIN,
            turn.inv().apply(path.axis),
        )
        table = columns(path)
        for i, name in enumerate("xyz"):
            table |= {name: points[:, i]} | ({f"a{name}": axis[:, i]} if slopes else {})
        files.append(write_csv(folder / f"{k}.csv", table))
    return files


def angle_deg(rotation, axis, turn):
    """Return the angle between an axis of a fitted frame and the true one, both on the axes of the tracker."""
    return np.degrees(np.arccos(min(1.0, float(rotation[axis] @ turn.as_matrix()[axis]))))


@pytest.mark.parametrize("seed", range(8))
def test_a_random_rotation_is_recovered(tmp_path, seed):
    turn = Rotation.random(random_state=seed)
    files = write_turned(tmp_path, turn, [guided(seed=k) for k in range(6)])
    (rotation,) = load(*files, **FITTED).session.origin["frames"].values()
    assert angle_deg(np.array(rotation), 0, turn) < X_DEG
    assert angle_deg(np.array(rotation), 1, turn) < Y_DEG
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_fitted_x_keeps_the_named_y(tmp_path):
    turn = Rotation.from_euler("zy", [5.0, -8.0], degrees=True)
    files = write_turned(tmp_path, turn, [guided(seed=k, moves=0.0) for k in range(3)])
    (rotation,) = load(*files, frame={"x": "fit", "y": "y"}).session.origin["frames"].values()
    assert angle_deg(np.array(rotation), 0, turn) < X_DEG
    assert angle_deg(np.array(rotation), 1, turn) < Y_DEG


def test_a_guide_along_one_axis_gives_y(tmp_path):
    paths = []
    for k in range(6):
        path = guided(seed=k)
        path.guide[:, 1] = 0.0
        paths.append(path)
    turn = Rotation.from_euler("x", 40.0, degrees=True)
    one = load(*write_turned(tmp_path, turn, paths), guide={"y": "gy"}, **FITTED).session
    assert one.axes == 2


def test_a_guide_that_rests_does_not_give_y(tmp_path):
    files = write_turned(tmp_path, Rotation.identity(), [guided(moves=0.0)])
    with pytest.raises(
        InputError, match=r'frame\.y = "fit" needs 6 motions of the guide that turn the measured needle: name'
    ):
        load(*files, **FITTED)


def test_the_response_to_the_guide_needs_slopes(tmp_path):
    paths = [guided(seed=k) for k in range(8)]
    files = [write_csv(tmp_path / f"{k}.csv", columns(path)) for k, path in enumerate(paths)]
    response = guide_response(load(*files).session.recordings)
    assert (np.diag(response.matrix) < 0.5 * RESPONSE).all()
    assert np.abs(response.matrix[0, 1]) < 0.003
    assert guide_response(load(*files, tip={"position": ["x", "y", "z"]}).session.recordings) is None


def test_sessions_are_folders_and_insertions_are_in_the_order_of_their_numbers(tmp_path):
    files = [
        write_csv(tmp_path / f"gel{k}" / "raw" / f"{n}.csv", columns(guided()))
        for k in (1, 2)
        for n in (1, 10, 2)
    ]
    session = load(*files).session
    assert session.names == ("gel1/raw", "gel2/raw")
    assert [one.name for one in session.recordings] == ["1", "2", "10"] * 2


def test_insertions_are_in_the_order_of_their_times(tmp_path):
    files = []
    for k, begin in enumerate((3e5, 1e5, 2e5)):
        table = columns(guided())
        files.append(write_csv(tmp_path / f"{k}.csv", table | {"t": begin + table["t"]}))
    assert [one.name for one in load(*files, time={"columns": ["t"]}).session.recordings] == ["1", "2", "0"]


def test_insertions_and_sessions_in_columns(tmp_path):
    tables = [columns(guided(seed=k)) for k in range(3)]
    table = {name: np.concatenate([each[name] for each in tables]) for name in tables[0]}
    table |= {"gel": np.repeat(["a", "a", "b"], 18), "trial": np.repeat([1, 2, 1], 18)}
    file = write_csv(tmp_path / "a.csv", table)
    found = load(file, table={"insertion": ["trial"], "session": ["gel"]}).session.recordings
    assert [(one.session, one.name) for one in found] == [("a", "1"), ("a", "2"), ("b", "1")]
