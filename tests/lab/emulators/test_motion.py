"""Poses of the emulated sensors."""

import numpy as np

from flexneedle.lab.emulators.motion import SENSORS, RestingTip, sensor_pose


def path(sensor, count=800):
    return np.array([sensor_pose(sensor, n, 0).position for n in range(count)])


def test_references_are_at_rest_except_for_jitter():
    for name in SENSORS[1:]:
        deviation = path(name) - path(name).mean(axis=0)
        np.testing.assert_allclose(np.sqrt((deviation**2).sum(axis=1).mean()), 0.07, rtol=0.1)


def test_a_resting_tip_is_at_its_position_with_the_same_jitter():
    rest = (10.0, 20.0, -300.0)
    positions = np.array([sensor_pose("tip", n, 0, RestingTip(rest)).position for n in range(800)])
    np.testing.assert_allclose(positions.mean(axis=0), rest, atol=0.01)
    np.testing.assert_allclose(np.sqrt(((positions - rest) ** 2).sum(axis=1).mean()), 0.07, rtol=0.1)
    assert sensor_pose("ref1", 5, 0, RestingTip(rest)) == sensor_pose("ref1", 5, 0)


def test_the_tips_z_axis_is_along_its_motion():
    def z_axis(w, x, y, z):
        return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])

    for number in (0, 100, 333, 700):
        orientation = sensor_pose("tip", number, 0).orientation
        np.testing.assert_allclose(np.linalg.norm(orientation), 1, atol=1e-12)
        angle = 2 * np.pi * number / 800
        np.testing.assert_allclose(z_axis(*orientation), (-np.sin(angle), np.cos(angle), 0), atol=1e-12)
