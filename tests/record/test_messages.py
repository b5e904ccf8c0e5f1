"""Orientation in the messages of a run: the smallest rotation that turns x into the needle's axis."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.record.messages import STORE, Path, path, pose, poses_of
from flexneedle.types import Pose

TILTS = st.floats(0.0, 3.1)
DIRECTIONS = st.floats(-math.pi, math.pi)


def quaternion(at):
    """Return w, x, y, z of the message of a pose."""
    turn = pose(0.0, at).pose.orientation
    return np.array([turn.w, turn.x, turn.y, turn.z])


def tilted(tilt, direction):
    return Pose(1.0, 2.0, 3.0, tilt * math.cos(direction), tilt * math.sin(direction))


@given(TILTS, DIRECTIONS)
@example(0.0, 0.0)
@example(1e-200, 1.0)
@example(math.pi / 2, 2.0)
def test_the_orientation_is_the_smallest_rotation_to_the_axis(tilt, direction):
    at = tilted(tilt, direction)
    turn = quaternion(at)
    np.testing.assert_allclose(to_matrix(turn)[:, 0], at.axis, atol=1e-14)
    np.testing.assert_allclose(2.0 * math.acos(min(1.0, turn[0])), tilt, atol=1e-7)
    assert turn @ turn == pytest.approx(1.0, abs=1e-14)
    assert turn[1] == 0.0  # no roll about the axis


@given(TILTS, DIRECTIONS)
@example(0.0, 0.0)
@example(1e-200, 1.0)
@example(3.1, -2.0)
def test_the_slopes_are_restored_from_the_orientation(tilt, direction):
    at = tilted(tilt, direction)
    data = STORE.serialize_cdr(path(0.0, np.array([at])), Path.__msgtype__)
    (row,) = poses_of(STORE.deserialize_cdr(data, Path.__msgtype__))
    np.testing.assert_allclose(row, at, rtol=4e-15, atol=4e-15 * tilt + 1e-300)


@given(st.floats(-3.1, 3.1))
@example(0.0)
@example(-0.0)
@example(5e-4)
def test_in_the_plane_it_is_a_turn_about_z_to_the_last_bit(theta):
    at = Pose(1.0, 2.0, 0.0, theta, 0.0)
    turn = quaternion(at)
    assert turn.tolist() == [math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)]
    sign = math.copysign(1.0, theta)
    assert np.copysign(1.0, turn).tolist() == [1.0, sign, -1.0, sign]  # the signs of zeros, too
    (row,) = poses_of(path(0.0, np.array([at])))
    assert row[3] == 2 * float(np.arctan2(turn[3], turn[0]))
    assert row[4] == 0.0
