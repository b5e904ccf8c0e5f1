"""Frames of a tip that follows records: none before the needle is known, none extrapolated."""

import numpy as np
import pytest

from flexneedle.geometry.quaternion import z_axis
from flexneedle.lab.emulators.emulated_rig.following import TipHistory
from flexneedle.lab.emulators.emulated_rig.stream import Record
from flexneedle.lab.emulators.motion import SensorNoise, is_missing, sensor_pose

POWER_ON = 100.0


def record(time, x, moving, axis=(0.0, 0.0, 1.0)):
    return Record(POWER_ON + time, (x, 2.0, -200.0, *axis), moving)


@pytest.mark.parametrize("moving", [False, True])
def test_a_frame_is_there_when_the_needle_is_known_at_its_time(moving):
    """At rest, too: it may move by a record that a busy computer has not passed on yet."""
    tip = TipHistory(POWER_ON, record(0.0, 1.0, moving))
    assert tip.newest(400) == 0
    tip.add([record(9.99, 1.0, moving)])
    assert tip.newest(400) == 399
    assert tip.at(399)[0] == (1.0, 2.0, -200.0)


def test_in_motion_the_pose_of_a_frame_is_between_the_records():
    tip = TipHistory(POWER_ON, record(0.0, 0.0, False))
    tip.add([record(0.1, 0.0, True), record(0.124, 0.5, True)])
    assert tip.newest(7) == 4
    tip.add([record(0.126, 0.6, True)])
    assert tip.newest(7) == 5
    assert tip.at(5)[0][0] == pytest.approx(0.55)
    tip.add([record(0.13, 0.6, False), record(0.18, 0.6, False)])
    assert tip.newest(7) == 7
    assert tip.at(7)[0][0] == 0.6


def test_the_needles_direction_is_between_the_records_and_a_unit_vector():
    tilted = (0.6, 0.0, 0.8)
    tip = TipHistory(POWER_ON, record(0.1, 0.0, True))
    tip.add([record(0.15, 1.0, True, tilted)])
    orientation = np.array(tip.at(5)[1])
    np.testing.assert_allclose(np.linalg.norm(orientation), 1.0)
    np.testing.assert_allclose(z_axis(orientation), np.array([0.3, 0.0, 0.9]) / np.hypot(0.3, 0.9))


def test_noise_is_that_of_the_scenario():
    tip = TipHistory(POWER_ON, record(0.0, 1.0, False))
    made = [sensor_pose("tip", n, 0, tip, SensorNoise(0.2, 0.01)) for n in range(2000)]
    off = np.array([one.position for one in made]) - (1.0, 2.0, -200.0)
    assert np.sqrt((off**2).sum(axis=1).mean()) == pytest.approx(0.2, rel=0.05)
    axes = np.array([z_axis(np.array(one.orientation)) for one in made])
    np.testing.assert_allclose(axes[:, :2].std(axis=0), 0.01, rtol=0.06)


def test_a_share_of_the_frames_has_no_tip():
    missing = sum(is_missing(n, 0, SensorNoise(missing=0.03)) for n in range(20_000))
    assert missing == pytest.approx(600, rel=0.15)
    assert not any(is_missing(n, 0, SensorNoise()) for n in range(1000))
