"""Steps of continuous recordings."""

import numpy as np
import pytest

from flexneedle.lab.calibration.importing.steps import medians, still_phases
from recorded_insertions import guided, load, stream, write_csv

STREAM = {"time": {"columns": ["t"]}, "steps": {"rows": "stream"}, "tip": {"position": ["x", "y", "z"]}}


def write(file, time, tip, guide):
    names = ("t", "x", "y", "z", "gy", "gz")
    return write_csv(file, dict(zip(names, np.column_stack([time, tip, guide]).T, strict=True)))


@pytest.mark.parametrize("rate", [2.0, 10.0, 40.0, 100.0])
@pytest.mark.parametrize("speed", [2.0, 20.0])
@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("moves", [0.0, 3.0])
def test_each_rest_is_a_step(rate, speed, noise, moves):
    path = guided(moves=moves)
    time, tip, guide = stream(path, rate, speed, rest=3.0, noise=noise)
    found = still_phases(time, tip, guide, 1.0)
    assert len(found) == len(path.depth)
    np.testing.assert_allclose(medians(found, tip), path.points, atol=0.01 + noise)
    np.testing.assert_allclose(medians(found, guide), path.guide, atol=1e-9)


def test_a_rest_without_motion_before_the_next_is_one_step():
    path = guided(moves=0.0)
    time, tip, guide = stream(path, noise=0.02)
    spike = tip + np.where(np.arange(len(time))[:, None] % 97 == 50, 0.5, 0.0)
    assert len(still_phases(time, spike, guide, 1.0)) <= len(path.depth)


def test_a_guide_that_moves_at_rest_makes_a_step():
    time = np.arange(0.0, 30.0, 0.1)
    tip = np.column_stack([np.clip(time - 20.0, 0.0, 5.0), np.zeros(300), np.zeros(300)])
    guide = np.column_stack([np.clip(time - 8.0, 0.0, 2.0), np.zeros(300)])
    found = still_phases(time, tip, guide, 1.0)
    np.testing.assert_allclose(
        medians(found, np.hstack([tip, guide])), [[0, 0, 0, 0, 0], [0, 0, 0, 2, 0], [5, 0, 0, 2, 0]]
    )


def test_a_stream_of_an_insertion_gives_its_steps(tmp_path):
    path = guided()
    imported = load(write(tmp_path / "a.csv", *stream(path, noise=0.02)), **STREAM)
    (found,) = imported.session.recordings
    np.testing.assert_allclose(found.depth, path.depth, atol=0.05)
    np.testing.assert_allclose(found.position, path.position, atol=0.05)
    np.testing.assert_allclose(found.guide, path.guide, atol=1e-9)
    assert "18 steps each" in imported.understood[0]


def test_a_motion_without_rests_has_a_step_every_few_millimetres(tmp_path):
    path = guided(moves=0.0)
    time = np.linspace(0.0, 17.0, 600)
    tip = np.stack([np.interp(time, np.arange(18.0), each) for each in path.points.T], axis=1)
    file = write(tmp_path / "a.csv", time, tip, np.zeros((600, 2)))
    (found,) = load(file, **STREAM | {"steps": {"rows": "stream", "every_mm": 10.0}}).session.recordings
    np.testing.assert_allclose(found.depth, 10.0 * np.arange(9), atol=0.2)


def test_rows_without_a_position_do_not_end_a_rest(tmp_path):
    path = guided()
    time, tip, guide = stream(path, rate=20.0)
    tip[np.arange(len(time)) % 5 == 0] = np.nan
    (found,) = load(write(tmp_path / "a.csv", time, tip, guide), **STREAM).session.recordings
    np.testing.assert_allclose(found.depth, path.depth, atol=1e-6)
